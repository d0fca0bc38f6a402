"""Interactive Gym's objects, as `env_to_state_fn` returns them, and its descriptions of images and animations.

docs/objects.md says what each field means. `hippodrome/trial/pictures/scene_object.py` reads the objects, and
`files.py` the descriptions of images.
"""

from __future__ import annotations

import dataclasses
from typing import Any


def fields_of(value: Any) -> Any:
    """Return the fields of an object or of a description of an image by name. A map is returned as it is."""
    return value.as_dict() if hasattr(value, "as_dict") else value


class _Context:
    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name."""
        return dict(vars(self))


def _context(name: str, required: str, **defaults: Any) -> Any:
    """Make the class of an object: the names of the fields without a default value, and the others with theirs."""
    fields: list[Any] = [*required.split(), *((field, Any, value) for field, value in defaults.items())]
    return dataclasses.make_dataclass(name, fields, bases=(_Context,))


Sprite = _context(
    "Sprite", "uuid x y height width", image_name=None, frame=None, object_size=None, angle=None, depth=1,
    animation=None, object_type="sprite", tween=False, tween_duration=50, permanent=False,
)  # fmt: skip
Line = _context(
    "Line", "uuid color width points", object_type="line", fill_below=False, fill_above=False, depth=-1,
    permanent=False,
)  # fmt: skip
Circle = _context("Circle", "uuid color x y radius", alpha=1, object_type="circle", depth=-1, permanent=False)
Polygon = _context("Polygon", "uuid color points", alpha=1, object_type="polygon", depth=-1, permanent=False)
Text = _context(
    "Text", "uuid text x y", size=16, color="#000000", font="Arial", depth=-1, object_type="text", permanent=False,
)  # fmt: skip
ImgSpec = _context("ImgSpec", "name img_path", object_type="img_spec")
AtlasSpec = _context("AtlasSpec", "name img_path atlas_path", object_type="atlas_spec")
MultiAtlasSpec = _context("MultiAtlasSpec", "name img_path atlas_path", object_type="multi_atlas_spec")
Animation = _context("Animation", "key sprite_sheet_key frames", frameRate=None, repeat=-1, hideOnComplete=False)
