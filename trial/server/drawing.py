"""What a server needs for a game that is drawn by objects: its images, and how its scenes become pictures."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from protocol.trial_sections import SceneSection
from trial.pictures import assets
from trial.pictures.assets import Assets
from trial.pictures.frames import Frame
from trial.pictures.reader import PictureReader
from trial.pictures.scene import Scene

if TYPE_CHECKING:
    from trial.pictures.raster import Raster

log = logging.getLogger("trial")


class Drawing:
    """Of a project without a `section` (`trial.scene`) there are no images, and its `render()` returns pixels.

    What is wrong with images and objects goes into the log, each sentence once.
    """

    def __init__(self, section: SceneSection | None, project: Path) -> None:
        """Read the project's images."""
        self._section = section
        self.assets = Assets() if section is None else assets.load(project, section.assets)
        self.reader = PictureReader(section, self.assets, log.warning)
        self._raster: Raster | None = None
        for problem in self.assets.problems:
            log.warning(problem)

    def draw(self, scene: Scene) -> Frame:
        """The scene as pixels, for a client that does not draw scenes. Any thread may call it."""
        if self._raster is None:
            from trial.pictures.raster import Raster  # noqa: PLC0415 - most servers never need it

            assert self._section is not None
            self._raster = Raster(self._section, self.assets)
        return self._raster.draw(scene)
