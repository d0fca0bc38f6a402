"""The WebSocket of environments byte by byte (RFC 6455): right frames are answered, wrong ones close the connection with their code."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import random
import socket
import struct
import time
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import pytest

from testing.waiting import PATIENCE
from tests.trial.gym.served import serving

CONT, TEXT, BINARY, CLOSE, PING, PONG = 0, 1, 2, 8, 9, 10
MAKE = b'{"method": "make", "params": {"env_id": "CartPole-v1"}}'
UNKNOWN = b'{"method": "step", "params": {"instance_id": "none", "action": 0}}'


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with serving("--message-bytes", "100000") as (address, _):
        found = urlsplit(address).port
        assert found is not None
        yield found


class Wire:
    """A client that sends bytes, and reads frames."""

    def __init__(self, port: int, query: str = "?form=gymnasium") -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = [f"GET /gym{query} HTTP/1.1", "Host: localhost", "Upgrade: websocket", "Connection: Upgrade"]
        lines += [f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13", "", ""]
        self.send("\r\n".join(lines).encode())
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            head += self.exactly(1)
        assert head.startswith(b"HTTP/1.1 101 ")

    def close(self) -> None:
        self.socket.close()

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self.socket.recv(count - len(data))
            if not part:
                raise EOFError
            data += part
        return data

    def frame(self) -> tuple[int, bytes]:
        """Return the next frame that the server sends: its opcode and its payload; it must be whole and unmasked."""
        first, length = self.exactly(2)
        assert first & 0xF0 == 0x80
        assert length < 0x80
        if length == 126:
            length = struct.unpack("!H", self.exactly(2))[0]
        elif length == 127:
            length = struct.unpack("!Q", self.exactly(8))[0]
        return first & 0x0F, self.exactly(length)

    def answer(self) -> Any:
        opcode, payload = self.frame()
        assert opcode == TEXT, (opcode, payload)
        return json.loads(payload)

    def closed(self) -> int:
        """Return the code with which the server closes; assert that nothing follows."""
        opcode, payload = self.frame()
        assert opcode == CLOSE, (opcode, payload)
        with contextlib.suppress(OSError):
            self.send(frame(CLOSE, payload[:2]))
        with contextlib.suppress(ConnectionResetError), pytest.raises(EOFError):
            self.frame()
        return int(struct.unpack("!H", payload[:2])[0])


def frame(
    opcode: int, payload: bytes = b"", *, fin: bool = True, bits: int = 0, mask: bool = True, size: int = 0
) -> bytes:
    """Return a client's frame; `size` 2 or 8 writes the length in so many bytes, whether needed or not."""
    first = (0x80 if fin else 0) | bits << 4 | opcode
    length = len(payload)
    size = size or (0 if length < 126 else 2 if length < 2**16 else 8)
    head = bytes([first, (0x80 if mask else 0) | {0: length, 2: 126, 8: 127}[size]])
    head += b"" if size == 0 else struct.pack("!H" if size == 2 else "!Q", length)
    if not mask:
        return head + payload
    key = os.urandom(4)
    return head + key + bytes(byte ^ key[at % 4] for at, byte in enumerate(payload))


@pytest.fixture(params=[False, True], ids=["first", "later"])
def wire(port: int, request: pytest.FixtureRequest) -> Iterator[Wire]:
    """A connection that has asked for nothing yet, and one that has an environment."""
    found = Wire(port)
    if request.param:
        found.send(frame(TEXT, MAKE))
        assert "instance_id" in found.answer()
    try:
        yield found
    finally:
        found.socket.close()


def refused(wire: Wire) -> str:
    return str(wire.answer()["error"]["type"])


def test_a_message_in_fragments_with_pings_between_is_answered(wire: Wire) -> None:
    wire.send(frame(TEXT, UNKNOWN[:5], fin=False) + frame(PING, b"a") + frame(CONT, UNKNOWN[5:9], fin=False))
    wire.send(frame(PONG, b"unasked") + frame(CONT, b"", fin=False) + frame(CONT, UNKNOWN[9:]))
    assert wire.frame() == (PONG, b"a")
    assert refused(wire) == "InstanceNotFound"


def test_a_message_sent_byte_by_byte_is_answered(wire: Wire) -> None:
    for byte in frame(TEXT, UNKNOWN):
        wire.send(bytes([byte]))
        time.sleep(0.0005)
    assert refused(wire) == "InstanceNotFound"


def test_a_character_split_over_two_fragments_is_read(wire: Wire) -> None:
    message = '{"method": "é", "params": {}}'.encode()
    cut = message.index("é".encode()) + 1
    wire.send(frame(TEXT, message[:cut], fin=False) + frame(CONT, message[cut:]))
    assert wire.answer()["error"]["message"] == "Method `é` not found"


def test_many_requests_at_once_are_answered_in_order(wire: Wire) -> None:
    methods = [f"unknown{number}" for number in range(300)]
    wire.send(b"".join(frame(TEXT, json.dumps({"method": name, "params": {}}).encode()) for name in methods))
    for name in methods:
        assert wire.answer()["error"]["message"] == f"Method `{name}` not found"


@pytest.mark.parametrize("size", [2, 8])
def test_a_length_in_more_bytes_than_it_needs_is_read_or_refused(wire: Wire, size: int) -> None:
    """RFC 6455, 5.2, wants the least number of bytes; either way, the server must not misread what follows."""
    wire.send(frame(TEXT, UNKNOWN, size=size) + frame(PING, b"after"))
    opcode, _ = wire.frame()
    if opcode == TEXT:
        assert wire.frame() == (PONG, b"after")
    else:
        assert opcode == CLOSE


