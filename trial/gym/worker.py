"""The process of one connection: it owns the connection's socket, and runs its environments.

One thread receives a request, takes the step and sends the answer. The spawner (`spawner.py`) watches this process from
outside, by the `WorkerState` that they share, and enforces the limits.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import resource
import signal
import socket
import struct
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Any

from websockets.frames import CloseCode, Opcode
from websockets.protocol import Protocol, Side
from websockets.protocol import State as Connected

from trial.gym import linux, values
from trial.gym.errors import EnvironmentFailed, GymError, TooSlow, described, reason
from trial.gym.forms import MessageForm
from trial.gym.limits import Limits
from trial.gym.recordings import ConnectionRecorder
from trial.gym.session import GymSession
from trial.wire import websocket_frames as frames

_READ = 256 * 1024  # bytes of one read
_SEND_SECONDS = 30  # a client may leave a reply unread for this time
_CLOSE_SECONDS = 2  # a client must answer a close within this time


class WorkerState:
    """Holds the time when the present request began, or, negated, the time when the last one was answered.

    The worker writes it into shared memory, and the spawner reads it.
    """

    def __init__(self, memory: Any, at: int) -> None:
        self._memory = memory
        self._at = at
        self.rest()
        self._first: float = memory[at]

    def work(self) -> None:
        """Note that a request begins."""
        self._memory[self._at] = time.monotonic()

    def rest(self) -> None:
        """Note that a request has been answered."""
        self._memory[self._at] = -time.monotonic()

    @property
    def silent(self) -> bool:
        """Whether no request has come yet."""
        return bool(self._memory[self._at] == self._first)

    def busy(self, now: float) -> float:
        """Return the seconds since the present request began; 0 if there is none."""
        since: float = self._memory[self._at]
        return now - since if since > 0 else 0.0

    def idle(self, now: float) -> float:
        """Return the seconds since the last request was answered; 0 during a request."""
        since: float = self._memory[self._at]
        return now + since if since < 0 else 0.0


class ConnectionGone(Exception):
    """The connection is over."""


class ConnectionWorker:
    """Serves one connection until it ends."""

    def __init__(
        self,
        connection: socket.socket,
        form: MessageForm,
        limits: Limits,
        state: WorkerState,
        recorder: ConnectionRecorder | None = None,
    ) -> None:
        self._socket = connection
        self._form = form
        self._state = state
        self._session = GymSession(form, limits, recorder)
        self._protocol = Protocol(Side.SERVER, state=Connected.OPEN, max_size=limits.message_bytes, logger=_silent())
        self._most = limits.message_bytes
        self._incomplete = b""
        self._fragments: list[bytes] = []
        self._text = True
        self._seconds = limits.seconds
        self._in_request = False

    def run(self, received: bytes) -> None:
        """Answer requests until the connection ends. `received` are the bytes that the client has sent already."""
        signal.signal(signal.SIGALRM, self._too_slow)
        try:
            self._receive(received)
            while True:
                self._receive(self._read())
        except ConnectionGone:
            pass
        except OSError as error:
            if error.errno == errno.EBADF:  # the environment has closed the socket; the server tells the client
                raise
        finally:
            self._state.work()  # so that the limit of time holds for closing environments, too
            self._session.end()
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)

    def _read(self) -> bytes:
        data = self._socket.recv(_READ)
        if not data:
            raise ConnectionGone
        return data

    def _receive(self, data: bytes) -> None:
        """Handle bytes that were read: requests of one frame here, all other frames by `websockets`."""
        if self._incomplete:
            data = self._incomplete + data
        while data:
            start, length = frames.extent(data)
            end = start + length
            if start and length > self._most:
                self._other_frames(data)  # `websockets` refuses it
                raise ConnectionGone
            if not start or len(data) < end:
                break
            masked = start > frames.UNMASKED[data[1] & 0x7F]
            if data[0] in frames.WHOLE and masked and not self._fragments:
                self._answer(data[0] == frames.TEXT, frames.unmasked(data[start:end], data[start - 4 : start]))
            else:
                self._other_frames(data[:end])
            data = data[end:]
        self._incomplete = data

    def _other_frames(self, data: bytes) -> None:
        protocol = self._protocol
        protocol.receive_data(data)
        for event in protocol.events_received():
            frame: Any = event
            if frame.opcode is Opcode.TEXT or frame.opcode is Opcode.BINARY:
                self._text = frame.opcode is Opcode.TEXT
                self._fragments = [bytes(frame.data)]
            elif frame.opcode is Opcode.CONT:
                self._fragments.append(bytes(frame.data))
                if frame.fin:
                    whole, self._fragments = b"".join(self._fragments), []
                    self._answer(self._text, whole)
        self._flush()

    def _answer(self, text: bool, data: bytes) -> None:
        self._state.work()
        try:
            reply = self._carry_out(text, data)
        except GymError as error:
            self._failed(error)
            return
        except UnicodeDecodeError:
            self._protocol.fail(CloseCode.INVALID_DATA, "The message is not UTF-8.")
            self._flush()
            return
        except BaseException as error:  # noqa: BLE001 - raised by a value that the environment returned
            self._failed(EnvironmentFailed(f"What the environment returned cannot be sent: {described(error)}"))
            return
        finally:
            self._state.rest()
        self._send(reply)

    def _carry_out(self, text: bool, data: bytes) -> str | bytes:
        """Carry out a request and return the reply. Only meanwhile does `_too_slow` interrupt."""
        self._in_request = True
        try:
            return self._session.answer(data.decode()) if text else self._session.answer_arrays(data)
        finally:
            self._in_request = False

    def _failed(self, error: GymError) -> None:
        if self._form.closes:
            self._protocol.send_close(error.code, reason(error.brief))
            self._flush()
        else:
            self._send(values.to_text({"error": {"type": type(error).__name__, "message": str(error)}}))

    def _send(self, reply: str | bytes) -> None:
        if isinstance(reply, str):
            self._socket.sendall(frames.framed(frames.TEXT, reply.encode()))
        else:
            self._socket.sendall(frames.framed(frames.BINARY, reply))

    def _flush(self) -> None:
        """Send the frames that `websockets` has made. Raises ConnectionGone after a close."""
        for part in self._protocol.data_to_send():
            if part:
                self._socket.sendall(part)
        if self._protocol.close_sent is not None:
            self._drain()
            raise ConnectionGone

    def _drain(self) -> None:
        """Read on for a moment after a close: if received bytes stay unread, the system discards bytes to be sent."""
        self._socket.shutdown(socket.SHUT_WR)
        self._socket.settimeout(_CLOSE_SECONDS)
        until = time.monotonic() + _CLOSE_SECONDS
        while time.monotonic() < until:
            self._read()

    def _too_slow(self, _: int, __: FrameType | None) -> None:
        """Interrupt Python code, at the spawner's SIGALRM. The spawner kills code in C two seconds later."""
        if self._in_request:
            self._in_request = False
            raise TooSlow(
                f"The environment took longer than {self._seconds:g} s, and was interrupted; reset or close it."
            )


def main(
    connection: socket.socket,
    received: bytes,
    form: MessageForm,
    limits: Limits,
    state: WorkerState,
    *,
    output: bool,
    record: Path | None,
) -> None:
    """Serve this connection in this new process, which must end afterwards. `record` is a folder for recordings."""
    os.setsid()
    linux.become_subreaper()
    linux.die_with_parent()
    if not output:
        _discard_output()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    linux.limit_memory(limits.megabytes)
    connection.setblocking(True)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", _SEND_SECONDS, 0))
    recorder = None if record is None else ConnectionRecorder(record)
    ConnectionWorker(connection, form, limits, state, recorder).run(received)


def _discard_output() -> None:
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    for number in (0, 1, 2):
        os.dup2(nothing, number)
    os.close(nothing)


def _silent() -> logging.Logger:
    logger = logging.getLogger("trial.gym.websockets")
    logger.setLevel(logging.CRITICAL + 1)
    return logger
