"""Reads and writes the usual frames of a WebSocket (RFC 6455, 5.2): messages of one frame. Pure.

The package `websockets` handles all other frames. For a message of a hundred bytes it takes as long as a step of a
small environment. So this module handles the most frequent messages: pictures and their acknowledgements
(`player_socket.py`).
"""

from __future__ import annotations

import struct

try:
    from websockets.speedups import apply_mask as unmasked
except ImportError:  # a platform for which `websockets` has no wheel
    from websockets.utils import apply_mask as unmasked

TEXT, BINARY = 0x81, 0x82
"""The first byte of a message in one frame."""

_MASKED_HEADER = 6  # bytes before a short text of a client: two, and the mask
_MIDDLE = struct.Struct("!BBH")
_LONG = struct.Struct("!BBQ")


def short_text(data: bytes) -> bytes | bytearray | None:
    """Return the payload if the data are exactly one text message of a client, of at most 125 bytes; else None."""
    length = len(data) - _MASKED_HEADER
    if not 0 <= length <= 125 or data[0] != TEXT or data[1] != 0x80 | length:
        return None
    return unmasked(data[_MASKED_HEADER:], data[2:_MASKED_HEADER])


def framed(first: int, payload: bytes) -> bytes:
    """Build a frame of a server, which has no mask. `first` is its first byte: TEXT or BINARY."""
    length = len(payload)
    if length < 126:
        return bytes((first, length)) + payload
    if length < 65536:
        return _MIDDLE.pack(first, 126, length) + payload
    return _LONG.pack(first, 127, length) + payload
