"""Reads one object of a scene, and checks its fields (docs/objects.md). Pure.

A field may have its name in Interactive Gym's object contexts, such as `uuid`, `object_type` or `image_name`, or a
shorter one, such as `id`, `type` or `image`. A checked object has the shorter names.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, TypeGuard

import numpy as np

MAX_POINTS = 5_000
"""The most points of one line or polygon."""
MAX_TEXT = 1_000
"""The most characters of one text."""
MAX_TWEEN = 10_000
"""The longest tween, in milliseconds."""

_MAX_ID = 100  # characters
_FARTHEST = 1e6  # the largest coordinate or length
_DIGITS = 4  # digits of a relative coordinate: exact to a tenth of a pixel in a picture 1,000 pixels wide
_HEX = re.compile(r"#(?:[0-9a-fA-F]{3,4}|[0-9a-fA-F]{6}|[0-9a-fA-F]{8})")
_EXTENSION = re.compile(r"\.(?:png|jpe?g|webp)$", re.IGNORECASE)  # the names of images lack this ending
_FONT = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ,_-]{0,99}")

CheckedObject = Mapping[str, Any]
"""An object's fields as clients are sent them, as JSON values. A field with its default value is left out."""


class UnusableValue(ValueError):
    """A value of an object cannot be used.

    The message ends a sentence that begins with the object's or field's name.
    """


# ---- what `render()` returns of one object


def is_map(value: Any) -> TypeGuard[Mapping[str, Any]]:
    """Whether the value is a map."""
    return type(value) is dict or isinstance(value, Mapping)  # the first check is quicker


def has_fields(value: Any) -> bool:
    """Whether the value has `as_dict()`, as Interactive Gym's object contexts have, or is a dataclass."""
    return callable(getattr(value, "as_dict", None)) or (
        dataclasses.is_dataclass(value) and not isinstance(value, type)
    )


def mapping_of(value: Any) -> Mapping[str, Any]:
    """Return the fields of a map, of an object with `as_dict()`, or of a dataclass. Raises UnusableValue."""
    if is_map(value):
        return value
    convert = getattr(value, "as_dict", None)
    if callable(convert):
        value = convert()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if not isinstance(value, Mapping):
        raise UnusableValue(f"is no map of fields, but {type(value).__name__}")
    return value


def fields_of(value: Any, index: int, problems: list[str]) -> tuple[str, dict[str, Any]]:
    """Return the object's id, and its other fields under their shorter names. A field that is None counts as left out.

    An object without a usable id gets one by its `index`, such as `#1`, and a sentence in `problems`. Raises
    UnusableValue if the object has no fields.
    """
    fields = {
        _OTHER_NAMES.get(key, key): value_of_key
        for key, value_of_key in mapping_of(value).items()
        if value_of_key is not None
    }
    name = fields.pop("id", None)
    if isinstance(name, int | np.integer) and not isinstance(name, bool):
        name = str(name)
    if not isinstance(name, str) or not 0 < len(name) <= _MAX_ID:
        kind = str(fields.get("type", "object"))[:20]
        rule = "has no id" if name is None or name == "" else f"has an id that is no text of 1 to {_MAX_ID} characters"
        problems.append(f"object {index + 1} of render() ({kind}) {rule}; give each object an id that it keeps")
        name = f"#{index + 1}"
    return name, fields


def shown_name(value: Any, index: int) -> str:
    """Return the object's name in a sentence: by its id, or else by its `index`."""
    name = None
    if isinstance(value, Mapping):
        name = value.get("id", value.get("uuid"))
    elif has_fields(value):
        name = getattr(value, "id", getattr(value, "uuid", None))
    return f"object {index + 1} of render()" if name is None else f"the object {str(name)[:_MAX_ID]!r}"


