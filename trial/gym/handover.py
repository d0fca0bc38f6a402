"""What the server and its spawner say to each other, over a Unix socket: connections one way, their ends the other."""

from __future__ import annotations

import socket
import struct
from typing import NamedTuple

_START = struct.Struct("<IHI")  # number, length of the form's name, length of what was received
_ENDED = struct.Struct("<IHH")  # number, close code, length of the sentence


class NewConnection(NamedTuple):
    """A connection that needs a worker. `number` names it; `received` are bytes that the client has sent already."""

    number: int
    form: str
    received: bytes
    connection: socket.socket


class Ended(NamedTuple):
    """A worker has ended, with a code and a sentence for its client, or 0 and nothing. Number 0: the spawner began."""

    number: int
    code: int
    words: str

    def packed(self) -> bytes:
        """As bytes."""
        words = self.words.encode()[:1000]
        return _ENDED.pack(self.number, self.code, len(words)) + words


def send(control: socket.socket, start: NewConnection) -> None:
    """Hand a connection over. The caller's own descriptor of it stays open. Raises OSError."""
    name = start.form.encode()
    header = _START.pack(start.number, len(name), len(start.received))
    sent = socket.send_fds(control, [header], [start.connection.fileno()])
    control.sendall(header[sent:] + name + start.received)


def receive(control: socket.socket) -> NewConnection | None:
    """The next connection; None if the server is gone."""
    header, found, _, _ = socket.recv_fds(control, _START.size, 1)
    if not header or not found:
        return None
    header += _exactly(control, _START.size - len(header))
    number, name, received = _START.unpack(header)
    form = _exactly(control, name).decode()
    return NewConnection(number, form, _exactly(control, received), socket.socket(fileno=found[0]))


def read_ended(buffer: bytearray) -> Ended | None:
    """Take the next message out of what the spawner has sent; None if it is not complete yet."""
    if len(buffer) < _ENDED.size:
        return None
    number, code, length = _ENDED.unpack_from(buffer)
    end = _ENDED.size + length
    if len(buffer) < end:
        return None
    words = bytes(buffer[_ENDED.size : end]).decode("utf-8", "replace")
    del buffer[:end]
    return Ended(number, code, words)


def _exactly(control: socket.socket, count: int) -> bytes:
    parts = []
    while count:
        part = control.recv(count)
        if not part:
            raise EOFError("the server is gone")
        parts.append(part)
        count -= len(part)
    return b"".join(parts)
