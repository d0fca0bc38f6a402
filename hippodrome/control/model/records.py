"""Reads and writes records as JSON documents: camelCase keys, times in ISO 8601; unknown keys are ignored.

No other module decodes JSON into records. msgspec 0.22 shares its information on a Struct between threads before that
information is complete: a process dies with a segmentation fault if two threads decode one type of record for the first
time at the same moment. The lock here prevents that.
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
_making = threading.Lock()  # held while msgspec inspects a type of record, and the types of its fields


def to_json(record: Record) -> bytes:
    """Return the record as JSON, indented so that a researcher can read it."""
    return msgspec.json.format(_encoder.encode(record), indent=1)


def from_json(body: bytes, kind: type[T]) -> T:
    """Return the record in a document.

    Raises ValueError if the document holds no such record: `msgspec.DecodeError`, or `UnicodeDecodeError` if it is not
    UTF-8.
    """
    try:
        return _decoder(kind).decode(body)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def from_data(data: Any, kind: type[T]) -> T:
    """Return the record in plain JSON data.

    Raises ValueError if the data are no such record: `msgspec.ValidationError`, or `UnicodeEncodeError` for a text with
    half of a surrogate pair.
    """
    _decoder(kind)
    try:
        return msgspec.convert(data, kind)
    except RecursionError:
        raise ValueError("they are nested too deep") from None


def _decoder(kind: type[T]) -> msgspec.json.Decoder[T]:
    if kind not in _decoders:
        with _making:
            _decoders[kind] = msgspec.json.Decoder(kind)
    return _decoders[kind]
