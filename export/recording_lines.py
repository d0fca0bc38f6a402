"""The lines of a recording (gzip of JSON lines, `docs/data.md`).

It is read in pieces, so that memory stays bounded however long it is.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

_PIECE = 256 * 1024  # bytes
_LONGEST = 64 * 1024 * 1024  # bytes in a line


def lines(source: Path, problems: list[str]) -> Iterator[dict[str, Any]]:
    """The lines of a recording, up to where it can be read; what was in the way is added to `problems`."""
    for text in texts(source, problems):
        line = parsed(text)
        if line is not None:
            yield line
        elif text.strip():
            problems.append("a line that is no JSON object was left out")


def texts(source: Path, problems: list[str]) -> Iterator[bytes]:
    """The same lines as they are written, without their ends."""
    begun: list[bytes] = []  # of a line whose end has not come yet
    length = 0
    for piece in _unpacked(source, problems):
        first, *whole = piece.split(b"\n")
        begun.append(first)
        length += len(first)
        if length > _LONGEST:
            problems.append("a line is too long to be one; nothing behind it was read")
            return
        if not whole:
            continue
        whole, rest = [b"".join(begun), *whole[:-1]], whole[-1]
        begun, length = [rest], len(rest)
        yield from whole
    if b"".join(begun).strip():
        problems.append("the last line is cut off and was left out")


def _unpacked(source: Path, problems: list[str]) -> Iterator[bytes]:
    unpack = zlib.decompressobj(31)
    begun = False
    with source.open("rb") as file:
        while packed := file.read(_PIECE):
            while packed:
                if unpack.eof:  # another gzip member follows
                    unpack, begun = zlib.decompressobj(31), False
                begun = True
                try:
                    piece = unpack.decompress(packed, 4 * _PIECE)
                except zlib.error:
                    problems.append("the file is damaged: what comes before that place is kept")
                    return
                yield piece
                packed = unpack.unused_data if unpack.eof else unpack.unconsumed_tail
        while begun and not unpack.eof:  # what a full output buffer has held back
            piece = unpack.decompress(b"", 4 * _PIECE)
            if not piece:
                break
            yield piece
    if not begun:
        problems.append("the file is empty")
    elif not unpack.eof:
        problems.append("the recording was cut off: it ends early")


def parsed(text: bytes) -> dict[str, Any] | None:
    """The JSON object in a line; None if the line holds no JSON object."""
    line: Any
    try:
        line = msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
        try:  # json takes NaN and lone surrogates, which msgspec refuses
            line = json.loads(text)
        except (ValueError, RecursionError):
            return None
    return line if isinstance(line, dict) else None
