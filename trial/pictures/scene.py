"""Scenes: pictures that are described by objects instead of pixels (docs/objects.md). Pure.

The words are those of Interactive Gym's object contexts (`uuid`, `object_type`, `image_name`, …); `id`, `type` and
`image` are short for three of them. A checked object has one form (`Scene.objects`), whatever words it was given in.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

MOST_OBJECTS = 2_000
"""Of one scene, with those that stay from scenes before it."""
MOST_POINTS = 5_000
"""Points of one line or polygon."""
MOST_POINTS_IN_ALL = 20_000
LONGEST_TEXT = 1_000
"""Characters."""
MOST_PROBLEMS = 20
"""Sentences about one scene; what else is wrong goes unsaid until these are mended."""
LONGEST_TWEEN = 10_000
"""Milliseconds."""

_LONGEST_ID = 100
_FARTHEST = 1e6
_DIGITS = 4  # a relative coordinate then names a tenth of a pixel of a picture 1,000 pixels wide
_HEX = re.compile(r"#(?:[0-9a-fA-F]{3,4}|[0-9a-fA-F]{6}|[0-9a-fA-F]{8})")
_EXTENSION = re.compile(r"\.(?:png|jpe?g|webp)$", re.IGNORECASE)  # images are called without it
_FONT = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ,_-]{0,99}")

CheckedObject = Mapping[str, Any]
"""What is sent of an object: plain values of JSON. A field that has its default is left out."""


class SceneError(ValueError):
    """What `render()` returned is no scene. The message is for the researcher."""


class Wrong(ValueError):
    """A value of an object cannot be used; the words go on after the name of the field."""


@dataclass(frozen=True, slots=True)
class Scene:
    """What is to be seen. It never changes, so connections may keep it."""

    objects: Mapping[str, CheckedObject]
    """By id, permanent ones first, then in the order of `render()`: at the same depth a later one covers the others."""
    hud: str = ""
    """A line of text beside the score."""
    permanent: frozenset[str] = frozenset()
    """The ids of objects that stay until the episode ends, though `render()` does not return them again."""
    problems: tuple[str, ...] = field(default=(), compare=False)
    """What is wrong with single objects, in sentences for the researcher. What cannot be drawn is left out."""
    given: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, compare=False, repr=False)
    """What `render()` returned of objects that need no second check if it returns the same again."""


def is_scene(picture: Any) -> bool:
    """Whether `render()` returned objects (of whatever quality), and not an array of pixels."""
    if isinstance(picture, Mapping):
        return True
    if not isinstance(picture, list | tuple):
        return False
    return not picture or isinstance(picture[0], Mapping) or _has_fields(picture[0]) or isinstance(picture[0], str)


def as_scene(value: Any, before: Scene | None = None) -> Scene:
    """The scene that `render()` returned: a list of objects, or `{"objects": […], "hud": "text"}`.

    `before` is the scene before it in the same episode: its permanent objects stay. An object that did not change is
    the same object in both scenes. Raises SceneError if `value` is neither form or has far too many objects.
    """
    given, hud = _parts(value)
    making = _Making(before or Scene({}))
    for index, each in enumerate(given):
        making.add(each, index)
    return making.scene(hud)


class _Making:
    """A scene in the making, after the scene `before`."""

    def __init__(self, before: Scene) -> None:
        self._before = before
        self._permanent = set(before.permanent)
        self._objects = {name: each for name, each in before.objects.items() if name in before.permanent}
        self._kept = set(self._objects)
        """Permanent objects that were not returned again so far."""
        self._given: dict[str, Mapping[str, Any]] = {}
        self._problems: list[str] = []
        self._points = sum(len(each.get("points", ())) for each in self._objects.values())

    def add(self, value: Any, index: int) -> None:
        """Add an object, change it or remove it."""
        said = len(self._problems)
        try:
            given = _mapping(value)
            name = self._unchanged(given)
            if name is not None:
                self._put(name, self._before.objects[name], given)
                self._given[name] = self._before.given[name]
                return
            name, fields = _fields(given, index, self._problems)
            self._given.pop(name, None)
            if fields.get("remove"):
                self._points -= len(self._objects.pop(name, {}).get("points", ()))
                self._permanent.discard(name)
                return
            checked = _checked(fields, name, self._problems)
        except Wrong as error:
            self._problems.append(f"{_called(value, index)} {error}")
            return
        except Exception as error:  # noqa: BLE001 - methods of the researcher's objects, lists within lists without end
            self._problems.append(f"object {index + 1} of render() cannot be read ({type(error).__name__})")
            return
        points = self._points + len(checked.get("points", ())) - len(self._objects.get(name, {}).get("points", ()))
        if points > MOST_POINTS_IN_ALL:
            self._problems.append(f"the scene has more than {MOST_POINTS_IN_ALL} points; some objects are left out")
            return
        self._points = points
        earlier = self._before.objects.get(name)
        self._put(name, earlier if earlier is not None and earlier == checked else checked, fields)
        # What may change in place, and what something was to be said of, is checked again each time.
        if said == len(self._problems) and all(type(each) in _SCALARS for each in given.values()):
            self._given[name] = dict(given)

    def _unchanged(self, given: Mapping[str, Any]) -> str | None:
        """The object's id if just the same was given before, and found well."""
        name = given.get("id") or given.get("uuid")
        try:
            return name if type(name) is str and self._before.given.get(name) == given else None
        except ValueError:  # an array of NumPy's
            return None

    def _put(self, name: str, checked: CheckedObject, fields: Mapping[str, Any]) -> None:
        if name in self._objects and name not in self._kept:
            self._problems.append(f"two objects have the id {name!r}; the later one counts")
        if name not in self._objects and len(self._objects) >= MOST_OBJECTS:
            self._problems.append(
                f"the scene has more than {MOST_OBJECTS} objects with those that are permanent; some are left out"
            )
            return
        self._kept.discard(name)
        if fields.get("permanent"):
            self._permanent.add(name)
        else:
            self._permanent.discard(name)
        self._objects[name] = checked

    def scene(self, hud: str) -> Scene:
        """What was made. Permanent objects come first, as they will in the scenes after this one."""
        objects, permanent = self._objects, self._permanent
        if permanent:
            stays = {name: each for name, each in objects.items() if name in permanent}
            objects = stays | {name: each for name, each in objects.items() if name not in permanent}
        problems = tuple(dict.fromkeys(self._problems))[:MOST_PROBLEMS]
        return Scene(objects, hud, frozenset(permanent), problems, self._given)


