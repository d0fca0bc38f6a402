"""Writes and reads values of spaces in Gymie's JSON: arrays as lists, a Dict as an object, a Tuple as a list. Pure.

JSON has no infinity. Gymie's server sends `Infinity`, at which its client's JSON.parse fails. Here an infinity is
written as `1e999`: JSON's grammar allows that, and each reader with IEEE numbers, such as JavaScript's and Python's,
reads it as infinity. NaN is written as `null`, as JSON.stringify does it.
"""

from __future__ import annotations

import base64
import io
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from typing import Any

import numpy as np
from gymnasium import spaces

from trial.gym.spaces import CodecError, Space
from trial.recordings.recorded_values import simpler

Decode = Callable[[Any], Any]
"""A function that reads a value of a space from JSON data. It raises CodecError."""

MAX_DEPTH = 100
"""The most levels of lists and objects in a value that is sent."""

_MAX_LISTS = 3  # levels of lists around pictures: a vector returns a list, and each of its elements may be a list

_SPECIAL = re.compile(r'"(?:[^"\\]|\\.)*"|-?Infinity|NaN')


def to_text(value: Any) -> str:
    """Write `value` as JSON, numpy's types too. An object for which JSON has no form becomes the name of its class."""
    try:
        return _strict.encode(value)
    except (TypeError, ValueError, RecursionError):  # infinity, a key that is no text, an object within itself
        text = json.dumps(plain(value), separators=(",", ":"))
        return _SPECIAL.sub(_written, text)


def from_text(text: str | bytes) -> Any:
    """Read JSON data from `text`. Raises CodecError if it is not JSON, or nested too deep."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        raise CodecError("This is not JSON.") from None


def plain(value: Any, depth: int = 0) -> Any:
    """Convert `value` to JSON's types, with texts as the keys of dicts; below MAX_DEPTH, to the name of its class."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if depth > MAX_DEPTH:
        return type(value).__name__
    simple = value if isinstance(value, list | tuple) else _simple(value)
    if isinstance(simple, Mapping):
        return {_key(key): plain(part, depth + 1) for key, part in simple.items()}
    return [plain(part, depth + 1) for part in simple] if isinstance(simple, list | tuple) else simple


def _key(key: Any) -> str:
    if isinstance(key, str):
        return key
    if key is None or isinstance(key, bool):
        return json.dumps(key)  # written as JSONEncoder writes such a key
    try:
        return str(key)
    except Exception:  # noqa: BLE001 - the key is the researcher's
        return type(key).__name__


def _simple(value: Any) -> Any:
    """Convert what JSON's encoder does not take; its class's name stands for an object that holds no values."""
    if isinstance(value, Enum):
        return plain(value.value)
    try:
        simple = simpler(value)
    except Exception:  # noqa: BLE001 - the object is the researcher's
        return type(value).__name__
    if isinstance(simple, np.ndarray | np.generic):
        return simple.tolist() if simple is value else _simple(simple)
    if isinstance(simple, Mapping):
        return dict(simple)
    if isinstance(simple, str | int | float):
        return simple
    return list(simple) if isinstance(simple, Iterable) and not isinstance(simple, bytes) else type(value).__name__


def _written(match: re.Match[str]) -> str:
    return {"Infinity": "1e999", "-Infinity": "-1e999", "NaN": "null"}.get(match[0], match[0])


_strict = json.JSONEncoder(separators=(",", ":"), allow_nan=False, default=_simple)


def decoder(space: Space, *, action: bool = False) -> Decode:
    """Make a function that reads a value of `space` from JSON data. Raises CodecError for an unknown class of space.

    The function checks the value's shape and type, and the range of the dtype, and raises CodecError. An `action` must
    also lie in the space; but the finite numbers of a Box of floats may lie beyond its bounds, since many environments
    clip them, and policies rely on that. An observation may lie outside of its space.
    """
    for kind, make in _DECODERS.items():
        if isinstance(space, kind):
            return make(space, action)
    raise CodecError(f"Values of a space of class {type(space).__name__} cannot be sent; only Gymnasium's own can.")


def check_action(space: Any, numbers: np.ndarray[Any, Any]) -> None:
    """Raise CodecError if `numbers`, an action or a batch of actions, do not lie in a space of numbers."""
    low: Any
    high: Any
    if isinstance(space, spaces.Box):
        if space.dtype.kind == "f":
            finite = np.isfinite(numbers)
            if not finite.all() and not (finite | ((numbers >= space.low) & (numbers <= space.high))).all():
                raise CodecError("The action holds NaN, or an infinity that its space does not have.")
            return
        low, high = space.low, space.high
    elif isinstance(space, spaces.Discrete):
        low, high = space.start, space.start + (space.n - 1)
    elif isinstance(space, spaces.MultiDiscrete):
        low, high = space.start, space.start + (space.nvec - 1)
    else:
        low, high = 0, 1
    if (numbers < low).any() or (numbers > high).any():
        raise CodecError(f"The action is not in {_short(space)}.")


