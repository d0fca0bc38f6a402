"""Writes values as JSON, and reads actions: arrays are lists, a Dict is an object, a Tuple is a list. Pure.

JSON has no infinity. Gymie's server sends `Infinity`, at which its client's JSON.parse fails. Here an infinity is
written as `1e999`: JSON's grammar allows that, and each reader with IEEE numbers, such as JavaScript's and Python's,
reads it as infinity. NaN is written as `null`, as JSON.stringify does it.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import math
import re
import struct
from collections.abc import Collection, Mapping
from enum import Enum
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.spaces import GraphInstance

from hippodrome.trial.gym.spaces import CodecError, Space

MAX_DEPTH = 100
"""The most levels of lists and objects in a value that is sent."""

_MAX_LISTS = 3  # levels of lists around pictures: render modes such as rgb_array_list return lists
_SPECIAL = re.compile(r'"(?:[^"\\]|\\.)*"|-?Infinity|NaN')
_WRITTEN = {"Infinity": "1e999", "-Infinity": "-1e999", "NaN": "null"}


def to_text(value: Any) -> str:
    """Write `value` as JSON, numpy's types too. An object for which JSON has no form becomes the name of its class."""
    text = json.dumps(_plain(value, 0), separators=(",", ":"))
    if "Infinity" not in text and "NaN" not in text:
        return text
    return _SPECIAL.sub(lambda match: _WRITTEN.get(match[0], match[0]), text)


def _plain(value: Any, depth: int) -> Any:
    """Convert `value` to JSON's types, with texts as the keys of dicts; below MAX_DEPTH, to the name of its class."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    plain: Any = type(value).__name__
    with contextlib.suppress(Exception):  # the object is the researcher's
        if depth > MAX_DEPTH:
            pass
        elif hasattr(value, "__array__"):  # numpy's types, and those of other packages
            array = np.asarray(value)
            plain = array.tolist() if array.dtype.kind in "biufU" else _plain(array.tolist(), depth + 1)
        elif isinstance(value, Enum):
            plain = _plain(value.value, depth + 1)
        elif isinstance(value, Mapping):
            plain = {_key(key): _plain(part, depth + 1) for key, part in value.items()}
        elif isinstance(value, Collection) and not isinstance(value, bytes | bytearray):
            plain = [_plain(part, depth + 1) for part in value]
    return plain


def _key(key: Any) -> str:
    try:
        return json.dumps(key) if key is None or isinstance(key, bool) else str(key)
    except Exception:  # noqa: BLE001 - the key is the researcher's
        return type(key).__name__


def read(space: Space, data: Any, *, action: bool = False) -> Any:
    """Read a value of `space` from JSON data or from Python's values. Raises CodecError if shape or kind do not fit.

    An `action` must also lie in the space; but the finite numbers of a Box of floats may lie beyond its bounds, since
    many environments clip them, and policies rely on that.
    """
    value = _reader(space)(space, data, action)
    if action and not _lies_in(space, value):
        raise CodecError(f"The action is not in {_short(space)}.")
    return value


def _reader(space: Space) -> Any:
    for kind, reader in _READERS.items():
        if isinstance(space, kind):
            return reader
    raise CodecError(f"Values of a space of class {type(space).__name__} cannot be sent; only Gymnasium's own can.")


def _lies_in(space: Space, value: Any) -> bool:
    if isinstance(space, spaces.Dict | spaces.Tuple | spaces.OneOf) or (
        isinstance(space, spaces.Sequence) and not space.stack
    ):
        return True  # their parts have been checked
    if isinstance(space, spaces.Box) and space.dtype.kind == "f":
        return bool((np.isfinite(value) | ((value >= space.low) & (value <= space.high))).all())
    return space.contains(value)


def _numbers(space: Any, data: Any, _: bool, *, batch: bool = False) -> Any:
    """Read an array of `space`'s shape; with `batch`, a list of such arrays as one array."""
    try:
        array = np.asarray(data)
    except (ValueError, RecursionError):
        raise CodecError("Lists of numbers must have the same length.") from None
    shape = (len(array), *space.shape) if batch and array.ndim else space.shape
    if array.size == 0 and math.prod(shape) == 0:
        array = np.empty(shape, space.dtype)  # an empty list in JSON shows no further axes, and no kind
    if array.dtype.kind not in ("biuf" if space.dtype.kind in "fb" else "iu"):
        raise CodecError(f"A value of {_short(space)} holds {'' if space.dtype.kind in 'fb' else 'whole '}numbers.")
    if array.shape != shape:
        raise CodecError(f"Numbers of shape {shape} are needed, not of {array.shape}.")
    with np.errstate(over="ignore"):
        numbers = array.astype(space.dtype)
    if space.dtype.kind != "f" and not np.array_equal(numbers, array):
        raise CodecError(f"A number does not fit into {space.dtype}.")
    return numbers


