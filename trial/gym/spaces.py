"""Spaces of Gymnasium as JSON: the form of Gymie 0.5.4, with further fields from which an equal space is built. Pure.

Gymie's server sends `{"name": "Discrete", "n": 4}`, `{"name": "Box", "shape": [2], "low": [-1.0, -1.0], "high": [1.0,
1.0]}` and `{"name": "MultiBinary", "n": 5, "shape": [5]}` (gymie/api.py, `space_info`), and of every other space its
name alone. "Discreate" stands only in its documentation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

Space = spaces.Space[Any]

MAX_ELEMENTS = 2**27
"""Numbers in one Box, MultiBinary or MultiDiscrete that is built from a description."""


class CodecError(ValueError):
    """A space or a value that cannot be sent, or a message that does not hold one. The message is a sentence."""


def describe(space: Space, *, compact: bool = False) -> dict[str, Any]:
    """The description of `space`: a dict of what JSON can carry, and of infinities (`values.to_text` writes them).

    With `compact`, a Box whose bounds are the same everywhere has two numbers as `low` and `high`; Gymie's clients
    expect lists. Raises CodecError for a space that is none of Gymnasium's own, and for a Dict with keys that are no
    text.
    """
    for kind, form in _FORMS.items():
        if isinstance(space, kind):
            return {"name": kind.__name__} | form(space, compact)
    raise CodecError(f"A space of class {type(space).__name__} cannot be sent; only Gymnasium's own can.")


def build(description: Any) -> Space:
    """A space equal to the one that `describe` was given. Raises CodecError if `description` is none.

    Takes Gymie's own descriptions too; what they do not say has Gymnasium's default.
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
    said: dict[str, Any] = {"shape": list(space.shape), "dtype": _dtype_name(space.dtype)}
    for name, bound in (("low", space.low), ("high", space.high)):
        numbers = bound.astype(np.uint8) if space.dtype.kind == "b" else bound
        same = compact and numbers.size > 0 and bool((numbers == numbers.flat[0]).all())
        said[name] = numbers.flat[0].item() if same else numbers.tolist()
    if space.dtype.kind == "i":  # an integer has no infinity, but sampling asks whether a bound was one
        for name, bounded in (("unboundedBelow", space.bounded_below), ("unboundedAbove", space.bounded_above)):
            if not bounded.all():
                said[name] = (~bounded).tolist()
    return said


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
    said: dict[str, Any] = {"spaces": {key: describe(part, compact=compact) for key, part in space.spaces.items()}}
    return said if space.sort_keys else said | {"sort_keys": False}


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


def _built_box(said: Mapping[str, Any]) -> Space:
    shape = _shape(said["shape"])
    dtype = _dtype(said, "float32")
    low, high = (_bound(said[name], shape, dtype) for name in ("low", "high"))
    box: spaces.Box[Any] = spaces.Box(low, high, shape, dtype=dtype)
    for name in ("Below", "Above"):
        if f"unbounded{name}" in said:
            unbounded = np.asarray(said[f"unbounded{name}"], bool).reshape(shape)
            setattr(box, f"bounded_{name.lower()}", ~unbounded)
    return box


def _bound(said: Any, shape: tuple[int, ...], dtype: Any) -> Any:
    numbers = np.asarray(said, None if dtype.kind == "f" else dtype)
    if numbers.ndim == 0:
        return np.full(shape, numbers, dtype)
    return numbers.astype(dtype).reshape(shape)


def _built_discrete(said: Mapping[str, Any]) -> Space:
    return spaces.Discrete(_whole(said["n"]), start=_whole(said.get("start", 0)), dtype=_dtype(said, "int64"))


def _built_multi_binary(said: Mapping[str, Any]) -> Space:
    n = said["n"]
    shape = _shape(n if isinstance(n, list) else [n])
    return spaces.MultiBinary(shape if isinstance(n, list) else shape[0])


def _built_multi_discrete(said: Mapping[str, Any]) -> Space:
    dtype = _dtype(said, "int64")
    nvec = np.asarray(said["nvec"], dtype)
    shape = _shape(said["shape"]) if "shape" in said else nvec.shape
    start = np.asarray(said["start"], dtype).reshape(shape) if "start" in said else None
    return spaces.MultiDiscrete(nvec.reshape(shape), dtype=dtype, start=start)


def _built_text(said: Mapping[str, Any]) -> Space:
    alphabet: dict[str, Any] = {"charset": str(said["charset"])} if "charset" in said else {}
    shortest, longest = _whole(said.get("min_length", 1)), _whole(said["max_length"])
    return spaces.Text(longest, min_length=shortest, **alphabet)


def _built_dict(said: Mapping[str, Any]) -> Space:
    parts = [(str(key), build(part)) for key, part in said["spaces"].items()]
    return spaces.Dict(parts, sort_keys=said.get("sort_keys") is not False)


def _built_sequence(said: Mapping[str, Any]) -> Space:
    return spaces.Sequence(build(said["space"]), stack=said.get("stack") is True)


def _built_graph(said: Mapping[str, Any]) -> Space:
    edges = said.get("edge_space")
    return spaces.Graph(build(said["node_space"]), None if edges is None else build(edges))


_BUILDERS: dict[str, Callable[[Mapping[str, Any]], Space]] = {
    "Box": _built_box,
    "Discrete": _built_discrete,
    "MultiBinary": _built_multi_binary,
    "MultiDiscrete": _built_multi_discrete,
    "Text": _built_text,
    "Dict": _built_dict,
    "Tuple": lambda said: spaces.Tuple(build(part) for part in said["spaces"]),
    "Sequence": _built_sequence,
    "Graph": _built_graph,
    "OneOf": lambda said: spaces.OneOf([build(part) for part in said["spaces"]]),
}


def _dtype(said: Mapping[str, Any], default: str) -> np.dtype[Any]:
    dtype = np.dtype(str(said.get("dtype", default)))
    if dtype.kind not in "biuf" or dtype.itemsize > 8:
        raise CodecError(f"A space of {dtype} cannot be built.")
    return dtype


def _shape(said: Any) -> tuple[int, ...]:
    shape = tuple(_whole(side) for side in said)
    if min(shape, default=0) < 0 or len(shape) > 32 or math.prod(max(1, side) for side in shape) > MAX_ELEMENTS:
        raise CodecError(f"A space has at most 32 axes and {MAX_ELEMENTS} numbers.")
    return shape


def _whole(said: Any) -> int:
    if not isinstance(said, int) or isinstance(said, bool):
        raise CodecError(f"{str(said)[:40]!r} stands where the description of a space needs a whole number.")
    return said
