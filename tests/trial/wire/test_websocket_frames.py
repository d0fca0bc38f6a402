"""Frames of a WebSocket are read and written as the package `websockets` does it."""

from __future__ import annotations

import pytest
from websockets.frames import Frame, Opcode

from trial.wire import websocket_frames as frames


@pytest.mark.parametrize("length", [0, 125, 126, 65535, 65536])
def test_frames_are_written_as_websockets_does(length: int) -> None:
    assert frames.framed(frames.BINARY, bytes(length)) == Frame(Opcode.BINARY, bytes(length)).serialize(mask=False)


@pytest.mark.parametrize("length", [0, 1, 12, 125])
def test_a_short_text_is_read(length: int) -> None:
    said = b"x" * length
    data = Frame(Opcode.TEXT, said).serialize(mask=True)
    assert frames.short_text(data) == said


@pytest.mark.parametrize("length", [0, 1, 12, 125])
def test_a_part_of_a_short_text_or_more_than_one_is_no_short_text(length: int) -> None:
    data = Frame(Opcode.TEXT, b"x" * length).serialize(mask=True)
    assert [frames.short_text(part) for part in (data[:-1], data + b"x", data + data, b"")] == 4 * [None]


@pytest.mark.parametrize(
    "frame",
    [
        Frame(Opcode.BINARY, b"x"),
        Frame(Opcode.TEXT, b"x", fin=False),
        Frame(Opcode.CONT, b"x"),
        Frame(Opcode.PING, b"x"),
        Frame(Opcode.CLOSE, b"\x03\xe8"),
        Frame(Opcode.TEXT, b"x", rsv1=True),
        *(Frame(Opcode.TEXT, b"x" * length) for length in (126, 127, 128, 254, 255, 256, 65_536)),
    ],
    ids=lambda frame: f"{frame.opcode.name} {len(frame.data)}",
)
def test_every_other_frame_is_no_short_text(frame: Frame) -> None:
    data = bytearray(Frame(frame.opcode, frame.data, frame.fin).serialize(mask=True))
    data[0] |= 0x40 * frame.rsv1  # the package writes none with this bit
    assert frames.short_text(bytes(data)) is None


def test_a_frame_without_a_mask_is_no_short_text() -> None:
    data = Frame(Opcode.TEXT, b"x" * 12).serialize(mask=False)
    assert frames.short_text(data) is None


def test_a_frame_of_another_length_than_it_says_is_no_short_text() -> None:
    assert frames.short_text(bytes((frames.TEXT, 0x80)) + bytes(4 + 128)) is None