def _discrete(space: spaces.Discrete[Any], data: Any, _: bool) -> Any:
    if isinstance(data, np.ndarray) and data.shape == ():
        data = data[()]
    if not isinstance(data, int | np.integer) or isinstance(data, bool):
        raise CodecError("A whole number is needed.")
    try:
        return space.dtype.type(data)
    except OverflowError:
        raise CodecError(f"The number does not fit into {space.dtype}.") from None


def _text(_: spaces.Text, data: Any, __: bool) -> str:
    if not isinstance(data, str):
        raise CodecError("A text is needed.")
    return data


def _dict(space: spaces.Dict, data: Any, action: bool) -> dict[str, Any]:
    if not isinstance(data, Mapping) or data.keys() != space.spaces.keys():
        raise CodecError(f"An object with {', '.join(space.spaces) or 'no keys'} is needed.")
    return {key: _part(part, data[key], action, key) for key, part in space.spaces.items()}


def _tuple(space: spaces.Tuple[Any], data: Any, action: bool) -> tuple[Any, ...]:
    if not isinstance(data, list | tuple) or len(data) != len(space.spaces):
        raise CodecError(f"A list of {len(space.spaces)} values is needed.")
    return tuple(_part(part, data[at], action, at) for at, part in enumerate(space.spaces))


def _part(space: Space, data: Any, action: bool, where: str | int) -> Any:
    try:
        return read(space, data, action=action)
    except CodecError as error:
        raise CodecError(f"{where}: {error}") from None


def _one_of(space: spaces.OneOf[Any], data: Any, action: bool) -> tuple[Any, Any]:
    if not isinstance(data, list | tuple) or len(data) != 2:
        raise CodecError("A list of a whole number and a value is needed.")
    index = _discrete(spaces.Discrete(len(space.spaces)), data[0], action)
    if not 0 <= index < len(space.spaces):
        raise CodecError(f"The first value must be a whole number below {len(space.spaces)}.")
    return index, _part(space.spaces[index], data[1], action, int(index))


def _sequence(space: spaces.Sequence, data: Any, action: bool) -> Any:
    if space.stack:
        return _batch(space.feature_space, data, action)
    if not isinstance(data, list | tuple):
        raise CodecError("A list of values is needed.")
    return tuple(_part(space.feature_space, part, action, at) for at, part in enumerate(data))


def _batch(space: Space, data: Any, action: bool) -> Any:
    """Read a batch of values, in the form of `gymnasium.vector.utils.concatenate`."""
    if isinstance(space, spaces.Dict) and isinstance(data, Mapping) and data.keys() == space.spaces.keys():
        return {key: _batch(part, data[key], action) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple) and isinstance(data, list | tuple) and len(data) == len(space.spaces):
        return tuple(_batch(part, data[at], action) for at, part in enumerate(space.spaces))
    if isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete):
        return _numbers(space, data, action, batch=True)
    return _sequence(spaces.Sequence(space), data, action)


