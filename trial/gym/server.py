"""The process that listens. It does the handshakes, and holds connections until their first request.

Then the spawner (`spawner.py`) gets the connection's socket, and starts a process for it (`worker.py`). This process
keeps a descriptor of the socket. If the worker had to be ended, it closes the connection with a sentence.
"""

from __future__ import annotations

import contextlib
import errno
import http
import selectors
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NoReturn, Protocol
from urllib.parse import urlsplit

from websockets.datastructures import Headers
from websockets.exceptions import ProtocolError
from websockets.frames import CTRL_OPCODES, Close, CloseCode, Frame, Opcode
from websockets.http11 import Request, Response
from websockets.server import ServerProtocol
from websockets.typing import Subprotocol

from trial.gym import handover
from trial.gym.errors import reason
from trial.gym.forms import ARRAYS, GYMIE, SUBPROTOCOL, UNKNOWN_FORM, MessageForm, form_of
from trial.gym.limits import Limits
from trial.gym.wakeup import Wakeup

PATH = "/gym"
_HANDSHAKE_SECONDS = 10.0
_HANDSHAKE_BYTES = 16 * 1024  # the most bytes of a handshake
_CLOSE_SECONDS = 2.0  # the time that a client has to close its end
_NO_FILES_SECONDS = 0.05  # the pause if no file can be opened
WITHOUT_HANDSHAKE = 100
"""The connections beyond the limit that are accepted, so that their handshakes are answered with a refusal."""
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


class ListeningSocket(Protocol):
    """A listening socket, or an object that accepts connections in another way."""

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept the next connection. Raises OSError if none waits, KeyboardInterrupt if there will be no more."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when there is a connection."""

    def setblocking(self, flag: bool, /) -> None:
        """Set whether `accept` waits for a connection."""

    def close(self) -> None:
        """Accept no more connections."""


@dataclass(slots=True, eq=False)
class _Connection:
    socket: socket.socket
    deadline: float | None
    """The time when it is dropped, unless its handshake, first request or close has come before; None: no limit."""
    received: bytes = b""
    form: str = ""
    """The name of the form of its messages; empty until the handshake is done."""
    number: int = 0
    """Its number for the spawner; 0 if it has no worker."""
    closing: bool = False


