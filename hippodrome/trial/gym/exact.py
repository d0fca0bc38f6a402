"""Writes Python's values as bytes, and reads equal values from them: the messages of `hippodrome.gym.1`. Pure.

A message is the length of a JSON text in four bytes, the text, and the bytes of all arrays in the order in which the
text names them. A value that JSON lacks is an object with one key, which begins with `$`: `docs/gym.md` ("The binary
subprotocol") lists them.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import GraphInstance

from hippodrome.trial.gym.spaces import CodecError
from hippodrome.trial.gym.values import MAX_DEPTH

_KINDS = "biufcSU"
_LENGTH = struct.Struct("<I")


def to_bytes(value: Any) -> bytes:
    """Write `value` for `from_bytes`. An object of an unknown kind becomes the name of its class."""
    arrays: list[bytes] = []
    text = json.dumps(_tagged(value, arrays, 0), separators=(",", ":")).encode()
    return b"".join((_LENGTH.pack(len(text)), text, *arrays))


def from_bytes(data: bytes) -> Any:
    """Read the value that `to_bytes` has written. Raises CodecError."""
    try:
        end = _LENGTH.size + _LENGTH.unpack_from(data)[0]
        return _Reader(data, end).value(json.loads(data[_LENGTH.size : end]))
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError, struct.error) as error:
        raise CodecError("This is no message of hippodrome.gym.1.") from error


def _tagged(value: Any, arrays: list[bytes], depth: int) -> Any:
    """Convert the value to JSON data; below `MAX_DEPTH` levels, to the name of its class."""
    tagged: Any = type(value).__name__
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in _KINDS:
        arrays.append(np.ascontiguousarray(value, value.dtype.newbyteorder("<")).tobytes())
        tagged = {"$array" if isinstance(value, np.ndarray) else "$scalar": [value.dtype.str, list(value.shape)]}
    elif value is None or isinstance(value, bool | int | float | str):
        tagged = value
    elif depth > MAX_DEPTH:
        pass
    elif isinstance(value, Mapping):
        if all(isinstance(key, str) and not key.startswith("$") for key in value):
            return {key: _tagged(part, arrays, depth + 1) for key, part in value.items()}
        tagged = {"$dict": [_tagged(part, arrays, depth + 1) for pair in value.items() for part in pair]}
    elif isinstance(value, list | tuple):
        tagged = [_tagged(part, arrays, depth + 1) for part in value]
        if isinstance(value, tuple):
            tagged = {"$graph" if isinstance(value, GraphInstance) else "$tuple": tagged}
    elif hasattr(value, "__array__"):  # an array of another package
        tagged = _tagged(np.asarray(value), arrays, depth + 1)
    return tagged


class _Reader:
    """Converts JSON data back to values. The next array begins at `at` in the message."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data = data
        self._at = at

    def value(self, data: Any) -> Any:
        if isinstance(data, list):
            return [self.value(part) for part in data]
        if not isinstance(data, dict):
            return data
        tag = next(iter(data)) if len(data) == 1 else ""
        content = data.get(tag)
        match tag:
            case "$array":
                return self._array(content)
            case "$scalar":
                return self._array(content)[()]
            case "$tuple":
                return tuple(self.value(content))
            case "$graph":
                return GraphInstance(*self.value(content))
            case "$dict":
                parts = self.value(content)
                return dict(zip(parts[::2], parts[1::2], strict=True))
        return {key: self.value(part) for key, part in data.items()}

    def _array(self, content: Any) -> Any:
        written, shape = content
        dtype = np.dtype(str(written))
        count = math.prod(shape)
        if dtype.kind not in _KINDS or not all(type(side) is int and side >= 0 for side in shape):
            raise CodecError("An array has one of numpy's dtypes, and a list of whole numbers as its shape.")
        array = np.frombuffer(self._data, dtype.newbyteorder("<"), count, self._at) if count else np.empty(0, dtype)
        self._at += array.nbytes
        return array.astype(dtype).reshape(shape)  # a copy, since environments and agents may write into it