def test_a_message_of_the_greatest_length_is_read(wire: Wire) -> None:
    message = b'{"method": "' + b"x" * (100_000 - 28) + b'", "params": {}}'
    assert len(message) == 100_000
    wire.send(frame(TEXT, message))
    assert refused(wire) == "MethodNotFound"


def test_an_empty_message_gets_an_error(wire: Wire) -> None:
    wire.send(frame(TEXT) + frame(BINARY))
    assert refused(wire) == "InvalidMessage"
    assert refused(wire) == "InvalidMessage"


def test_a_ping_is_answered_and_a_pong_is_not(wire: Wire) -> None:
    wire.send(frame(PONG, b"b") + frame(PING, b"c" * 125) + frame(PING))
    assert wire.frame() == (PONG, b"c" * 125)
    assert wire.frame() == (PONG, b"")


def test_a_close_is_answered(wire: Wire) -> None:
    wire.send(frame(CLOSE, struct.pack("!H", 1000) + b"done"))
    assert wire.closed() == 1000


def test_a_close_without_a_code_is_answered(wire: Wire) -> None:
    wire.send(frame(CLOSE))
    opcode, _ = wire.frame()
    assert opcode == CLOSE


WRONG = {
    "not masked": (frame(TEXT, UNKNOWN, mask=False), 1002),
    "first reserved bit": (frame(TEXT, UNKNOWN, bits=4), 1002),
    "second reserved bit": (frame(TEXT, UNKNOWN, bits=2), 1002),
    "unknown data": (frame(3, UNKNOWN), 1002),
    "unknown control": (frame(11), 1002),
    "ping in fragments": (frame(PING, b"a", fin=False), 1002),
    "long ping": (frame(PING, b"a" * 126), 1002),
    "long close": (frame(CLOSE, b"\x03\xe8" + b"a" * 124), 1002),
    "close of one byte": (frame(CLOSE, b"\x03"), 1002),
    "close with a code that is never sent": (frame(CLOSE, struct.pack("!H", 1005)), 1002),
    "close with no text": (frame(CLOSE, struct.pack("!H", 1000) + b"\xff"), 1007),
    "continuation of nothing": (frame(CONT, b"a"), 1002),
    "text within a fragmented text": (frame(TEXT, b"a", fin=False) + frame(TEXT, b"a"), 1002),
    "no text": (frame(TEXT, b'{"method": "\xff"}'), 1007),
    "too long": (frame(TEXT, b"a" * 100_001), 1009),
    "too long in fragments": (frame(TEXT, b"a" * 60_000, fin=False) + frame(CONT, b"a" * 60_000), 1009),
    "too long, and never sent": (b"\x81\xff" + struct.pack("!Q", 2**62) + b"1234", 1009),
    "a length with its first bit set": (b"\x81\xff" + struct.pack("!Q", 2**63) + b"1234", 1002),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_frame_closes_the_connection_with_its_code(wire: Wire, name: str) -> None:
    data, code = WRONG[name]
    wire.send(data)
    found = wire.closed()
    # websockets counts an impossible length as too long; RFC 6455, 7.4.1, allows either.
    assert found == code or (name == "a length with its first bit set" and found == 1009)


WRONG_HANDSHAKES = {
    "an address that is none": ("//[", ""),
    "a host that is none": ("http://[/gym", ""),
    "an origin that is none": ("/gym", "Origin: http://[\r\n"),
    "two origins": ("/gym", "Origin: http://localhost\r\nOrigin: https://example.org\r\n"),
    "two upgrades": ("/gym", "Upgrade: websocket\r\n"),
    "two keys": ("/gym", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"),
    "two versions": ("/gym", "Sec-WebSocket-Version: 13\r\n"),
    "a query that is none": ("/gym?" + "&".join(["form=gymnasium;a=%ff"] * 200), ""),
    "a length that is none": ("/gym", "Content-Length: x\r\n"),
    "an extension that is none": ("/gym", "Sec-WebSocket-Extensions: ;;\r\n"),
    "a subprotocol that is none": ("/gym", "Sec-WebSocket-Protocol: ,;,\r\n"),
}


@pytest.mark.parametrize("name", WRONG_HANDSHAKES)
def test_a_wrong_handshake_is_answered_and_ends_nothing_else(port: int, name: str) -> None:
    target, more = WRONG_HANDSHAKES[name]
    with contextlib.closing(Wire(port)) as other:
        with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as raw:
            key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
            upgrade = "Host: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            raw.sendall(f"GET {target} HTTP/1.1\r\n{upgrade}{key}{more}\r\n".encode())
            status = int(raw.recv(4096).split()[1])
        assert status in (101, 400, 403, 404)
        other.send(frame(TEXT, UNKNOWN))
        assert refused(other) == "InstanceNotFound"


def test_random_bytes_end_one_connection_and_no_other(port: int) -> None:
    chance = random.Random(1)
    with contextlib.closing(Wire(port).socket):
        for _ in range(60):
            wire = Wire(port)
            if chance.random() < 0.5:
                wire.send(frame(TEXT, MAKE))
                wire.answer()
            with contextlib.suppress(OSError):
                wire.send(chance.randbytes(chance.choice([1, 2, 7, 50, 5000])))
            if chance.random() < 0.5:
                with contextlib.suppress(OSError):
                    wire.socket.shutdown(socket.SHUT_WR)
            wire.socket.close()
    other = Wire(port)
    other.send(frame(TEXT, MAKE))
    assert "instance_id" in other.answer()
    other.socket.close()