def checked_object(fields: Mapping[str, Any], name: str, problems: list[str]) -> CheckedObject:
    """Check an object's fields, and return the fields to send. Raises UnusableValue if the object cannot be drawn.

    Each field that its type does not have gives a sentence in `problems`.
    """
    kind = fields.get("type")
    table = TYPES.get(kind) if isinstance(kind, str) else None
    if table is None:
        raise UnusableValue(f"has the type {str(kind)[:40]!r}; there are {', '.join(TYPES)}")
    checked: dict[str, Any] = {"type": kind}
    for key, (check, default) in table.items():
        value = fields.get(key)
        if value is None:
            if default is _NEEDED:
                raise UnusableValue(f"has no {key}, which a {kind} needs")
            continue
        try:
            value = check(value)
        except UnusableValue as error:
            raise UnusableValue(f"cannot be drawn: its {key} {error}") from None
        if value != default:
            checked[key] = value
    if fields.get("tween"):
        tween = _tween(fields)
        if tween:
            checked["tween"] = tween
    for key in fields.keys() - table.keys() - _COMMON_FIELDS:
        problems.append(f"the object {name!r} has a field {str(key)[:40]!r}, which a {kind} does not have")
    return checked


def checked_again(earlier: CheckedObject, mapping: Mapping[str, Any], value: Mapping[str, Any]) -> CheckedObject | None:
    """Return a checked object with new values of some fields, and check only these.

    `earlier` is the checked object, made of `mapping`; `value` is what `render()` returned now. Returns None if the
    whole object must be checked again.
    """
    if list(mapping) != list(value) or list(map(type, mapping.values())) != list(map(type, value.values())):
        return None
    if not _OTHER_NAMES.keys().isdisjoint(value):  # both names of one field may be there
        return None
    table, fields = TYPES[earlier["type"]], {}
    for key, new_value in value.items() - mapping.items():
        if key not in earlier or key not in table:  # the field had its default, or its value concerns other fields
            return None
        check, default = table[key]
        try:
            fields[key] = check(new_value)
        except UnusableValue:
            return None
        if fields[key] == default:
            return None
    return earlier if fields.items() <= earlier.items() else {**earlier, **fields}


# ---- values


_NO_NUMBERS = (bool, np.bool_, str, bytes)  # `float` takes values of these types, too, but they are no numbers


def _number(low: float, high: float) -> Callable[[Any], float]:
    """Return a function that checks a number, which must be from `low` to `high`."""

    def check(value: Any) -> float:
        if isinstance(value, _NO_NUMBERS):
            raise UnusableValue("is no number")
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            raise UnusableValue("is no number") from None
        if not math.isfinite(number):
            raise UnusableValue(f"is no finite number ({number})")
        if not low <= number <= high:
            raise UnusableValue(f"is {number:g}; it must be from {low:g} to {high:g}")
        return _short(number)

    return check


def _short(number: float) -> float:
    """Return the rounded number, as an int if it is whole: both take fewer bytes in JSON."""
    rounded = round(number, _DIGITS)
    return int(rounded) if rounded == int(rounded) else rounded


def _points(least: int) -> Callable[[Any], list[list[float]]]:
    """Return a function that checks a list of at least `least` points, which are pairs of numbers."""

    def check(value: Any) -> list[list[float]]:
        try:
            count = len(value)
        except TypeError:
            raise UnusableValue("are no list") from None
        if not least <= count <= MAX_POINTS:
            raise UnusableValue(f"are {count}; there must be {least} to {MAX_POINTS}")
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise UnusableValue("are not pairs of numbers") from None
        if array.shape != (count, 2):
            raise UnusableValue("are not pairs of numbers")
        if not np.isfinite(array).all() or np.abs(array).max() > _FARTHEST:
            raise UnusableValue("are not all finite numbers, or lie too far away")
        points: list[list[float]] = np.round(array, _DIGITS).tolist()
        return [[int(x) if x == int(x) else x, int(y) if y == int(y) else y] for x, y in points]

    return check


def _color(value: Any) -> str:
    """Check a color of CSS: `#rgb`, `#rgba`, `#rrggbb`, `#rrggbbaa` or a name."""
    if not isinstance(value, str):
        raise UnusableValue("is no color; write it as '#rrggbb'")
    if not _HEX.fullmatch(value) and not _is_color_name(value):
        raise UnusableValue(f"is no color: {value[:40]!r}; write it as '#rrggbb'")
    return value.lower()


