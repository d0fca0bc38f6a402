"""Describes Gymnasium's spaces, and builds equal spaces from the descriptions. Pure.

The descriptions have the fields of Gymie 0.5.4, and further ones. Gymie's server sends `{"name": "Discrete", "n": 4}`,
`{"name": "Box", "shape": [2], "low": [-1.0, -1.0], "high": [1.0, 1.0]}` and `{"name": "MultiBinary", "n": 5, "shape":
[5]}` (gymie/api.py, `space_info`), and the name alone of every other space. Its documentation has "Discreate", but its
server does not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

Space = spaces.Space[Any]


class CodecError(ValueError):
    """A space or a value cannot be sent, or cannot be read from a message. The exception's text is a sentence."""


def describe(space: Space) -> dict[str, Any]:
    """Describe `space`. Bounds are arrays of numpy, which JSON has as lists (`values.to_text`).

    Raises CodecError for a class of space that Gymnasium does not have, and for a Dict with keys that are no text.
    """
    for kind, fields in _FIELDS.items():
        if isinstance(space, kind):
            return {"name": kind.__name__, **fields(space)}
    raise CodecError(f"A space of class {type(space).__name__} cannot be sent; only Gymnasium's own can.")


def _dict_fields(space: spaces.Dict) -> dict[str, Any]:
    if not all(isinstance(key, str) for key in space.spaces):
        raise CodecError("A Dict space whose keys are not all text cannot be sent.")
    fields: dict[str, Any] = {"spaces": {key: describe(part) for key, part in space.spaces.items()}}
    return fields if space.sort_keys else fields | {"sort_keys": False}


_FIELDS: dict[type[Any], Any] = {
    spaces.Box: lambda box: {
        "shape": list(box.shape),
        "low": box.low.astype(np.uint8) if box.dtype.kind == "b" else box.low,
        "high": box.high.astype(np.uint8) if box.dtype.kind == "b" else box.high,
        "dtype": box.dtype.name,
    },
    spaces.Discrete: lambda discrete: {
        "n": int(discrete.n),
        "start": int(discrete.start),
        "dtype": discrete.dtype.name,
    },
    spaces.MultiBinary: lambda binary: {
        "n": binary.n if isinstance(binary.n, int) else list(binary.n),
        "shape": list(binary.shape),
    },
    spaces.MultiDiscrete: lambda multi: {
        "shape": list(multi.nvec.shape),
        "nvec": multi.nvec,
        "start": multi.start,
        "dtype": multi.dtype.name,
    },
    spaces.Text: lambda text: {
        "min_length": text.min_length,
        "max_length": text.max_length,
        "charset": "".join(text.character_list),
    },
    spaces.Dict: _dict_fields,
    spaces.Tuple: lambda parts: {"spaces": [describe(part) for part in parts.spaces]},
    spaces.Sequence: lambda sequence: {"space": describe(sequence.feature_space), "stack": bool(sequence.stack)},
    spaces.Graph: lambda graph: {
        "node_space": describe(graph.node_space),
        "edge_space": None if graph.edge_space is None else describe(graph.edge_space),
    },
    spaces.OneOf: lambda choice: {"spaces": [describe(part) for part in choice.spaces]},
}


def build(description: Any) -> Space:
    """Build a space from its description. It equals the space that was described.

    Takes Gymie's own descriptions too. A field that they do not have gets Gymnasium's default. Raises CodecError if the
    description is wrong.
    """
    try:
        return _built(**description)
    except Exception as error:  # Gymnasium's spaces raise many kinds of errors
        raise CodecError(f"The description of a space is wrong: {type(error).__name__}: {str(error)[:200]}.") from error


def _built(name: str, **fields: Any) -> Space:
    kind = {kind.__name__: kind for kind in _FIELDS}[name]
    if "dtype" in fields:
        fields["dtype"] = np.dtype(fields["dtype"])
    if kind is spaces.Box:
        dtype, shape = fields.setdefault("dtype", np.dtype("float32")), tuple(fields.pop("shape"))
        fields |= {bound: np.asarray(fields[bound]).astype(dtype).reshape(shape) for bound in ("low", "high")}
    elif kind in (spaces.MultiBinary, spaces.MultiDiscrete):
        fields.pop("shape", None)
    for key in ("space", "node_space", "edge_space"):
        if fields.get(key) is not None:
            fields[key] = build(fields[key])
    parts = fields.get("spaces")
    if isinstance(parts, dict):
        fields["spaces"] = [(key, build(part)) for key, part in parts.items()]
    elif parts is not None:
        fields["spaces"] = [build(part) for part in parts]
    space: Space = kind(**fields)
    return space