def _numbers(space: Any, action: bool, batch: bool = False) -> Decode:
    """Make a function that reads an array of `space`'s shape; with `batch`, a list of such arrays as one array."""
    dtype, shape = space.dtype, space.shape
    axes = len(shape) + batch
    if dtype.kind in "iu":
        least, most = (int(limit) for limit in (np.iinfo(dtype).min, np.iinfo(dtype).max))

    def decode(data: Any) -> Any:
        array = _array(data, dtype.kind == "f")
        if array.size == 0:
            array = _without_numbers(array, shape, batch)
        if array.shape[batch:] != shape or array.ndim != axes:
            raise CodecError(f"Numbers of shape {_shape(shape, batch)} are needed, not of {array.shape}.")
        if dtype.kind == "f":
            with np.errstate(over="ignore"):
                numbers = array.astype(dtype)
        elif dtype.kind == "b":
            if not ((array == 0) | (array == 1)).all():
                raise CodecError("True and false, or 1 and 0, are needed.")
            numbers = array.astype(dtype)
        else:
            if array.size and array.dtype.kind not in "iu":
                raise CodecError("Whole numbers are needed.")
            if array.size and (int(array.min()) < least or int(array.max()) > most):
                raise CodecError(f"A number does not fit into {dtype}.")
            numbers = array.astype(dtype)
        if action:
            check_action(space, numbers)
        return numbers

    return decode


def _without_numbers(array: np.ndarray[Any, Any], shape: tuple[int, ...], batch: bool) -> np.ndarray[Any, Any]:
    """Reshape an array without numbers to the needed shape: an empty list in JSON does not show further axes."""
    whole = (len(array), *shape) if batch else shape
    known = whole[: whole.index(0) + 1] if 0 in whole else whole
    return array.reshape(whole) if array.shape == known else array


def _array(data: Any, nan: bool) -> np.ndarray[Any, Any]:
    """Make an array of a number or lists of numbers. With `nan`, None stands for NaN. Raises CodecError."""
    try:
        array = np.asarray(data)
        if array.dtype == object and nan:
            array = np.asarray(_with_nan(data))
    except (ValueError, RecursionError):
        raise CodecError("Lists of numbers must have the same length.") from None
    if array.dtype.kind not in "biuf":
        raise CodecError("Numbers are needed, and none that 64 bits cannot hold.")
    return array


def _with_nan(data: Any) -> Any:
    if isinstance(data, list):
        return [_with_nan(part) for part in data]
    return math.nan if data is None else data


def _discrete(space: spaces.Discrete[Any], action: bool) -> Decode:
    kind = space.dtype.type
    first, last = int(space.start), int(space.start) + int(space.n) - 1
    if not action:
        first, last = int(np.iinfo(space.dtype).min), int(np.iinfo(space.dtype).max)

    def decode(data: Any) -> Any:
        if type(data) is not int:
            raise CodecError("A whole number is needed.")
        if not first <= data <= last:
            raise CodecError(f"{str(data)[:40]} is not in {_short(space)}.")
        return kind(data)

    return decode


def _text(space: spaces.Text, action: bool) -> Decode:
    def decode(data: Any) -> str:
        if not isinstance(data, str):
            raise CodecError("A text is needed.")
        if action and not space.contains(data):
            raise CodecError(f"The text is not in {_short(space)}.")
        return data

    return decode


def _dict(space: spaces.Dict, action: bool) -> Decode:
    return _dict_of({key: decoder(part, action=action) for key, part in space.spaces.items()})


def _dict_of(parts: dict[str, Decode]) -> Decode:
    def decode(data: Any) -> dict[str, Any]:
        if not isinstance(data, dict) or data.keys() != parts.keys():
            raise CodecError(f"An object with {', '.join(parts) or 'no keys'} is needed.")
        return {key: _part(read, data[key], key) for key, read in parts.items()}

    return decode


def _tuple(space: spaces.Tuple[Any], action: bool) -> Decode:
    return _tuple_of([decoder(part, action=action) for part in space.spaces])


def _tuple_of(parts: list[Decode]) -> Decode:
    def decode(data: Any) -> tuple[Any, ...]:
        if not isinstance(data, list) or len(data) != len(parts):
            raise CodecError(f"A list of {len(parts)} values is needed.")
        return tuple(_part(read, value, at) for at, (read, value) in enumerate(zip(parts, data, strict=True)))

    return decode


