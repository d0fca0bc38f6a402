"""Describes Gymnasium's spaces in JSON data, and builds equal spaces from it. Pure.

The descriptions have the fields of Gymie 0.5.4, and further ones. Gymie's server sends `{"name": "Discrete", "n": 4}`,
`{"name": "Box", "shape": [2], "low": [-1.0, -1.0], "high": [1.0, 1.0]}` and `{"name": "MultiBinary", "n": 5, "shape":
[5]}` (gymie/api.py, `space_info`), and the name alone of every other space. Its documentation has "Discreate", but its
server does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

Space = spaces.Space[Any]

MAX_ELEMENTS = 2**27
"""The most numbers of one Box, MultiBinary or MultiDiscrete that is built from a description."""


class CodecError(ValueError):
    """A space or a value cannot be sent, or cannot be read from a message. The exception's text is a sentence."""


def describe(space: Space, *, compact: bool = False) -> dict[str, Any]:
    """Describe `space` as JSON data, which may contain infinities (`values.to_text` writes them).

    With `compact`, `low` of a Box is one number if it is the same everywhere, and so is `high`. Without, they are
    lists, as Gymie's clients expect. Raises CodecError for a class of space that Gymnasium does not have, and for a
    Dict with keys that are no text.
    """
    for kind, form in _FORMS.items():
        if isinstance(space, kind):
            return {"name": kind.__name__} | form(space, compact)
    raise CodecError(f"A space of class {type(space).__name__} cannot be sent; only Gymnasium's own can.")


def build(description: Any) -> Space:
    """Build a space from its description. It equals the space that was described.

    Takes Gymie's own descriptions too. A field that they do not have gets Gymnasium's default. Raises CodecError if the
    description is wrong.
    """
    if not isinstance(description, Mapping):
        raise CodecError("The description of a space must be an object.")
    builder = _BUILDERS.get(str(description.get("name")))
    if builder is None:
        raise CodecError(f"There is no space named {str(description.get('name'))[:40]!r}.")
    try:
        return builder(description)
    except CodecError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, AssertionError, OverflowError, RecursionError) as error:
        raise CodecError(f"The description of a {description['name']} is wrong: {str(error)[:200]}.") from error


def _dtype_name(dtype: np.dtype[Any]) -> str:
    if dtype.itemsize > 8:
        raise CodecError(f"A space of {dtype} cannot be sent; its numbers are of another size on other machines.")
    return dtype.name if dtype.isnative else dtype.str


def _box(space: spaces.Box[Any], compact: bool) -> dict[str, Any]:
    fields: dict[str, Any] = {"shape": list(space.shape), "dtype": _dtype_name(space.dtype)}
    for name, bound in (("low", space.low), ("high", space.high)):
        numbers = bound.astype(np.uint8) if space.dtype.kind == "b" else bound
        same = compact and numbers.size > 0 and bool((numbers == numbers.flat[0]).all())
        fields[name] = numbers.flat[0].item() if same else numbers.tolist()
    if space.dtype.kind == "i":  # integers have no infinity, but `sample` needs to know which bounds were infinite
        for name, bounded in (("unboundedBelow", space.bounded_below), ("unboundedAbove", space.bounded_above)):
            if not bounded.all():
                fields[name] = (~bounded).tolist()
    return fields


def _discrete(space: spaces.Discrete[Any], _: bool) -> dict[str, Any]:
    return {"n": int(space.n), "start": int(space.start), "dtype": _dtype_name(space.dtype)}


def _multi_binary(space: spaces.MultiBinary, _: bool) -> dict[str, Any]:
    return {"n": space.n if isinstance(space.n, int) else list(space.n), "shape": list(space.shape)}


def _multi_discrete(space: spaces.MultiDiscrete[Any], _: bool) -> dict[str, Any]:
    return {
        "shape": list(space.nvec.shape),
        "nvec": space.nvec.tolist(),
        "start": space.start.tolist(),
        "dtype": _dtype_name(space.dtype),
    }


def _text(space: spaces.Text, _: bool) -> dict[str, Any]:
    lengths = {"min_length": space.min_length, "max_length": space.max_length}
    return lengths | {"charset": "".join(space.character_list)}


def _dict(space: spaces.Dict, compact: bool) -> dict[str, Any]:
    if not all(isinstance(key, str) for key in space.spaces):
        raise CodecError("A Dict space whose keys are not all text cannot be sent.")
    fields: dict[str, Any] = {"spaces": {key: describe(part, compact=compact) for key, part in space.spaces.items()}}
    return fields if space.sort_keys else fields | {"sort_keys": False}


def _parts(space: Any, compact: bool) -> dict[str, Any]:
    return {"spaces": [describe(part, compact=compact) for part in space.spaces]}


def _sequence(space: spaces.Sequence, compact: bool) -> dict[str, Any]:
    return {"space": describe(space.feature_space, compact=compact), "stack": bool(space.stack)}


