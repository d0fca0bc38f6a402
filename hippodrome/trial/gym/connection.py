"""The process of one connection: shakes hands, answers the requests of its client, and runs its environments.

It has one thread, and blocks: `websockets` only reads and writes bytes here (its sans-I/O layer). So an environment may
fork, and only its own client waits for it.
"""

from __future__ import annotations

import contextlib
import http
import importlib
import logging
import os
import resource
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit

from websockets.exceptions import InvalidHandshake
from websockets.frames import CloseCode, Opcode
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.server import ServerProtocol

from hippodrome.trial.gym import linux
from hippodrome.trial.gym.forms import BY_NAME, EXACT, SUBPROTOCOL, GymError, MessageForm, form_of
from hippodrome.trial.gym.recordings import ConnectionRecorder
from hippodrome.trial.gym.session import GymSession
from hippodrome.trial.gym.settings import FIRST_REQUEST_SECONDS, HANDSHAKE_SECONDS, MAX_MESSAGE, PATH, Limits, Settings

_CLOSE_SECONDS = 2.0  # the seconds that a client has to answer a close
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


class ConnectionOver(Exception):
    """The connection has ended."""


class BlockingWebSocket:
    """A server's side of a WebSocket on a blocking socket. Its methods raise ConnectionOver."""

    def __init__(self, connection: socket.socket, state: State = State.CONNECTING) -> None:
        logger = logging.getLogger("hippodrome.trial.gym.websockets")
        logger.setLevel(logging.CRITICAL + 1)  # clients could write to the terminal by what they send
        self._socket = connection
        self._protocol = ServerProtocol(
            subprotocols=[SUBPROTOCOL],
            select_subprotocol=lambda _, offered: SUBPROTOCOL if SUBPROTOCOL in offered else None,
            state=state,
            max_size=MAX_MESSAGE,
            logger=logger,
        )
        self._events: deque[Any] = deque()

    def shake_hands(self, settings: Settings, full: bool) -> MessageForm:
        """Answer the client's handshake, and return the form of its messages."""
        try:
            request: Request = self._next_event(time.monotonic() + HANDSHAKE_SECONDS)
        except TimeoutError:
            raise ConnectionOver from None
        response = self._refused(request, settings, full) or self._protocol.accept(request)
        self._protocol.send_response(response)
        self._flush()
        form = form_of(request.path)
        if response.status_code != http.HTTPStatus.SWITCHING_PROTOCOLS or form is None:
            raise ConnectionOver
        return EXACT if self._protocol.subprotocol == SUBPROTOCOL else form

    def _refused(self, request: Request, settings: Settings, full: bool) -> Response | None:
        """Return the HTTP answer that refuses the request; None if the client may connect."""
        refuse = self._protocol.reject
        try:
            path, origin = urlsplit(request.path).path, request.headers.get("Origin")
            known_origin = origin is None or origin in settings.origins or urlsplit(origin).hostname in _LOOPBACK
            upgrades = "websocket" in request.headers.get("Upgrade", "").lower()
            form = form_of(request.path)
        except (ValueError, LookupError):  # a malformed address or origin, or a header that is there twice
            return refuse(http.HTTPStatus.BAD_REQUEST, "This is no handshake of a WebSocket.\n")
        if not upgrades:
            return refuse(http.HTTPStatus.OK, f"Environments are served at {PATH}, by WebSocket.\n")
        if path.rstrip("/") != PATH:
            return refuse(http.HTTPStatus.NOT_FOUND, f"There is nothing here. Environments are served at {PATH}.\n")
        if not known_origin:
            sentence = "Pages of this origin may not connect; start the server with --origin.\n"
            return refuse(http.HTTPStatus.FORBIDDEN, sentence)
        if form is None:
            return refuse(http.HTTPStatus.BAD_REQUEST, f"form must be one of {', '.join(BY_NAME)}.\n")
        if full:
            sentence = f"There are {settings.limits.connections} connections already; try later.\n"
            return refuse(http.HTTPStatus.SERVICE_UNAVAILABLE, sentence)
        return None

    def receive(self, seconds: float) -> str | bytes:
        """Return the next message. Raises TimeoutError if there is none within so many seconds, if they are not 0."""
        deadline = time.monotonic() + seconds if seconds else None
        parts: list[bytes] = []
        text = True
        while True:
            frame = self._next_event(deadline)
            if frame.opcode not in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                continue
            if frame.opcode is not Opcode.CONT:
                text = frame.opcode is Opcode.TEXT
            parts.append(bytes(frame.data))
            if frame.fin:
                break
        if not text:
            return b"".join(parts)
        try:
            return b"".join(parts).decode()
        except UnicodeDecodeError:
            self.close(CloseCode.INVALID_DATA, "The message is not UTF-8.")
            raise ConnectionOver from None

    def send(self, message: str | bytes) -> None:
        """Send a message."""
        if isinstance(message, str):
            self._protocol.send_text(message.encode())
        else:
            self._protocol.send_binary(message)
        self._flush()

    def close(self, code: int, sentence: str) -> None:
        """Close the connection with a code and the beginning of a sentence, which a close frame limits to 123 bytes."""
        reason = sentence.encode("utf-8", "replace")
        if len(reason) > 123:
            reason = reason[:120].decode("utf-8", "ignore").encode() + "…".encode()
        with contextlib.suppress(ConnectionOver, TimeoutError):
            self._protocol.send_close(code, reason.decode())
            self._flush()
            self.drain()

    def drain(self) -> None:
        """Read for a moment: the system discards sent bytes that are under way if received bytes stay unread."""
        deadline = time.monotonic() + _CLOSE_SECONDS
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)
            while (left := deadline - time.monotonic()) > 0:
                self._socket.settimeout(left)
                if not self._socket.recv(65536):
                    return

    def _next_event(self, deadline: float | None) -> Any:
        while not self._events:
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                raise TimeoutError
            try:
                self._socket.settimeout(left)
                data = self._socket.recv(65536)
            except TimeoutError:
                raise
            except OSError:
                raise ConnectionOver from None
            if not data:
                raise ConnectionOver
            self._protocol.receive_data(data)
            self._events += self._protocol.events_received()
            self._flush()  # answers to pings and closes
            if self._protocol.close_sent is not None or isinstance(self._protocol.handshake_exc, InvalidHandshake):
                self.drain()
                raise ConnectionOver
        return self._events.popleft()

    def _flush(self) -> None:
        try:
            for part in self._protocol.data_to_send():
                if part:
                    self._socket.sendall(part)
        except OSError:  # also if the client has read nothing until the time limit of the last `receive`
            raise ConnectionOver from None


