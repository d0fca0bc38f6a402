"""The messages between the server and its spawner over a Unix socket: new connections, and the ends of workers."""

from __future__ import annotations

import socket
import struct
from typing import NamedTuple

_START = struct.Struct("<IHI")  # number, length of the form's name, length of the received bytes
_ENDED = struct.Struct("<IHH")  # number, close code, length of the sentence


class NewConnection(NamedTuple):
    """A connection that needs a worker. `received` are the bytes that the client has sent after its handshake."""

    number: int
    form: str
    received: bytes
    connection: socket.socket


class Ended(NamedTuple):
    """A connection's worker has ended, or could not be started: a close code and a sentence for its client.

    The code is 0 if the worker has ended by itself, since the connection was over. The number is 0 in the spawner's
    first message, which says that it is ready.
    """

    number: int
    code: int
    sentence: str

    def packed(self) -> bytes:
        """Write the message as bytes."""
        sentence = self.sentence.encode()[:1000]
        return _ENDED.pack(self.number, self.code, len(sentence)) + sentence


def send(control: socket.socket, start: NewConnection) -> None:
    """Send a connection to the spawner. The caller's own descriptor of the connection stays open. Raises OSError."""
    name = start.form.encode()
    header = _START.pack(start.number, len(name), len(start.received))
    sent = socket.send_fds(control, [header], [start.connection.fileno()])
    control.sendall(header[sent:] + name + start.received)


def receive(control: socket.socket) -> NewConnection | None:
    """Receive the next connection; None if the server has ended."""
    header, descriptors, _, _ = socket.recv_fds(control, _START.size, 1)
    if not header or not descriptors:
        return None
    header += _exactly(control, _START.size - len(header))
    number, form_length, received_length = _START.unpack(header)
    form = _exactly(control, form_length).decode()
    return NewConnection(number, form, _exactly(control, received_length), socket.socket(fileno=descriptors[0]))


def read_ended(buffer: bytearray) -> Ended | None:
    """Take the next message of the spawner out of `buffer`; None if it is not complete yet."""
    if len(buffer) < _ENDED.size:
        return None
    number, code, length = _ENDED.unpack_from(buffer)
    end = _ENDED.size + length
    if len(buffer) < end:
        return None
    sentence = bytes(buffer[_ENDED.size : end]).decode("utf-8", "replace")
    del buffer[:end]
    return Ended(number, code, sentence)


def _exactly(control: socket.socket, count: int) -> bytes:
    """Receive `count` bytes. Raises EOFError if the server has ended."""
    parts = []
    while count:
        part = control.recv(count)
        if not part:
            raise EOFError("the server has ended")
        parts.append(part)
        count -= len(part)
    return b"".join(parts)
