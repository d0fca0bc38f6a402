"""Finds objects that are never in the picture: their places are pixels, but the scene's coordinates are relative."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from hippodrome.protocol.trial_sections import SceneSection
from hippodrome.trial.pictures.scene import Scene
from hippodrome.trial.pictures.scene_object import CheckedObject

LEAST = 5
"""A relative coordinate this large cannot be meant: objects that wait beside the picture are nearer to it."""
_LARGEST = 4096  # pixels of a sprite that has the size of its image


class Outside:
    """Finds the objects that are never in the picture, among the pictures of the episodes that `check` plays."""

    def __init__(self, section: SceneSection | None) -> None:
        self._size = (section.width, section.height) if section and section.coordinates == "relative" else None
        self._inside: set[tuple[str, str]] = set()
        self._outside: dict[tuple[str, str], tuple[float, float]] = {}

    def see(self, picture: Any) -> None:
        """Look at a picture, or at a picture for each player."""
        if self._size is None:
            return
        for view, scene in picture.items() if isinstance(picture, Mapping) else (("", picture),):
            for name, each in scene.objects.items() if isinstance(scene, Scene) else ():
                if (view, name) not in self._inside:
                    self._look_at((view, name), each, self._size)

    def found(self) -> dict[str, tuple[float, float]]:
        """Return the objects that were never in the picture, but would be if their coordinates were pixels.

        The result has one place of each object, by its name.
        """
        return {name: place for (_, name), place in self._outside.items()}

    def _look_at(self, key: tuple[str, str], each: CheckedObject, size: tuple[int, int]) -> None:
        places = list(_places(each))
        reach = _reach(each)
        spans = [(min(axis), max(axis)) for axis in zip(*places, strict=True)]
        away = any(
            high * length < -reach or low * length > length + reach
            for (low, high), length in zip(spans, size, strict=True)
        )
        as_pixels = all(low >= 0 and high <= length for (low, high), length in zip(spans, size, strict=True))
        if not away:
            self._inside.add(key)
            self._outside.pop(key, None)
        elif as_pixels and max(high for _, high in spans) >= LEAST:
            self._outside.setdefault(key, places[0])


def _places(each: CheckedObject) -> Iterator[tuple[float, float]]:
    """The points of an object, or its one place, as (x, y)."""
    if "points" in each:
        yield from ((x, y) for x, y in each["points"])
    else:
        yield each["x"], each["y"]


def _reach(each: CheckedObject) -> float:
    """The largest distance from its place at which an object is visible, in pixels."""
    if each["type"] == "sprite":
        return float(each.get("width", _LARGEST)) + float(each.get("height", _LARGEST))
    if each["type"] == "text":
        return float(len(each["text"]) * each.get("size", 16))
    if each["type"] in ("line", "polygon"):
        return float(each.get("width", 1) + each.get("outline_width", 1))
    return float(each.get("radius", 0) + each.get("width", 0) + each.get("height", 0) + each.get("outline_width", 1))
