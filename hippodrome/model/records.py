"""Records as JSON documents: camelCase keys, times in ISO 8601, unknown keys are ignored."""

from __future__ import annotations

from typing import TypeVar

import msgspec

T = TypeVar("T", bound="Record")


class Record(msgspec.Struct, frozen=True, omit_defaults=True, rename="camel"):
    """Base of every stored record. Immutable: a transition returns a new one."""


_encoder = msgspec.json.Encoder()


def to_json(record: Record) -> bytes:
    """The record as JSON, indented so that a researcher can read it."""
    return msgspec.json.format(_encoder.encode(record), indent=1)


def from_json(body: bytes, kind: type[T]) -> T:
    """The record in a document. Raises `msgspec.DecodeError` (a ValueError) if it is not one, or RecursionError."""
    return msgspec.json.decode(body, type=kind)
