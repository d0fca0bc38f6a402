"""Reads the lines of a recording (gzip of JSON lines, `docs/data.md`).

The recording is read in pieces, so that memory is bounded however long it is.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

_PIECE = 256 * 1024  # bytes
_MAX_LINE = 64 * 1024 * 1024  # bytes


def lines(source: Path, problems: list[str]) -> Iterator[dict[str, Any]]:
    """Yield the lines of a recording, up to the place where it cannot be read. Adds a sentence to `problems` for each
    line that is left out, and for a recording that cannot be read to its end."""
    for text in texts(source, problems):
        line = parsed(text)
        if line is not None:
            yield line
        elif text.strip():
            problems.append("a line that is no JSON object was left out")


def texts(source: Path, problems: list[str]) -> Iterator[bytes]:
    """Yield the same lines as bytes, without their line ends. Adds to `problems` as `lines` does."""
    begun: list[bytes] = []  # the parts of a line whose end was not read yet
    length = 0
    for piece in _unpacked(source, problems):
        first, *whole = piece.split(b"\n")
        begun.append(first)
        length += len(first)
        if length > _MAX_LINE:
            problems.append("a line is too long; it and the lines after it were not read")
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
                    problems.append("the file is damaged: only the lines before the damage are kept")
                    return
                yield piece
                packed = unpack.unused_data if unpack.eof else unpack.unconsumed_tail
        while begun and not unpack.eof:  # the end may not have fitted into the last piece
            piece = unpack.decompress(b"", 4 * _PIECE)
            if not piece:
                break
            yield piece
    if not begun:
        problems.append("the file is empty")
    elif not unpack.eof:
        problems.append("the recording was cut off: it ends early")


def parsed(text: bytes) -> dict[str, Any] | None:
    """Return the JSON object in a line; None if there is none."""
    line: Any
    try:
        line = msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
        try:  # json accepts NaN and unpaired surrogates, which msgspec refuses
            line = json.loads(text)
        except (ValueError, RecursionError):
            return None
    return line if isinstance(line, dict) else None
