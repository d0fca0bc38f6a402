"""Reads scenes: pictures that are described by objects instead of pixels (docs/objects.md). Pure.

`scene_object.py` reads and checks one object. This module makes a scene of the objects. It takes
over from the previous scene what has not changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import compress, count
from operator import ne
from typing import Any

from hippodrome.trial.pictures.scene_object import (
    MAX_TEXT,
    CheckedObject,
    UnusableValue,
    checked_again,
    checked_object,
    fields_of,
    has_fields,
    is_map,
    mapping_of,
    shown_name,
)

MAX_OBJECTS = 2_000
"""The most objects of one scene, with the permanent ones of scenes before it."""
MAX_POINTS_IN_ALL = 20_000
"""The most points of all lines and polygons of one scene."""
MAX_TEXT_IN_ALL = 100_000
"""The most characters of all texts of one scene."""
MAX_PROBLEMS = 20
"""The most sentences about the mistakes in one scene."""


class SceneError(ValueError):
    """`render()` returned something that is no scene. The message is for the researcher."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A picture that is described by objects. It never changes, so connections may keep it."""

    objects: Mapping[str, CheckedObject]
    """The objects by id: permanent ones, then in the order of `render()`. At the same depth a later one covers
    others."""
    hud: str = ""
    """A line of text beside the score."""
    permanent: frozenset[str] = frozenset()
    """The ids of objects that stay until the episode ends, though `render()` does not return them again."""
    problems: tuple[str, ...] = field(default=(), compare=False)
    """The mistakes in single objects, in sentences for the researcher. Objects that cannot be drawn are left out."""
    given: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, compare=False, repr=False)
    """The objects as `render()` returned them, by id. An object that it returns unchanged is not checked again."""
    images: frozenset[str] | None = field(default=None, compare=False, repr=False)
    """The names of the images that its sprites show; None if they are not known yet (see `images_of`)."""
    letters: int = field(default=0, compare=False, repr=False)
    """The number of characters of all texts, or more if texts were replaced or removed since they were counted."""


def is_scene(picture: Any) -> bool:
    """Whether `render()` returned objects, correct or not, and not an array of pixels."""
    if not isinstance(picture, list | tuple):
        return isinstance(picture, Mapping)
    return not picture or is_map(picture[0]) or has_fields(picture[0]) or isinstance(picture[0], str)


def as_scene(value: Any, before: Scene | None = None) -> Scene:
    """Read the scene that `render()` returned: a list of objects, or `{"objects": […], "hud": "text"}`.

    `before` is the scene before it in the same episode: its permanent objects stay. An object that did not change is
    the same Python object in both scenes. Raises SceneError if `value` has neither form or more than MAX_OBJECTS.
    """
    objects_given, hud = _parts(value)
    if before is not None and (scene := _changed_in_place(before, objects_given, hud)) is not None:
        return scene
    builder = _SceneBuilder(before or Scene({}))
    builder.add_all(objects_given)
    return builder.scene(hud)


def _changed_in_place(before: Scene, values: Sequence[Any], hud: str) -> Scene | None:
    """Return the scene `before` with new values of some objects, as most scenes are; None if anything else changed.

    `map` compares all objects in one call, since a loop in Python over them would take most of the time of a scene.
    """
    names = list(before.objects)[len(before.permanent) :]
    if len(names) != len(values) or list(before.given) != names or not _MAPS.issuperset(map(type, values)):
        return None
    try:
        changed = list(compress(count(), map(ne, before.given.values(), values)))
    except Exception:  # noqa: BLE001 - the researcher's values may raise anything; `_SceneBuilder` reports it
        return None
    objects, given_before, images, letters = dict(before.objects), dict(before.given), before.images, before.letters
    for index in changed:
        name = names[index]
        earlier, value = objects[name], values[index]
        checked = checked_again(earlier, given_before[name], value)
        if checked is None:
            return None
        objects[name], given_before[name] = checked, dict(value)
        if earlier.get("image") != checked.get("image"):
            images = _images(objects)
        if "text" in checked and (letters := letters + len(checked["text"]) - len(earlier["text"])) > MAX_TEXT_IN_ALL:
            return None
    return Scene(objects, hud, before.permanent, (), given_before, images, letters)


