"""Writes Python's values as JSON, and reads equal values from it: infos and options of RemoteEnv. Pure.

Plain JSON loses numpy's types, tuples, and keys that are no text. Here each such value is an object with one key, which
begins with `$`. `docs/gym.md` ("The binary subprotocol") lists these objects.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import GraphInstance

from trial.gym.spaces import CodecError
from trial.gym.values import MAX_DEPTH

_KINDS = "biufcSU"
_encoder = json.JSONEncoder(separators=(",", ":"), allow_nan=False)


def to_text(value: Any) -> str:
    """Write `value` as text for `from_text`. An object of an unknown kind becomes the name of its class."""
    return _encoder.encode(_tagged(value, 0))


def from_text(text: str | bytes) -> Any:
    """Read the value that `to_text` has written. Raises CodecError."""
    try:
        return _untagged(json.loads(text))
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise CodecError("These are no values in the JSON of hippodrome.gym.1.") from error


def _tagged(value: Any, depth: int) -> Any:
    """Convert the value to JSON data. An object with one key that begins with `$` stands for a type that JSON lacks.

    Deeper than `MAX_DEPTH` levels, only the name of the type of a list, map or array is left.
    """
    kind = type(value)
    if value is None or kind in (bool, int, str):
        return value
    if kind is float:
        return value if math.isfinite(value) else {"$float": repr(value)}
    if depth > MAX_DEPTH:
        return kind.__name__
    if isinstance(value, Mapping):
        if all(type(key) is str and not key.startswith("$") for key in value):
            return {key: _tagged(part, depth + 1) for key, part in value.items()}
        return {"$dict": [[_tagged(key, depth + 1), _tagged(part, depth + 1)] for key, part in value.items()]}
    if isinstance(value, list | tuple):
        parts = [_tagged(part, depth + 1) for part in value]
        if isinstance(value, list):
            return parts
        return {"$graph" if kind is GraphInstance else "$tuple": parts}
    return _tagged_rare(value, depth)


def _tagged_rare(value: Any, depth: int) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in _KINDS:
        name = "$array" if isinstance(value, np.ndarray) else "$scalar"
        data = np.ascontiguousarray(value, value.dtype.newbyteorder("<")).tobytes()
        return {name: [value.dtype.str, list(value.shape), base64.b64encode(data).decode("ascii")]}
    if isinstance(value, np.ndarray) and value.dtype == object:
        return {"$objects": [list(value.shape), [_tagged(part, depth + 1) for part in value.ravel().tolist()]]}
    if isinstance(value, set | frozenset):
        return {"$set": [_tagged(part, depth + 1) for part in value]}
    if isinstance(value, bytes | bytearray):
        return {"$bytes": base64.b64encode(value).decode("ascii")}
    for plain in (bool, int, float, str):
        if isinstance(value, plain):
            return _tagged(plain(value), depth)
    return type(value).__name__


def _untagged(data: Any) -> Any:
    """Convert JSON data that `_tagged` has made back to the value."""
    if isinstance(data, list):
        return [_untagged(part) for part in data]
    if not isinstance(data, dict):
        return data
    if len(data) == 1:
        ((name, content),) = data.items()
        if name.startswith("$"):
            return _TAGS[name](content)
    return {key: _untagged(part) for key, part in data.items()}


def _array(content: Any) -> Any:
    written, shape, data = content
    dtype = np.dtype(str(written))
    if dtype.kind not in _KINDS:
        raise CodecError(f"An array of {dtype} cannot be read: no server sends one.")
    array = np.frombuffer(base64.b64decode(data), dtype.newbyteorder("<")).astype(dtype).reshape(shape)
    if list(array.shape) != shape:
        raise CodecError("The shape of an array is a list of whole numbers.")
    return array


def _objects(content: Any) -> Any:
    shape, parts = content
    array = np.empty(len(parts), object)
    for at, part in enumerate(parts):
        array[at] = _untagged(part)
    return array.reshape(shape)


_TAGS: dict[str, Any] = {
    "$float": float,
    "$dict": lambda pairs: {_untagged(key): _untagged(part) for key, part in pairs},
    "$tuple": lambda parts: tuple(_untagged(part) for part in parts),
    "$graph": lambda parts: GraphInstance(*[_untagged(part) for part in parts]),
    "$array": _array,
    "$scalar": lambda content: _array(content)[()],
    "$objects": _objects,
    "$set": lambda parts: {_untagged(part) for part in parts},
    "$bytes": base64.b64decode,
}
