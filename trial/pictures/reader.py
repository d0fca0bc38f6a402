"""Reads what `render()` returns, picture after picture: a scene refers to the one before it. Pure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from protocol.trial_sections import SceneSection
from trial.pictures import frames
from trial.pictures.assets import Assets
from trial.pictures.picture import Picture, as_picture
from trial.pictures.scene import Scene, images_of

_MOST_SAID = 100  # sentences; an agent may find ever new ones


class PictureReader:
    """The pictures of one agent. `tell` gets a sentence about each thing that cannot be drawn, each sentence once.

    Without a `section`, config.yml has no `trial.scene`, and `render()` returns pixels alone.
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
        self._before: dict[str, Scene] = {}  # by view
        self._images: dict[str, frozenset[str]] = {}  # of the scene before, by view
        self._said: set[str] = set()
        self.due = False
        """The episode's first picture has not been drawn. Permanent objects may be in that one alone."""

    def begin_episode(self) -> None:
        """The environment was reset: permanent objects of the episode before are gone."""
        self._before.clear()
        self.due = self._section is not None

    def read(self, value: Any, view: str = "") -> Picture:
        """The picture that `render()` returned, for this player's view. Raises FrameError or SceneError."""
        self.due = False
        if isinstance(value, np.ndarray):  # the usual case, with nothing around it
            return frames.as_frame(value)
        picture = as_picture(value, self._before.get(view), scenes=self._section is not None)
        if isinstance(picture, Scene):
            self._before[view] = picture
            for sentence in picture.problems:
                self._say(f"render(): {sentence}")
            self._look_for_images(picture, view)
        return picture

    def _look_for_images(self, scene: Scene, view: str) -> None:
        images = images_of(scene)
        if images == self._images.get(view):
            return
        self._images[view] = images
        assert self._section is not None
        for name in sorted(images - self._assets.by_name.keys()):
            shown = next(key for key, each in scene.objects.items() if each.get("image") == name)
            self._say(
                f"render(): the object {shown!r} shows the image {name!r}, which is not in {self._section.assets}/"
            )

    def _say(self, sentence: str) -> None:
        if sentence not in self._said and len(self._said) < _MOST_SAID:
            self._said.add(sentence)
            self._tell(sentence)