class _SceneBuilder:
    """Builds a scene after the scene `before`."""

    def __init__(self, before: Scene) -> None:
        self._before = before
        self._permanent = permanent = set(before.permanent)
        self._objects = (
            {name: scene_object for name, scene_object in before.objects.items() if name in permanent}
            if permanent
            else {}
        )
        self._not_returned = set(self._objects)
        """The permanent objects of `before` that `render()` has not returned again so far."""
        self._given: dict[str, Mapping[str, Any]] = {}
        self._problems: list[str] = []
        self._points = sum(len(scene_object.get("points", ())) for scene_object in self._objects.values())
        self._new_letters = 0  # characters of texts that have changed

    def add_all(self, values: Sequence[Any]) -> None:
        """Add, change or remove objects. Most objects are as in the scene before, so these take the shortest way."""
        objects, before, given_before = self._objects, self._before.objects, self._before.given
        not_permanent = before.keys() - self._before.permanent  # permanent objects need `_put`
        room = len(objects) + len(values) <= MAX_OBJECTS
        for index, value in enumerate(values):
            name = value.get("id") if room and type(value) is dict else None
            if type(name) is str and name in not_permanent and name not in objects:
                try:
                    same = given_before.get(name) == value
                except Exception:  # noqa: BLE001 - the researcher's values may raise anything; `_add` reports it
                    same = False
                if same:
                    objects[name] = before[name]
                    self._given[name] = given_before[name]
                    continue
            self._add(value, index)

    def _add(self, value: Any, index: int) -> None:
        """Add, change or remove one object."""
        problems_before = len(self._problems)
        try:
            mapping = mapping_of(value)
            name = self._unchanged(mapping)
            if name is not None:
                self._put(name, self._before.objects[name], mapping)
                self._given[name] = self._before.given[name]
                return
            name, fields = fields_of(mapping, index, self._problems)
            self._given.pop(name, None)
            if fields.get("remove"):
                self._points -= len(self._objects.pop(name, {}).get("points", ()))
                self._permanent.discard(name)
                return
            if fields.get("type") == "text" and not self._has_room(fields.get("text")):
                return
            checked = checked_object(fields, name, self._problems)
        except UnusableValue as error:
            self._problems.append(f"{shown_name(value, index)} {error}")
            return
        except Exception as error:  # noqa: BLE001 - such as a researcher's method that raises, or a list in itself
            self._problems.append(f"object {index + 1} of render() cannot be read ({type(error).__name__})")
            return
        points = self._points + len(checked.get("points", ())) - len(self._objects.get(name, {}).get("points", ()))
        if points > MAX_POINTS_IN_ALL:
            self._problems.append(f"the scene has more than {MAX_POINTS_IN_ALL} points; some objects are left out")
            return
        self._points = points
        earlier = self._before.objects.get(name)
        self._put(name, earlier if earlier is not None and earlier == checked else checked, fields)
        # An object with values that may change in place, or with a problem, is checked again each time.
        if problems_before == len(self._problems) and _SCALARS.issuperset(map(type, mapping.values())):
            self._given[name] = dict(mapping)

    def _has_room(self, text: Any) -> bool:
        """Count this text if the scene has room for it; return whether it has.

        The caller leaves out a text without room, and does not check it: to check very many would delay the game.
        """
        letters = 0 if text is None else len(text if isinstance(text, str) else str(text))
        if letters > MAX_TEXT:
            return True  # `checked_object` refuses it
        if self._new_letters + letters > MAX_TEXT_IN_ALL:
            self._problems.append(_TOO_MUCH_TEXT)
            return False
        self._new_letters += letters
        return True

    def _unchanged(self, mapping: Mapping[str, Any]) -> str | None:
        """Return the object's id if the scene before has it with the same values; else None."""
        name = mapping.get("id") or mapping.get("uuid")
        if type(name) is not str or name not in self._before.objects:
            return None
        try:
            return name if self._before.given.get(name) == mapping else None
        except ValueError:  # NumPy's arrays do not compare to True or False
            return None

    def _put(self, name: str, checked: CheckedObject, fields: Mapping[str, Any]) -> None:
        if name in self._objects and name not in self._not_returned:
            self._problems.append(f"two objects have the id {name!r}; the later one counts")
        if name not in self._objects and len(self._objects) >= MAX_OBJECTS:
            self._problems.append(
                f"the scene has more than {MAX_OBJECTS} objects with those that are permanent; some are left out"
            )
            return
        self._not_returned.discard(name)
        if fields.get("permanent"):
            self._permanent.add(name)
        else:
            self._permanent.discard(name)
        self._objects[name] = checked

    def scene(self, hud: str) -> Scene:
        """Return a scene of the objects so far. Permanent ones come first, as they will in later scenes."""
        objects, permanent = self._objects, self._permanent
        if permanent:
            first = {name: scene_object for name, scene_object in objects.items() if name in permanent}
            objects = first | {name: scene_object for name, scene_object in objects.items() if name not in permanent}
        letters = self._before.letters + self._new_letters
        if letters > MAX_TEXT_IN_ALL:
            objects, letters = self._with_few_letters(objects)
            permanent &= objects.keys()
        problems = tuple(dict.fromkeys(self._problems))[:MAX_PROBLEMS]
        return Scene(objects, hud, frozenset(permanent), problems, self._given, _images(objects), letters)

    def _with_few_letters(self, objects: dict[str, CheckedObject]) -> tuple[dict[str, CheckedObject], int]:
        """Leave out the texts for which there is no room.

        Return the objects, and the number of all texts' characters.
        """
        fitting: dict[str, CheckedObject] = {}
        letters = 0
        for name, scene_object in objects.items():
            text = scene_object.get("text", "")
            if letters + len(text) > MAX_TEXT_IN_ALL:
                self._problems.append(_TOO_MUCH_TEXT)
                self._given.pop(name, None)
                continue
            letters += len(text)
            fitting[name] = scene_object
        return fitting, letters


