"""Requests in every shape that the protocol allows a message to have, and in some that it does not."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest
from websockets.client import ClientProtocol
from websockets.frames import Frame, Opcode
from websockets.uri import parse_uri

from testing.gym_server import GymServerProcess

WITHIN = 15.0


class RawConnection:
    """A connection whose bytes a test chooses."""

    def __init__(self, server: GymServerProcess) -> None:
        self.socket = socket.create_connection(("127.0.0.1", server.port), WITHIN)
        self.protocol = ClientProtocol(parse_uri(server.url + "?form=gymnasium"), max_size=None)
        self.protocol.send_request(self.protocol.connect())
        self.socket.sendall(b"".join(self.protocol.data_to_send()))
        self.protocol.receive_data(self.socket.recv(65536))
        self.protocol.events_received()

    def say(self, *pieces: bytes) -> None:
        for piece in pieces:
            self.socket.sendall(piece)

    def hear(self) -> Frame:
        """Return the next frame, also a close frame; EOFError at the end of the connection."""
        while not (events := self.protocol.events_received()):
            data = self.socket.recv(65536)
            if not data:
                raise EOFError
            self.protocol.receive_data(data)
        (frame,) = events
        assert isinstance(frame, Frame)
        return frame


@pytest.fixture
def raw(server: GymServerProcess) -> Iterator[RawConnection]:
    found = RawConnection(server)
    yield found
    found.socket.close()


def frame(said: bytes, opcode: Opcode = Opcode.TEXT, fin: bool = True) -> bytes:
    return Frame(opcode, said, fin).serialize(mask=True)


UNKNOWN = b'{"method": "none", "params": {}}'


def test_a_request_sent_byte_by_byte_is_answered(raw: RawConnection) -> None:
    raw.say(*(bytes([byte]) for byte in frame(UNKNOWN)))
    assert b"MethodNotFound" in raw.hear().data


def test_a_request_in_fragments_with_a_ping_between_them_is_answered(raw: RawConnection) -> None:
    raw.say(frame(UNKNOWN[:9], fin=False), frame(b"are you there", Opcode.PING))
    pong = raw.hear()
    assert (pong.opcode, pong.data) == (Opcode.PONG, b"are you there")
    raw.say(frame(UNKNOWN[9:20], Opcode.CONT, fin=False), frame(UNKNOWN[20:], Opcode.CONT))
    assert b"MethodNotFound" in raw.hear().data


@pytest.mark.parametrize("length", [0, 1, 125, 126, 65535, 65536, 200_000])
def test_requests_of_every_length_are_answered(raw: RawConnection, length: int) -> None:
    raw.say(frame(b"x" * length))
    assert b"InvalidMessage" in raw.hear().data
    raw.say(frame(b"x" * length, Opcode.BINARY))
    assert b"Binary messages are for" in raw.hear().data


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        (Frame(Opcode.TEXT, UNKNOWN).serialize(mask=False), 1002),
        (b"\x91" + frame(UNKNOWN)[1:], 1002),  # a reserved bit
        (b"\x83" + frame(UNKNOWN)[1:], 1002),  # a reserved opcode
        (frame(UNKNOWN, Opcode.CONT), 1002),
        (b"\x09\x80\x00\x00\x00\x00", 1002),  # a ping in fragments
        (frame(b"\xff\xfe"), 1007),
        (b"\x81\xff" + (2**62).to_bytes(8, "big") + bytes(4), 1009),
        (b"\x01\xff" + (2**62).to_bytes(8, "big") + bytes(4), 1009),
    ],
    ids=["unmasked", "reserved bit", "reserved opcode", "continues nothing", "ping", "no UTF-8", "huge", "huge part"],
)
@pytest.mark.parametrize("first", [b"", frame(UNKNOWN)], ids=["at first", "later"])
def test_a_frame_that_the_protocol_forbids_closes_with_its_code(
    raw: RawConnection, first: bytes, wrong: bytes, code: int
) -> None:
    if first:
        raw.say(first)
        raw.hear()
    raw.say(wrong)
    found = raw.hear()
    assert (found.opcode, int.from_bytes(found.data[:2], "big")) == (Opcode.CLOSE, code)


def test_fragments_that_are_too_large_together_close_the_connection(raw: RawConnection) -> None:
    raw.say(frame(b"x" * 3_000_000, fin=False), frame(b"x" * 3_000_000, Opcode.CONT))
    assert raw.hear().opcode is Opcode.CLOSE


def test_a_close_is_answered(raw: RawConnection) -> None:
    raw.say(frame(UNKNOWN))
    raw.hear()
    raw.say(frame(b"\x03\xe8", Opcode.CLOSE))
    assert raw.hear().data == b"\x03\xe8"
    assert raw.socket.recv(1) == b""
