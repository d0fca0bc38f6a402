"""A picture, as `render()` returns it: a frame (pixels) or a scene (objects). Pure."""

from __future__ import annotations

from typing import Any

from hippodrome.trial.pictures import frames
from hippodrome.trial.pictures.frames import Frame
from hippodrome.trial.pictures.scene import Scene, SceneError, as_scene, is_scene

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