_TOO_MUCH_TEXT = f"the scene's texts have more than {MAX_TEXT_IN_ALL} characters; some are left out"
_MAPS = frozenset({dict})
_SCALARS = frozenset({str, int, float, bool, type(None)})


def images_of(scene: Scene) -> frozenset[str]:
    """Return the names of the images that the scene's sprites show."""
    return _images(scene.objects) if scene.images is None else scene.images


def _images(objects: Mapping[str, CheckedObject]) -> frozenset[str]:
    return frozenset(scene_object["image"] for scene_object in objects.values() if scene_object["type"] == "sprite")


def _parts(value: Any) -> tuple[Sequence[Any], str]:
    """Return the objects and the text of the HUD in what `render()` returned."""
    hud: Any = ""
    if not isinstance(value, list) and isinstance(value, Mapping):  # a list is the usual case
        if "objects" not in value:
            raise SceneError(
                "render() returned a map without 'objects'; return a list, or {'objects': […], 'hud': '…'}"
            )
        value, hud = value["objects"], value.get("hud")
    if not isinstance(value, list | tuple):
        raise SceneError(f"render() must return a list of objects, not {type(value).__name__}")
    if len(value) > MAX_OBJECTS:
        raise SceneError(f"render() returned {len(value)} objects; a scene has at most {MAX_OBJECTS}")
    try:
        return value, "" if hud is None else str(hud)[:MAX_TEXT]
    except Exception as error:
        raise SceneError(f"render() returned a hud that cannot be read ({type(error).__name__})") from error
