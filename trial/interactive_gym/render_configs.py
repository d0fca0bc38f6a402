"""Interactive Gym's description of an animation."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any


@dataclass
class Animation:
    """Frames of an atlas, played one after the other."""

    key: str
    sprite_sheet_key: str
    frames: list[Any]
    frameRate: float | None = None  # noqa: N815 - Interactive Gym's name
    repeat: int = -1
    hideOnComplete: bool = False  # noqa: N815 - as above

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name."""
        return dataclasses.asdict(self)
