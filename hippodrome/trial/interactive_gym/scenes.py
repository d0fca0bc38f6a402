"""Interactive Gym's scenes, for experiments with one game and pages before and after it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Self

from hippodrome.trial.interactive_gym.options import RemoteConfig, Unplayable

_NAMES = {
    "scene_header": "game_header_text",
    "scene_body": "instructions",
    "in_game_scene_body": "game_page_text",
}
"""The options of a game's scene that have another name in `RemoteConfig`. With `_filepath` each names a file."""


class Scene:
    """A part of an experiment."""

    def __init__(self) -> None:
        super().__init__()
        self.scene_id: str | None = None
        self.files: list[str] = []
        """The files that the script reads for the scene."""

    def scene(self, scene_id: str | None = None, **_options: Any) -> Self:
        """Set the scene's id."""
        self.scene_id = scene_id
        return self

    def read(self, options: dict[str, Any]) -> dict[str, Any]:
        """Replace each option whose name ends in `_filepath` by the option with the file's text. Raises OSError."""
        texts = {}
        for name, value in options.items():
            if name.endswith("_filepath") and value is not None:
                self.files.append(str(value))
                texts[name.removesuffix("_filepath")] = Path(value).read_text(encoding="utf-8")
            else:
                texts[name] = value
        return texts


class SceneWrapper:
    """Several scenes that stand in a stager as one."""

    def __init__(self, scenes: Any, **_options: Any) -> None:
        self.scenes = list(scenes) if isinstance(scenes, list | tuple) else [scenes]


class GymScene(Scene, RemoteConfig):
    """The scene of a game: a `RemoteConfig` in which the options for some texts have other names."""

    def environment(self, **options: Any) -> Self:
        """Set options as `RemoteConfig` does."""
        return super().environment(**{_NAMES.get(name, name): value for name, value in self.read(options).items()})

    policies = gameplay = rendering = hosting = user_experience = logging = pyodide = environment


class StaticScene(Scene):
    """A page."""

    scene_header = scene_subheader = scene_body = ""

    def display(self, **texts: Any) -> Self:
        """Set the page's texts: `scene_header`, `scene_subheader`, and `scene_body` or `scene_body_filepath`."""
        vars(self).update(self.read(texts))
        return self


class StartScene(StaticScene):
    """The first page."""


class EndScene(StaticScene):
    """The last page."""

    url: str | None = None
    append_subject_id = False

    def redirect(self, url: str | None = None, append_subject_id: bool = False) -> Self:
        """Set the address of the link on the page, and whether the participant's id is appended to it."""
        self.url, self.append_subject_id = url, append_subject_id
        return self


class CompletionCodeScene(EndScene):
    """The last page, with the participant's completion code."""


class Stager:
    """Holds the scenes of an experiment in their order."""

    def __init__(self, scenes: Iterable[Any], **_options: Any) -> None:
        self.scenes = list(_unpacked(scenes))


def _unpacked(scenes: Iterable[Any]) -> Iterator[Any]:
    for scene in scenes:
        yield from _unpacked(scene.scenes) if isinstance(scene, SceneWrapper) else (scene,)


class ExperimentConfig:
    """An experiment that consists of scenes."""

    def __init__(self) -> None:
        self.stager = Stager([])
        self.experiment_id: str | None = None
        self.host_options: dict[str, Any] = {}

    def experiment(self, experiment_id: str | None = None, stager: Stager | None = None, **_options: Any) -> Self:
        """Set the experiment's id and its scenes."""
        self.experiment_id = experiment_id or self.experiment_id
        self.stager = stager or self.stager
        return self

    def hosting(self, **options: Any) -> Self:
        """Set options of `RemoteConfig`: `host`, `port`, `max_ping`."""
        self.host_options |= options
        return self


def game_of(config: Any) -> RemoteConfig:
    """Return the game of an experiment. Raises Unplayable if it has not one game."""
    if isinstance(config, RemoteConfig):
        return config
    scenes = config.stager.scenes if isinstance(config, ExperimentConfig) else []
    games = [scene for scene in scenes if isinstance(scene, GymScene)]
    if len(games) != 1:
        raise Unplayable(
            f"the experiment has {len(games)} games (GymScene), and a study has one here: make an experiment of each, "
            "with its own file and link"
        )
    (game,) = games
    game.environment(**config.host_options, env_name=game.env_name or config.experiment_id)
    game.scenes = scenes
    return game


def __getattr__(name: str) -> Any:
    """Raise ImportError for a scene of Interactive Gym that is not here: `from … import` shows no other sentence."""
    if not name[:1].isupper():
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    raise ImportError(f"the scene {name} of Interactive Gym is not here (docs/interactive-gym.md#scenes)")