class GymServer:
    """Serves connections until `run` is interrupted."""

    def __init__(
        self, listener: ListeningSocket, control: socket.socket, limits: Limits, origins: Sequence[str]
    ) -> None:
        self._listener = listener
        self._control = control
        self._limits = limits
        self._origins = frozenset(origins)
        self._selector = selectors.DefaultSelector()
        self._connections: set[_Connection] = set()
        self._with_worker: dict[int, _Connection] = {}
        self._last_number = 0
        self._from_spawner = bytearray()  # the beginning of a message that is not complete yet

    def run(self) -> NoReturn:
        """Serve until a signal raises KeyboardInterrupt, which passes on. Raises EOFError if the spawner has ended."""
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        self._selector.register(self._control, selectors.EVENT_READ, self._listen_to_spawner)
        with contextlib.closing(Wakeup()) as wakeup:
            self._selector.register(wakeup, selectors.EVENT_READ, wakeup.clear)
            try:
                self._serve()
            finally:
                self._selector.unregister(wakeup)

    def _serve(self) -> NoReturn:
        checked = time.monotonic()
        while True:
            for key, _ in self._selector.select(1.0 if self._timed() else None):
                if isinstance(key.data, _Connection):
                    self._readable(key.data)
                else:
                    key.data()
            now = time.monotonic()
            if now - checked >= 0.5:
                checked = now
                for connection in [one for one in self._timed() if (one.deadline or now) < now]:
                    if connection.form and not connection.closing:
                        self._send_close(
                            connection, 1001, f"There was no request for {self._limits.silent_seconds:g} s."
                        )
                    else:
                        self._drop(connection)

    def close(self) -> None:
        """Tell all clients that the server ends, and close their connections."""
        for connection in list(self._connections):
            if connection.form and not connection.closing:
                self._send_close(connection, 1001, "The server ends.")
            self._drop(connection)
        self._selector.close()

    def _timed(self) -> list[_Connection]:
        """Return the connections with a deadline."""
        return [connection for connection in self._connections if connection.deadline is not None]

    # ---- connections without a worker

    def _accept(self) -> None:
        try:
            accepted, _ = self._listener.accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE):
                time.sleep(_NO_FILES_SECONDS)  # without a pause, the loop would try this all the time
            return
        if len(self._connections) >= self._limits.connections + WITHOUT_HANDSHAKE:
            accepted.close()
            return
        accepted.setblocking(False)
        connection = _Connection(accepted, time.monotonic() + _HANDSHAKE_SECONDS)
        self._connections.add(connection)
        self._selector.register(accepted, selectors.EVENT_READ, connection)

    def _readable(self, connection: _Connection) -> None:
        try:
            data = connection.socket.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(connection)
        elif not connection.closing:
            connection.received += data
            if not connection.form:
                self._shake_hands(connection)
            if connection.form:
                self._between_requests(connection)

    def _shake_hands(self, connection: _Connection) -> None:
        head, end, rest = connection.received.partition(b"\r\n\r\n")
        if not end:
            if len(head) > _HANDSHAKE_BYTES:
                self._drop(connection)
            return
        protocol = ServerProtocol(subprotocols=[SUBPROTOCOL], select_subprotocol=_subprotocol)
        protocol.receive_data(head + end)
        events = protocol.events_received()
        form: MessageForm | None = None
        if not events or not isinstance(events[0], Request):
            response = _response(http.HTTPStatus.BAD_REQUEST, "This is no request of HTTP.\n")
        else:
            request = events[0]
            try:
                form = form_of(request.path)
                response = self._refused(request) or protocol.accept(request)
            except (ValueError, LookupError):  # a malformed address or origin, or a header that is there twice
                response = _response(http.HTTPStatus.BAD_REQUEST, "This is no handshake of a WebSocket.\n")
        connection.received = rest
        if not self._send(connection, response.serialize()):
            return
        if response.status_code != http.HTTPStatus.SWITCHING_PROTOCOLS:
            self._close_soon(connection)
            return
        connection.deadline = time.monotonic() + self._limits.silent_seconds
        connection.form = (ARRAYS if protocol.subprotocol == SUBPROTOCOL else form or GYMIE).name
        if connection.socket.family != socket.AF_UNIX:
            connection.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            _keep_alive(connection.socket)

    def _refused(self, request: Request) -> Response | None:
        """Return the HTTP answer that refuses the request; None if it is a handshake, and the client may connect."""
        path, origin = urlsplit(request.path).path, request.headers.get("Origin")
        if "websocket" not in request.headers.get("Upgrade", "").lower():
            return _response(http.HTTPStatus.OK, f"Environments are served at {PATH}, by WebSocket.\n")
        if path.rstrip("/") != PATH:
            return _response(http.HTTPStatus.NOT_FOUND, f"There is nothing here. Environments are served at {PATH}.\n")
        if origin is not None and origin not in self._origins and urlsplit(origin).hostname not in _LOOPBACK:
            return _response(
                http.HTTPStatus.FORBIDDEN, "Pages of this origin may not connect; start the server with --origin.\n"
            )
        if form_of(request.path) is None:
            return _response(http.HTTPStatus.BAD_REQUEST, UNKNOWN_FORM)
        if len(self._connections) > self._limits.connections:
            return _response(
                http.HTTPStatus.SERVICE_UNAVAILABLE, f"There are {self._limits.connections} connections already.\n"
            )
        return None

    def _between_requests(self, connection: _Connection) -> None:
        """Answer pings and closes. At the first data frame, let the spawner start a worker for the connection."""
        while len(connection.received) >= 2:
            first, second = connection.received[:2]
            opcode, length = first & 0x0F, second & 0x7F
            if opcode not in CTRL_OPCODES or not first & 0x80 or first & 0x70 or not second & 0x80 or length > 125:
                self._hand_over(connection)  # also for a malformed frame: the worker answers as the protocol demands
                return
            if len(connection.received) < 6 + length:
                return
            mask, payload = connection.received[2:6], connection.received[6 : 6 + length]
            connection.received = connection.received[6 + length :]
            payload = bytes(byte ^ mask[at % 4] for at, byte in enumerate(payload))
            if opcode == Opcode.PING:
                self._send(connection, Frame(Opcode.PONG, payload).serialize(mask=False))
            elif opcode == Opcode.CLOSE:
                self._send(connection, Frame(Opcode.CLOSE, _close_answer(payload)).serialize(mask=False))
                self._drop(connection)
                return

    def _hand_over(self, connection: _Connection) -> None:
        self._selector.unregister(connection.socket)
        connection.deadline = None
        self._last_number += 1
        connection.number = self._last_number
        self._with_worker[connection.number] = connection
        received, connection.received = connection.received, b""
        handover.send(
            self._control, handover.NewConnection(connection.number, connection.form, received, connection.socket)
        )

    # ---- the end of workers, and of connections

    def _listen_to_spawner(self) -> None:
        data = self._control.recv(65536)
        if not data:
            raise EOFError("the process that starts workers has ended")
        self._from_spawner += data
        while (ended := handover.read_ended(self._from_spawner)) is not None:
            connection = self._with_worker.pop(ended.number, None)
            if connection is None:
                continue
            connection.number = 0
            if not ended.code:
                self._drop(connection)
                continue
            connection.socket.setblocking(False)
            self._selector.register(connection.socket, selectors.EVENT_READ, connection)
            self._send_close(connection, ended.code, ended.sentence)

    def _send_close(self, connection: _Connection, code: int, sentence: str) -> None:
        close = Close(code, reason(sentence)).serialize()
        if self._send(connection, Frame(Opcode.CLOSE, close).serialize(mask=False)):
            self._close_soon(connection)

    def _close_soon(self, connection: _Connection) -> None:
        """Send nothing more, and give the client time to read what it was sent."""
        connection.closing = True
        connection.deadline = time.monotonic() + _CLOSE_SECONDS
        with contextlib.suppress(OSError):
            connection.socket.shutdown(socket.SHUT_WR)

    def _send(self, connection: _Connection, data: bytes) -> bool:
        """Send a few bytes. Drop the client and return False if they cannot be sent at once."""
        try:
            if connection.socket.send(data, socket.MSG_DONTWAIT) == len(data):
                return True
        except OSError:
            pass
        self._drop(connection)
        return False

    def _drop(self, connection: _Connection) -> None:
        if connection not in self._connections:
            return
        self._connections.discard(connection)
        if connection.number:
            self._with_worker.pop(connection.number, None)
        else:
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(connection.socket)
        connection.form = ""
        connection.socket.close()


def _close_answer(payload: bytes) -> bytes:
    """Return the payload that answers a client's close: the same, or a code for a malformed one (RFC 6455, 7.4.1)."""
    try:
        Close.parse(payload)
    except ProtocolError:
        return Close(CloseCode.PROTOCOL_ERROR, "").serialize()
    except UnicodeDecodeError:
        return Close(CloseCode.INVALID_DATA, "").serialize()
    return payload


def _subprotocol(_: ServerProtocol, offered: Sequence[Subprotocol]) -> Subprotocol | None:
    """Return SUBPROTOCOL if the client offers it; None for Gymie's clients and others that speak JSON."""
    return SUBPROTOCOL if SUBPROTOCOL in offered else None


def _response(status: http.HTTPStatus, text: str) -> Response:
    body = text.encode()
    headers = Headers(
        {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body)), "Connection": "close"}
    )
    return Response(status.value, status.phrase, headers, body)


def _keep_alive(connection: socket.socket) -> None:
    """Let the system find out within about two minutes that a client has gone without a close."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 60), ("TCP_KEEPINTVL", 15), ("TCP_KEEPCNT", 4)):
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
