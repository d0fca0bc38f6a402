"""Interactive Gym's objects, as `env_to_state_fn` returns them, and its descriptions of images.

docs/objects.md says what each field means. `trial/pictures/scene_object.py` reads the objects, and `assets.py` the
descriptions of images.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any


def fields_of(value: Any) -> Any:
    """Return the fields of an object or of a description of an image by name. A map is returned as it is."""
    return value.as_dict() if hasattr(value, "as_dict") else value


class _Context:
    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name."""
        return {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}  # type: ignore[arg-type]


@dataclass
class Sprite(_Context):
    """An image, or a frame of an atlas."""

    uuid: str
    x: float
    y: float
    height: float
    width: float
    image_name: str | None = None
    frame: str | int | None = None
    object_size: int | None = None
    angle: float | None = None
    depth: float = 1
    animation: str | None = None
    object_type: str = "sprite"
    tween: bool = False
    tween_duration: int = 50
    permanent: bool = False


@dataclass
class Line(_Context):
    """A line through points."""

    uuid: str
    color: str
    width: float
    points: list[tuple[float, float]]
    object_type: str = "line"
    fill_below: bool = False
    fill_above: bool = False
    depth: float = -1
    permanent: bool = False


@dataclass
class Circle(_Context):
    """A filled circle."""

    uuid: str
    color: str
    x: float
    y: float
    radius: float
    alpha: float = 1
    object_type: str = "circle"
    depth: float = -1
    permanent: bool = False


@dataclass
class Polygon(_Context):
    """A filled polygon."""

    uuid: str
    color: str
    points: list[tuple[float, float]]
    alpha: float = 1
    object_type: str = "polygon"
    depth: float = -1
    permanent: bool = False


@dataclass
class Text(_Context):
    """A text."""

    uuid: str
    text: str
    x: float
    y: float
    size: int = 16
    color: str = "#000000"
    font: str = "Arial"
    depth: float = -1
    object_type: str = "text"
    permanent: bool = False


@dataclass
class AtlasSpec(_Context):
    """An image with the frames that a JSON file describes."""

    name: str
    img_path: str
    atlas_path: str
    object_type: str = "atlas_spec"


@dataclass
class MultiAtlasSpec(_Context):
    """An atlas of several images."""

    name: str
    img_path: str
    atlas_path: str
    object_type: str = "multi_atlas_spec"


@dataclass
class ImgSpec(_Context):
    """An image."""

    name: str
    img_path: str
    object_type: str = "img_spec"


@dataclass
class RenderedEnvRGB(_Context):
    """A picture of pixels."""

    name: str
    game_image: Any
    object_type: str = "rendered_env_rgb"