_SCALARS = frozenset({str, int, float, bool, type(None)})


def images_of(scene: Scene) -> frozenset[str]:
    """The names of the images that its sprites show."""
    return frozenset(each["image"] for each in scene.objects.values() if each["type"] == "sprite")


def _parts(value: Any) -> tuple[Iterable[Any], str]:
    """The objects and the text of the HUD."""
    hud: Any = ""
    if isinstance(value, Mapping):
        if "objects" not in value:
            raise SceneError(
                "render() returned a map without 'objects'; return a list, or {'objects': […], 'hud': '…'}"
            )
        value, hud = value["objects"], value.get("hud")
    if not isinstance(value, list | tuple):
        raise SceneError(f"render() must return a list of objects, not {type(value).__name__}")
    if len(value) > MOST_OBJECTS:
        raise SceneError(f"render() returned {len(value)} objects; a scene has at most {MOST_OBJECTS}")
    try:
        return value, "" if hud is None else str(hud)[:LONGEST_TEXT]
    except Exception as error:
        raise SceneError(f"render() returned a hud that cannot be read ({type(error).__name__})") from error


def _has_fields(value: Any) -> bool:
    return callable(getattr(value, "as_dict", None)) or (
        dataclasses.is_dataclass(value) and not isinstance(value, type)
    )


