"""How records become JSON documents and back: camelCase keys, times in ISO 8601, unknown keys ignored."""

from __future__ import annotations

from typing import TypeVar

import msgspec

T = TypeVar("T", bound="Record")


class Record(msgspec.Struct, frozen=True, omit_defaults=True, rename="camel"):
    """Base of every stored record. Immutable: a transition returns a new one."""


_encoder = msgspec.json.Encoder()


def to_json(record: Record) -> bytes:
    """The record as the bytes of a document, indented so that a researcher can read it."""
    return msgspec.json.format(_encoder.encode(record), indent=1)


def from_json(body: bytes, kind: type[T]) -> T:
    """The record in a document. Raises `msgspec.ValidationError` (a ValueError) when it is not one."""
    return msgspec.json.decode(body, type=kind)
