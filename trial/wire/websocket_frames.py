"""Frames of a WebSocket (RFC 6455, 5.2), as far as the usual messages need them. Pure.

The package `websockets` reads and writes every other frame. For a message of a hundred bytes that costs it as much as
a step of a small environment. So the one case that nearly all messages are is taken here: pictures and their
acknowledgements (`player_socket.py`), and requests at `/gym` with their answers (`trial/gym/worker.py`).
"""

from __future__ import annotations

import struct

try:
    from websockets.speedups import apply_mask as unmasked
except ImportError:  # a platform for which `websockets` has no wheel
    from websockets.utils import apply_mask as unmasked

__all__ = ["BINARY", "TEXT", "UNMASKED", "WHOLE", "extent", "framed", "short_text", "unmasked"]

TEXT, BINARY = 0x81, 0x82
"""First bytes of a message in one frame."""
WHOLE = (TEXT, BINARY)

UNMASKED = [2] * 126 + [4, 10]
"""Where what a frame holds begins, by the seven bits of its length, if it is not masked."""

_MASKED_HEADER = 6  # bytes before a short text of a client: two, and the mask
_MIDDLE = struct.Struct("!BBH")
_LONG = struct.Struct("!BBQ")


def extent(data: bytes) -> tuple[int, int]:
    """Where what the first frame holds begins, and its length; (0, 0) if too little of it is there to tell."""
    if len(data) < 2:
        return 0, 0
    length = data[1] & 0x7F
    start = UNMASKED[length]
    if len(data) < start:
        return 0, 0
    if length > 125:
        length = int.from_bytes(data[2:start], "big")
    return start + (4 if data[1] & 0x80 else 0), length


def short_text(data: bytes) -> bytes | bytearray | None:
    """What a client says, if the data are just one whole text message of up to 125 bytes."""
    length = len(data) - _MASKED_HEADER
    if not 0 <= length <= 125 or data[0] != TEXT or data[1] != 0x80 | length:
        return None
    return unmasked(data[_MASKED_HEADER:], data[2:_MASKED_HEADER])


def framed(first: int, payload: bytes) -> bytes:
    """A frame of a server, which is not masked."""
    length = len(payload)
    if length < 126:
        return bytes((first, length)) + payload
    if length < 65536:
        return _MIDDLE.pack(first, 126, length) + payload
    return _LONG.pack(first, 127, length) + payload