def _mapping(value: Any) -> Mapping[str, Any]:
    """The object as a map: it is one, or has `as_dict()` (as Interactive Gym's have), or is a dataclass."""
    if isinstance(value, Mapping):
        return value
    convert = getattr(value, "as_dict", None)
    if callable(convert):
        value = convert()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {each.name: getattr(value, each.name) for each in dataclasses.fields(value)}
    if not isinstance(value, Mapping):
        raise Wrong(f"is no map of fields, but {type(value).__name__}")
    return value


def _fields(value: Any, index: int, problems: list[str]) -> tuple[str, dict[str, Any]]:
    """The object's id, and its fields under their one name; a field that is None counts as left out."""
    fields = {_SAME.get(key, key): each for key, each in _mapping(value).items() if each is not None}
    name = fields.pop("id", None)
    if isinstance(name, int | np.integer) and not isinstance(name, bool):
        name = str(name)
    if not isinstance(name, str) or not 0 < len(name) <= _LONGEST_ID:
        kind = str(fields.get("type", "object"))[:20]
        rule = (
            "has no id" if name is None or name == "" else f"has an id that is no text of 1 to {_LONGEST_ID} characters"
        )
        problems.append(f"object {index + 1} of render() ({kind}) {rule}; give each object an id that it keeps")
        name = f"#{index + 1}"
    return name, fields


def _called(value: Any, index: int) -> str:
    """How a sentence names the object."""
    name = None
    if isinstance(value, Mapping):
        name = value.get("id", value.get("uuid"))
    elif _has_fields(value):
        name = getattr(value, "id", getattr(value, "uuid", None))
    return f"object {index + 1} of render()" if name is None else f"the object {str(name)[:_LONGEST_ID]!r}"


def _checked(fields: Mapping[str, Any], name: str, problems: list[str]) -> CheckedObject:
    """The object's values as they are sent. Raises Wrong if it cannot be drawn."""
    kind = fields.get("type")
    table = TYPES.get(kind) if isinstance(kind, str) else None
    if table is None:
        raise Wrong(f"has the type {str(kind)[:40]!r}; there are {', '.join(TYPES)}")
    checked: dict[str, Any] = {"type": kind}
    for key, (check, default) in table.items():
        value = fields.get(key)
        if value is None:
            if default is _NEEDED:
                raise Wrong(f"has no {key}, which a {kind} needs")
            continue
        try:
            value = check(value)
        except Wrong as error:
            raise Wrong(f"cannot be drawn: its {key} {error}") from None
        if value != default:
            checked[key] = value
    if fields.get("tween"):
        tween = _tween(fields)
        if tween:
            checked["tween"] = tween
    for key in fields.keys() - table.keys() - _ANY:
        problems.append(f"the object {name!r} has a field {str(key)[:40]!r}, which a {kind} does not have")
    return checked


# ---- values


def _number(low: float, high: float) -> Callable[[Any], float]:
    def check(value: Any) -> float:
        if isinstance(value, bool | np.bool_ | str | bytes):
            raise Wrong("is no number")
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            raise Wrong("is no number") from None
        if not math.isfinite(number):
            raise Wrong(f"is no finite number ({number})")
        if not low <= number <= high:
            raise Wrong(f"is {number:g}; it must be from {low:g} to {high:g}")
        return _short(number)

    return check


def _short(number: float) -> float:
    """Rounded, and a whole number without a point: it needs fewer bytes."""
    rounded = round(number, _DIGITS)
    return int(rounded) if rounded == int(rounded) else rounded


def _points(least: int) -> Callable[[Any], list[list[float]]]:
    def check(value: Any) -> list[list[float]]:
        try:
            count = len(value)
        except TypeError:
            raise Wrong("are no list") from None
        if not least <= count <= MOST_POINTS:
            raise Wrong(f"are {count}; there must be {least} to {MOST_POINTS}")
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise Wrong("are not pairs of numbers") from None
        if array.shape != (count, 2):
            raise Wrong("are not pairs of numbers")
        if not np.isfinite(array).all() or np.abs(array).max() > _FARTHEST:
            raise Wrong("are not all finite numbers, or lie too far away")
        points: list[list[float]] = np.round(array, _DIGITS).tolist()
        return [[int(x) if x == int(x) else x, int(y) if y == int(y) else y] for x, y in points]

    return check