@lru_cache(maxsize=256)
def _is_color_name(value: str) -> bool:
    from PIL import ImageColor  # noqa: PLC0415 - most games write colors as numbers

    return len(value) <= 30 and value.lower() in ImageColor.colormap


def _text(value: Any) -> str:
    text = str(value)
    if len(text) > MAX_TEXT:
        raise UnusableValue(f"has {len(text)} characters; at most {MAX_TEXT} are shown")
    if text.isprintable():
        return text
    return "".join(letter for letter in text if letter == "\n" or letter.isprintable())


def _image(value: Any) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= 200:
        raise UnusableValue("is no name of a file in the folder of assets")
    return _EXTENSION.sub("", value)


def _frame(value: Any) -> str:
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        return str(int(value))
    return _word(value)


def _word(value: Any) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= 200:
        raise UnusableValue("is no name")
    return value


def _font(value: Any) -> str:
    if not isinstance(value, str) or not _FONT.fullmatch(value):
        raise UnusableValue("is no name of a font, such as 'Arial'")
    return value


def _origin(value: Any) -> list[float]:
    try:
        x, y = value
    except (TypeError, ValueError):
        raise UnusableValue("is no pair of numbers from 0 to 1") from None
    share = _number(-10, 10)
    return [share(x), share(y)]


def _tween(fields: Mapping[str, Any]) -> float:
    """Return the milliseconds of a tween: `tween` if it is a number, or `tween_duration` if `tween` is true."""
    value = fields["tween"]
    if isinstance(value, bool | np.bool_):
        value = fields.get("tween_duration", _DEFAULT_TWEEN)
    try:
        return _number(0, MAX_TWEEN)(value)
    except UnusableValue as error:
        raise UnusableValue(f"cannot be drawn: its tween {error}") from None


_NEEDED: Any = object()  # stands in the place of a default
_DEFAULT_TWEEN = 50  # ms, as in Interactive Gym
_OTHER_NAMES = {"uuid": "id", "object_type": "type", "image_name": "image", "opacity": "alpha", "rotation": "angle"}
_COMMON_FIELDS = frozenset({"type", "permanent", "remove", "tween", "tween_duration", "object_size"})
"""The fields that an object of each type may have, apart from its fields in TYPES."""

_place, _length = _number(-_FARTHEST, _FARTHEST), _number(0, _FARTHEST)
_Table = Mapping[str, tuple[Callable[[Any], Any], Any]]
_COMMON: _Table = {"depth": (_place, 0), "alpha": (_number(0, 1), 1)}
_AT: _Table = {"x": (_place, _NEEDED), "y": (_place, _NEEDED)}
_TURNED: _Table = {"angle": (_place, 0), "origin": (_origin, [0, 0])}
_FILLED: _Table = {"color": (_color, "#000000"), "outline": (_color, None), "outline_width": (_length, 1)}

TYPES: Mapping[str, _Table] = {
    "sprite": {
        **_AT,
        "image": (_image, _NEEDED),
        "frame": (_frame, None),
        "animation": (_word, None),
        "width": (_length, None),
        "height": (_length, None),
        **_TURNED,
        **_COMMON,
    },
    "line": {
        "points": (_points(2), _NEEDED),
        "width": (_length, 1),
        "color": (_color, "#000000"),
        "fill_below": (bool, False),
        "fill_above": (bool, False),
        **_COMMON,
    },
    "circle": {**_AT, "radius": (_length, _NEEDED), **_FILLED, **_COMMON},
    "rectangle": {**_AT, "width": (_length, _NEEDED), "height": (_length, _NEEDED), **_FILLED, **_TURNED, **_COMMON},
    "polygon": {"points": (_points(3), _NEEDED), **_FILLED, **_COMMON},
    "text": {
        **_AT,
        "text": (_text, _NEEDED),
        "size": (_number(1, 1_000), 16),
        "color": (_color, "#000000"),
        "font": (_font, "Arial"),
        **_TURNED,
        **_COMMON,
    },
}
"""The fields of each type, each with the check of its value and its default. A field with its default is not sent."""
