"""The kinds of recorded observations: which of Minari's spaces holds them, and their values in its form. Pure.

A recording has arrays packed, and everything else as JSON, in which a list may be an array, a tuple or a list, and null
may be NaN. A list of numbers becomes an array.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hippodrome.export.recording import unpack_array
from hippodrome.export.scrub import clean

Kind = tuple[Any, ...]
"""("array", dtype, shape), ("text",), ("dict", {key: kind} as pairs) or ("tuple", kinds)."""

_PLAIN = {"bool", "int64", "float64"}  # the dtypes of arrays that were numbers or lists


class Unlike(Exception):
    """No space of Minari holds these observations, or one is not like the others."""


def array_kind(dtype: str, shape: Sequence[int]) -> Kind:
    """Return the kind of an array. Raises Unlike if Minari could not read its space: `[]` has lost the other axes."""
    if 0 in shape[:-1]:
        raise Unlike
    return ("array", dtype, tuple(shape))


def kind_of(value: Any) -> Kind:
    """Return the kind of a recorded observation. Raises Unlike."""
    if isinstance(value, str):
        return ("text",)
    array = _as_array(value)
    if array is not None:
        return array_kind(array.dtype.name, array.shape)
    if isinstance(value, Mapping) and value and all(map(_is_name, value)):
        return ("dict", tuple((key, kind_of(part)) for key, part in value.items()))
    if isinstance(value, list) and value:
        return ("tuple", tuple(map(kind_of, value)))
    raise Unlike


def common(one: Kind, other: Kind) -> Kind:
    """Return the kind that holds the observations of both kinds. Raises Unlike."""
    if one == other:
        return one
    match one, other:
        case ("array", a, shape), ("array", b, same) if shape == same and {a, b} <= _PLAIN:
            return array_kind(np.promote_types(a, b).name, shape)
        case ("dict", parts), ("dict", others) if dict(parts).keys() == dict(others).keys():
            return ("dict", tuple((key, common(part, dict(others)[key])) for key, part in parts))
        case ("tuple", parts), ("tuple", others) if len(parts) == len(others):
            return ("tuple", tuple(map(common, parts, others)))
    raise Unlike


def texts_in(value: Any) -> list[str]:
    """Return all texts of an observation."""
    if isinstance(value, Mapping):
        return [] if _as_array(value) is not None else [text for part in value.values() for text in texts_in(part)]
    if isinstance(value, list):
        return [text for part in value for text in texts_in(part)]
    return [as_text(value)] if isinstance(value, str) else []


def as_text(value: str) -> str:
    """Return a text as HDF5 holds it, which takes no null characters."""
    return clean(value).replace("\0", "")


def together(kind: Kind, values: Sequence[Any]) -> Any:
    """Return the observations of an episode as Minari stores them. Raises Unlike if one is not of this kind."""
    match kind:
        case ("array", dtype, shape):
            stacked = np.empty((len(values), *shape), "uint8" if dtype == "bool" else dtype)
            for place, value in enumerate(values):
                array = _as_array(value)
                if array is None or array.shape != shape or not np.can_cast(array.dtype, dtype, "safe"):
                    raise Unlike
                stacked[place] = array
            return stacked
        case ("text",):
            if not all(isinstance(value, str) for value in values):
                raise Unlike
            return [as_text(value) for value in values]
        case ("dict", parts):
            names = dict(parts).keys()
            if not all(isinstance(value, Mapping) and value.keys() == names for value in values):
                raise Unlike
            return {key: together(part, [value[key] for value in values]) for key, part in parts}
        case (_, parts):
            if not all(isinstance(value, list) and len(value) == len(parts) for value in values):
                raise Unlike
            return tuple(together(part, [value[place] for value in values]) for place, part in enumerate(parts))
    raise Unlike


def space(kind: Kind, characters: str, longest: int) -> Any:
    """Return the space of observations of this kind. `characters` are those of its texts, `longest` their length."""
    from gymnasium import spaces  # noqa: PLC0415 - large, and imported when a dataset is made

    match kind:
        case ("array", "bool", shape):
            return spaces.Box(0, 1, shape, np.uint8)
        case ("array", dtype, shape) if dtype.startswith("float"):
            return spaces.Box(-np.inf, np.inf, shape, np.dtype(dtype).type)
        case ("array", dtype, shape):
            limits = np.iinfo(dtype)
            return spaces.Box(int(limits.min), int(limits.max), shape, np.dtype(dtype).type)
        case ("text",):
            return spaces.Text(max(longest, 1), min_length=0, charset=characters or " ")
        case ("dict", parts):
            return spaces.Dict({key: space(part, characters, longest) for key, part in parts})
    return spaces.Tuple([space(part, characters, longest) for part in kind[1]])


def _as_array(value: Any) -> np.ndarray[Any, Any] | None:
    """Return a packed array, a number or a list of numbers as an array; None for any other value."""
    if isinstance(value, np.ndarray):
        return value
    if isinstance(value, Mapping):
        try:
            data, dtype, shape = unpack_array(value)
        except (KeyError, TypeError, ValueError, zlib.error):
            return None
        return np.frombuffer(data, dtype).reshape(shape)
    if not _is_numbers(value):
        return None
    try:
        array = np.array(value)
        array = array.astype(float) if array.dtype == object else array
    except (ValueError, TypeError, OverflowError):  # lists of different lengths, or a whole number beyond 64 bits
        return None
    return array if array.dtype.kind in "biuf" else None


def _is_numbers(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(map(_is_numbers, value))
    return value is None or isinstance(value, bool | int | float)


def _is_name(key: str) -> bool:
    """Whether HDF5 can hold a part of this name."""
    return key not in ("", ".", "..") and "/" not in key and "\0" not in key