def _graph(space: spaces.Graph, data: Any, action: bool) -> spaces.GraphInstance:
    if not isinstance(data, list | tuple) or len(data) != 3 or (data[1] is None) != (data[2] is None):
        raise CodecError("A list of nodes, edges and edge links is needed.")
    nodes = _batch(space.node_space, data[0], action)
    if data[1] is None:
        return spaces.GraphInstance(nodes, None, None)
    if space.edge_space is None:
        raise CodecError("The graphs of this space have no edges.")
    links = _numbers(spaces.Box(0, 2**31 - 1, (2,), np.int32), data[2], action, batch=True)
    return spaces.GraphInstance(nodes, _batch(space.edge_space, data[1], action), links)


_READERS: dict[type[Any], Any] = {
    spaces.Box: _numbers,
    spaces.Discrete: _discrete,
    spaces.MultiBinary: _numbers,
    spaces.MultiDiscrete: _numbers,
    spaces.Text: _text,
    spaces.Dict: _dict,
    spaces.Tuple: _tuple,
    spaces.Sequence: _sequence,
    spaces.Graph: _graph,
    spaces.OneOf: _one_of,
}


def _short(space: Any) -> str:
    text = repr(space)
    return text if len(text) <= 80 else f"{type(space).__name__}(…)"


def stacked(space: Space, rows: Collection[Any]) -> Any:
    """Join values of `space` to a batch, in the form of Gymnasium's vector environments. Raises CodecError."""
    if isinstance(space, spaces.Dict):
        return {key: stacked(part, [row[key] for row in rows]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(stacked(part, [row[at] for row in rows]) for at, part in enumerate(space.spaces))
    if isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete):
        try:
            numbers = np.array(rows) if rows else np.empty((0, *(space.shape or ())), space.dtype)
            return numbers.astype(space.dtype, casting="same_kind")
        except (ValueError, TypeError):
            raise CodecError(f"The observations are not in {_short(space)}.") from None
    return tuple(rows)


def picture(rendered: Any, depth: int = 0) -> Any:
    """Convert the result of `render()` to JSON data: a picture to `{"png": base64, "shape"}`; a text or None stays.

    A picture is an array of bytes: height x width, or height x width x 1, 3 or 4. Any other array becomes
    `{"array": lists, "dtype": name, "shape"}`. A list may have all of these. Raises CodecError for anything else.
    """
    if rendered is None or isinstance(rendered, str):
        return rendered
    if isinstance(rendered, list | tuple) and depth < _MAX_LISTS:
        return [picture(part, depth + 1) for part in rendered]
    if not isinstance(rendered, np.ndarray) or rendered.dtype.kind not in "biuf":
        raise CodecError(f"render() returned a {type(rendered).__name__}, which cannot be sent.")
    shape = rendered.shape
    is_picture = 0 not in shape and (len(shape) == 2 or (len(shape) == 3 and shape[2] in (1, 3, 4)))
    if rendered.dtype != np.uint8 or not is_picture:
        return {"array": rendered.tolist(), "dtype": rendered.dtype.name, "shape": list(shape)}
    from PIL import Image  # noqa: PLC0415 - most clients ask for no picture

    out = io.BytesIO()
    # Level 1 packs a game's screen nearly as small as level 6, in a fraction of the time.
    Image.fromarray(rendered[:, :, 0] if shape[2:] == (1,) else rendered).save(out, "PNG", compress_level=1)
    return {"png": base64.b64encode(out.getvalue()).decode("ascii"), "shape": list(shape)}


# ---- the messages of `hippodrome.gym.1`: Python's values as bytes, and equal values from them
#
# A message is the length of a JSON text in four bytes, the text, and the bytes of all arrays in the order in which the
# text names them. A value that JSON lacks is an object with one key, which begins with `$`: `docs/gym.md` ("The binary
# subprotocol") lists them.

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