def _graph(space: spaces.Graph, compact: bool) -> dict[str, Any]:
    edges = None if space.edge_space is None else describe(space.edge_space, compact=compact)
    return {"node_space": describe(space.node_space, compact=compact), "edge_space": edges}


_FORMS: dict[type[Any], Callable[[Any, bool], dict[str, Any]]] = {
    spaces.Box: _box,
    spaces.Discrete: _discrete,
    spaces.MultiBinary: _multi_binary,
    spaces.MultiDiscrete: _multi_discrete,
    spaces.Text: _text,
    spaces.Dict: _dict,
    spaces.Tuple: _parts,
    spaces.Sequence: _sequence,
    spaces.Graph: _graph,
    spaces.OneOf: _parts,
}


def _built_box(description: Mapping[str, Any]) -> Space:
    shape = _shape(description["shape"])
    dtype = _dtype(description, "float32")
    low, high = (_bound(description[name], shape, dtype) for name in ("low", "high"))
    box: spaces.Box[Any] = spaces.Box(low, high, shape, dtype=dtype)
    for name in ("Below", "Above"):
        if f"unbounded{name}" in description:
            unbounded = np.asarray(description[f"unbounded{name}"], bool).reshape(shape)
            setattr(box, f"bounded_{name.lower()}", ~unbounded)
    return box


def _bound(bound: Any, shape: tuple[int, ...], dtype: Any) -> Any:
    numbers = np.asarray(bound, None if dtype.kind == "f" else dtype)
    if numbers.ndim == 0:
        return np.full(shape, numbers, dtype)
    return numbers.astype(dtype).reshape(shape)


def _built_discrete(description: Mapping[str, Any]) -> Space:
    return spaces.Discrete(
        _whole(description["n"]), start=_whole(description.get("start", 0)), dtype=_dtype(description, "int64")
    )


def _built_multi_binary(description: Mapping[str, Any]) -> Space:
    n = description["n"]
    shape = _shape(n if isinstance(n, list) else [n])
    return spaces.MultiBinary(shape if isinstance(n, list) else shape[0])


def _built_multi_discrete(description: Mapping[str, Any]) -> Space:
    dtype = _dtype(description, "int64")
    nvec = np.asarray(description["nvec"], dtype)
    shape = _shape(description["shape"]) if "shape" in description else nvec.shape
    start = np.asarray(description["start"], dtype).reshape(shape) if "start" in description else None
    return spaces.MultiDiscrete(nvec.reshape(shape), dtype=dtype, start=start)


def _built_text(description: Mapping[str, Any]) -> Space:
    alphabet: dict[str, Any] = {"charset": str(description["charset"])} if "charset" in description else {}
    shortest, longest = _whole(description.get("min_length", 1)), _whole(description["max_length"])
    return spaces.Text(longest, min_length=shortest, **alphabet)


def _built_dict(description: Mapping[str, Any]) -> Space:
    parts = [(str(key), build(part)) for key, part in description["spaces"].items()]
    return spaces.Dict(parts, sort_keys=description.get("sort_keys") is not False)


def _built_sequence(description: Mapping[str, Any]) -> Space:
    return spaces.Sequence(build(description["space"]), stack=description.get("stack") is True)


def _built_graph(description: Mapping[str, Any]) -> Space:
    edges = description.get("edge_space")
    return spaces.Graph(build(description["node_space"]), None if edges is None else build(edges))


_BUILDERS: dict[str, Callable[[Mapping[str, Any]], Space]] = {
    "Box": _built_box,
    "Discrete": _built_discrete,
    "MultiBinary": _built_multi_binary,
    "MultiDiscrete": _built_multi_discrete,
    "Text": _built_text,
    "Dict": _built_dict,
    "Tuple": lambda description: spaces.Tuple(build(part) for part in description["spaces"]),
    "Sequence": _built_sequence,
    "Graph": _built_graph,
    "OneOf": lambda description: spaces.OneOf([build(part) for part in description["spaces"]]),
}


def _dtype(description: Mapping[str, Any], default: str) -> np.dtype[Any]:
    dtype = np.dtype(str(description.get("dtype", default)))
    if dtype.kind not in "biuf" or dtype.itemsize > 8:
        raise CodecError(f"A space of {dtype} cannot be built.")
    return dtype


def _shape(sides: Any) -> tuple[int, ...]:
    shape = tuple(_whole(side) for side in sides)
    if min(shape, default=0) < 0 or len(shape) > 32 or math.prod(max(1, side) for side in shape) > MAX_ELEMENTS:
        raise CodecError(f"A space has at most 32 axes and {MAX_ELEMENTS} numbers.")
    return shape


def _whole(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise CodecError(f"{str(value)[:40]!r} stands where the description of a space needs a whole number.")
    return value
