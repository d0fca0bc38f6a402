"""The images of a game that is drawn by objects, and its scenes as pixels for clients that do not draw scenes."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from hippodrome.protocol.trial_sections import SceneSection
from hippodrome.trial.pictures import assets
from hippodrome.trial.pictures.assets import Assets
from hippodrome.trial.pictures.frames import Frame
from hippodrome.trial.pictures.reader import PictureReader
from hippodrome.trial.pictures.scene import Scene

if TYPE_CHECKING:
    from hippodrome.trial.pictures.raster import Raster

log = logging.getLogger("trial")


class Drawing:
    """Holds the images of a project, and reads and draws its pictures.

    Problems with images and objects are logged, each sentence once.
    """

    def __init__(self, section: SceneSection | None, project: Path) -> None:
        """Read the project's images. `section` is `trial.scene`; None: no images, since `render()` returns pixels."""
        self._section = section
        self.assets = Assets() if section is None else assets.load(project, section.assets)
        self.reader = PictureReader(section, self.assets, log.warning)
        self._raster: Raster | None = None
        for problem in self.assets.problems:
            log.warning(problem)

    def draw(self, scene: Scene) -> Frame:
        """Draw the scene as pixels. May be called on any thread."""
        if self._raster is None:
            from hippodrome.trial.pictures.raster import Raster  # noqa: PLC0415 - most servers never need it

            assert self._section is not None
            self._raster = Raster(self._section, self.assets)
        return self._raster.draw(scene)
