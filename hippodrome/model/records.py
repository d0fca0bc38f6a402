"""Records as JSON documents: camelCase keys, times in ISO 8601, unknown keys are ignored.

Nothing else reads into types: msgspec 0.22 shares what it knows of a Struct before it knows all of it, so a process
ends with a segmentation fault where two threads read one kind of record for the first time at the same moment.
"""

from __future__ import annotations

import threading
from typing import Any, TypeVar

import msgspec

T = TypeVar("T")


class Record(msgspec.Struct, frozen=True, omit_defaults=True, rename="camel"):
    """Base of every stored record. Immutable: a transition returns a new one."""


_encoder = msgspec.json.Encoder()
_decoders: dict[Any, msgspec.json.Decoder[Any]] = {}
_making = threading.Lock()  # one thread at a time has msgspec look at types, and at those within them


def to_json(record: Record) -> bytes:
    """The record as JSON, indented so that a researcher can read it."""
    return msgspec.json.format(_encoder.encode(record), indent=1)


def from_json(body: bytes, kind: type[T]) -> T:
    """The record in a document. Raises `msgspec.DecodeError` (a ValueError) if it is not one, or RecursionError."""
    return _decoder(kind).decode(body)


def from_data(data: Any, kind: type[T]) -> T:
    """The record in plain JSON data. Raises `msgspec.ValidationError` (a ValueError), or RecursionError."""
    _decoder(kind)
    return msgspec.convert(data, kind)


def _decoder(kind: type[T]) -> msgspec.json.Decoder[T]:
    if kind not in _decoders:
        with _making:
            _decoders[kind] = msgspec.json.Decoder(kind)
    return _decoders[kind]