def _answer_requests(websocket: BlockingWebSocket, session: GymSession, limits: Limits) -> None:
    """Answer requests until the connection ends.

    Nothing handles SIGALRM, so the system ends this process if a request takes too long, also while an environment
    hangs in C.
    """
    seconds = min(FIRST_REQUEST_SECONDS, limits.idle_seconds or FIRST_REQUEST_SECONDS)
    try:
        while True:
            message = websocket.receive(seconds)
            signal.setitimer(signal.ITIMER_REAL, limits.seconds)
            reply = session.answer(message)
            signal.setitimer(signal.ITIMER_REAL, 0)
            if isinstance(reply, GymError):
                websocket.close(reply.code, str(reply))
                return
            websocket.send(reply)
            seconds = limits.idle_seconds
    except TimeoutError:
        websocket.close(CloseCode.GOING_AWAY, f"There was no request for {seconds:g} s.")
    except ConnectionOver:
        pass
    finally:
        signal.setitimer(signal.ITIMER_REAL, limits.seconds)
        session.end()


def serve_client(connection: socket.socket, settings: Settings, *, full: bool) -> None:
    """Serve this connection in this new process, which must end afterwards. `full` refuses it with a sentence."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    _keep_alive(connection)
    websocket = BlockingWebSocket(connection)
    try:
        form = websocket.shake_hands(settings, full)
    except ConnectionOver:
        websocket.drain()
        return
    if not settings.output:
        _discard_output()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    linux.limit_memory(settings.limits.megabytes)
    import_modules(settings.modules)
    recorder = None if settings.record is None else ConnectionRecorder(settings.record)
    _answer_requests(websocket, GymSession(form, recorder), settings.limits)
    websocket.drain()


def say_goodbye(connection: socket.socket, code: int, sentence: str) -> None:
    """Close a connection whose process has ended."""
    BlockingWebSocket(connection, State.OPEN).close(code, sentence)


def import_modules(modules: Sequence[str]) -> None:
    """Import the modules that register environments, also from the present folder."""
    sys.path.insert(0, os.getcwd())
    for module in modules:
        importlib.import_module(module)


def _keep_alive(connection: socket.socket) -> None:
    """Let the system find out within about two minutes that a client has gone without a close."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 60), ("TCP_KEEPINTVL", 15), ("TCP_KEEPCNT", 4)):
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def _discard_output() -> None:
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    for number in (0, 1, 2):
        os.dup2(nothing, number)
    os.close(nothing)
