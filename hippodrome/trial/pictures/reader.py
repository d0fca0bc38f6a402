"""Reads the pictures that `render()` returns, and draws scenes for clients that do not draw them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hippodrome.protocol.trial_sections import SceneSection
from hippodrome.trial.pictures import assets, frames
from hippodrome.trial.pictures.assets import Assets
from hippodrome.trial.pictures.frames import Frame
from hippodrome.trial.pictures.scene import Scene, SceneError, as_scene, images_of, is_scene

Picture = Frame | Scene
"""A picture that clients are shown. It must not be changed."""


def as_picture(value: Any, before: Scene | None = None, *, scenes: bool = True) -> Picture:
    """Read the picture that `render()` returned. `before` is the episode's last scene (see `as_scene`).

    `scenes` says whether config.yml has `trial.scene`. Raises FrameError or SceneError, with a sentence for the
    researcher.
    """
    if not is_scene(value):
        return frames.as_frame(value)
    if not scenes:
        raise SceneError("render() returned objects; say in config.yml how large the picture is, as trial.scene")
    return as_scene(value, before)


_MAX_SENTENCES = 100  # the most sentences for `tell`: a long game may have ever new mistakes


class PictureReader:
    """Reads the pictures of one agent. `tell` is called with each sentence about objects that cannot be drawn, once.

    `section` is `trial.scene` of config.yml. If it is None, `render()` may return pixels alone.
    """

    def __init__(
        self,
        section: SceneSection | None = None,
        assets: Assets = Assets(),  # noqa: B008 - it never changes
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._section = section
        self._assets = assets
        self._tell = tell
        self._before: dict[str, Scene] = {}  # the latest scene, by view
        self._images: dict[str, frozenset[str]] = {}  # the images of that scene, by view
        self._told: set[str] = set()
        self.first_due = False
        """Whether the episode's first picture must still be read, since permanent objects may be in that picture
        alone."""

    def begin_episode(self) -> None:
        """Forget the permanent objects of the episode before, since the environment was reset."""
        self._before.clear()
        self.first_due = self._section is not None

    def read(self, value: Any, view: str = "") -> Picture:
        """Read the picture that `render()` returned for a player's view. Raises FrameError or SceneError."""
        self.first_due = False
        if isinstance(value, np.ndarray):  # the usual case: the shortest way for it
            return frames.as_frame(value)
        picture = as_picture(value, self._before.get(view), scenes=self._section is not None)
        if isinstance(picture, Scene):
            self._before[view] = picture
            for sentence in picture.problems:
                self._tell_once(f"render(): {sentence}")
            self._look_for_images(picture, view)
        return picture

    def _look_for_images(self, scene: Scene, view: str) -> None:
        """Call `tell` about images of the scene that are missing."""
        images = images_of(scene)
        if images == self._images.get(view):
            return
        self._images[view] = images
        assert self._section is not None
        for name in sorted(images - self._assets.by_name.keys()):
            shown = next(key for key, scene_object in scene.objects.items() if scene_object.get("image") == name)
            self._tell_once(
                f"render(): the object {shown!r} shows the image {name!r}, which is not in {self._section.assets}/"
            )

    def _tell_once(self, sentence: str) -> None:
        if sentence not in self._told and len(self._told) < _MAX_SENTENCES:
            self._told.add(sentence)
            self._tell(sentence)


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