def _part(read: Decode, data: Any, where: str | int) -> Any:
    try:
        return read(data)
    except CodecError as error:
        raise CodecError(f"{where}: {error}") from None


def _list_of(read: Decode) -> Decode:
    def decode(data: Any) -> tuple[Any, ...]:
        if not isinstance(data, list):
            raise CodecError("A list of values is needed.")
        return tuple(_part(read, value, at) for at, value in enumerate(data))

    return decode


def _sequence(space: spaces.Sequence, action: bool) -> Decode:
    if space.stack:
        return _stacked(space.feature_space, action)
    return _list_of(decoder(space.feature_space, action=action))


def _stacked(space: Space, action: bool) -> Decode:
    """Make a function that reads a batch of values, in the form of `gymnasium.vector.utils.concatenate`."""
    if isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete):
        return _numbers(space, action, batch=True)
    if isinstance(space, spaces.Dict):
        return _dict_of({key: _stacked(part, action) for key, part in space.spaces.items()})
    if isinstance(space, spaces.Tuple):
        return _tuple_of([_stacked(part, action) for part in space.spaces])
    return _list_of(decoder(space, action=action))


def _graph(space: spaces.Graph, action: bool) -> Decode:
    nodes = _stacked(space.node_space, action)
    edges = None if space.edge_space is None else _stacked(space.edge_space, action)
    links = _numbers(spaces.Box(0, 2**31 - 1, (2,), np.int32), action, batch=True)

    def decode(data: Any) -> spaces.GraphInstance:
        if not isinstance(data, list) or len(data) != 3 or (data[1] is None) != (data[2] is None):
            raise CodecError("A list of nodes, edges and edge links is needed.")
        if data[1] is None:
            return spaces.GraphInstance(_part(nodes, data[0], "nodes"), None, None)
        if edges is None:
            raise CodecError("The graphs of this space have no edges.")
        graph = spaces.GraphInstance(
            _part(nodes, data[0], "nodes"), _part(edges, data[1], "edges"), _part(links, data[2], "edge_links")
        )
        if action and not space.contains(graph):
            raise CodecError("An edge leads to a node that is not there, or edges and their links differ in number.")
        return graph

    return decode


def _one_of(space: spaces.OneOf[Any], action: bool) -> Decode:
    parts = [decoder(part, action=action) for part in space.spaces]

    def decode(data: Any) -> tuple[Any, Any]:
        if not isinstance(data, list) or len(data) != 2 or type(data[0]) is not int or not 0 <= data[0] < len(parts):
            raise CodecError(f"A list of a whole number below {len(parts)} and a value is needed.")
        return np.int64(data[0]), _part(parts[data[0]], data[1], data[0])

    return decode


_DECODERS: dict[type[Any], Callable[[Any, bool], Decode]] = {
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


def _shape(shape: tuple[int, ...], batch: bool) -> str:
    return str(("any", *shape)) if batch else str(shape)


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
    if rendered.dtype != np.uint8 or not _is_picture(rendered.shape):
        return {"array": rendered.tolist(), "dtype": rendered.dtype.name, "shape": list(rendered.shape)}
    from PIL import Image  # noqa: PLC0415 - most clients ask for no picture

    out = io.BytesIO()
    grey = rendered.ndim == 3 and rendered.shape[2] == 1
    # Level 1 packs a game's screen nearly as small as level 6, in a fraction of the time.
    Image.fromarray(rendered[:, :, 0] if grey else rendered).save(out, "PNG", compress_level=1)
    return {"png": base64.b64encode(out.getvalue()).decode("ascii"), "shape": list(rendered.shape)}


def rendered(data: Any) -> Any:
    """Convert the data that `picture` has made back to the result of `render()`. Raises CodecError."""
    if data is None or isinstance(data, str):
        return data
    if isinstance(data, list):
        return [rendered(part) for part in data]
    try:
        shape = tuple(data["shape"])
        if "png" not in data:
            return np.asarray(data["array"], np.dtype(data["dtype"])).reshape(shape)
        from PIL import Image  # noqa: PLC0415 - as above

        with Image.open(io.BytesIO(base64.b64decode(data["png"])), formats=["PNG"]) as image:
            return np.array(image, np.uint8).reshape(shape)
    except Exception as error:  # Pillow raises many kinds of errors
        raise CodecError("This is not what render() returned.") from error


def _is_picture(shape: tuple[int, ...]) -> bool:
    return min(shape) > 0 and (len(shape) == 2 or (len(shape) == 3 and shape[2] in (1, 3, 4)))