def color(value: Any) -> str:
    """A color as CSS writes it: `#rgb`, `#rrggbb`, with an alpha value at the end, or a name. Raises Wrong."""
    if not isinstance(value, str):
        raise Wrong("is no color; write it as '#rrggbb'")
    if not _HEX.fullmatch(value) and not _is_color_name(value):
        raise Wrong(f"is no color: {value[:40]!r}; write it as '#rrggbb'")
    return value.lower()


@lru_cache(maxsize=256)
def _is_color_name(value: str) -> bool:
    from PIL import ImageColor  # noqa: PLC0415 - most games write colors as numbers

    return len(value) <= 30 and value.lower() in ImageColor.colormap


def _text(value: Any) -> str:
    text = str(value)
    if len(text) > LONGEST_TEXT:
        raise Wrong(f"has {len(text)} characters; at most {LONGEST_TEXT} are shown")
    return "".join(letter for letter in text if letter == "\n" or letter.isprintable())


def _image(value: Any) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= 200:
        raise Wrong("is no name of a file in the folder of assets")
    return _EXTENSION.sub("", value)


def _frame(value: Any) -> str:
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        return str(int(value))
    return _word(value)


def _word(value: Any) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= 200:
        raise Wrong("is no name")
    return value


def _font(value: Any) -> str:
    if not isinstance(value, str) or not _FONT.fullmatch(value):
        raise Wrong("is no name of a font, such as 'Arial'")
    return value


def _flag(value: Any) -> bool:
    return bool(value)


def _origin(value: Any) -> list[float]:
    try:
        x, y = value
    except (TypeError, ValueError):
        raise Wrong("is no pair of numbers from 0 to 1") from None
    share = _number(-10, 10)
    return [share(x), share(y)]


def _tween(fields: Mapping[str, Any]) -> float:
    """Milliseconds: of a `tween` that is a number, or of `tween_duration`, if `tween` is true."""
    value = fields["tween"]
    if isinstance(value, bool | np.bool_):
        value = fields.get("tween_duration", _TWEEN)
    try:
        return _number(0, LONGEST_TWEEN)(value)
    except Wrong as error:
        raise Wrong(f"cannot be drawn: its tween {error}") from None


_NEEDED: Any = object()
_TWEEN = 50  # ms; Interactive Gym's
_SAME = {"uuid": "id", "object_type": "type", "image_name": "image", "opacity": "alpha", "rotation": "angle"}
_ANY = frozenset(
    {"type", "permanent", "remove", "tween", "tween_duration", "object_size"}
)  # what every object may have

_place, _length = _number(-_FARTHEST, _FARTHEST), _number(0, _FARTHEST)
_Table = Mapping[str, tuple[Callable[[Any], Any], Any]]
_COMMON: _Table = {"depth": (_place, 0), "alpha": (_number(0, 1), 1)}
_AT: _Table = {"x": (_place, _NEEDED), "y": (_place, _NEEDED)}
_TURNED: _Table = {"angle": (_place, 0), "origin": (_origin, [0, 0])}
_FILLED: _Table = {"color": (color, "#000000"), "outline": (color, None), "outline_width": (_length, 1)}

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
        "color": (color, "#000000"),
        "fill_below": (_flag, False),
        "fill_above": (_flag, False),
        **_COMMON,
    },
    "circle": {**_AT, "radius": (_length, _NEEDED), **_FILLED, **_COMMON},
    "rectangle": {**_AT, "width": (_length, _NEEDED), "height": (_length, _NEEDED), **_FILLED, **_TURNED, **_COMMON},
    "polygon": {"points": (_points(3), _NEEDED), **_FILLED, **_COMMON},
    "text": {
        **_AT,
        "text": (_text, _NEEDED),
        "size": (_number(1, 1_000), 16),
        "color": (color, "#000000"),
        "font": (_font, "Arial"),
        **_TURNED,
        **_COMMON,
    },
}
"""The fields of each type: the check of a value, and the default. A field at its default is not sent."""
