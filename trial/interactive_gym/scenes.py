"""Interactive Gym's scenes, for experiments with one game and pages before and after it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Self

from protocol.similar import did_you_mean
from trial.interactive_gym.options import text_of
from trial.interactive_gym.playing import Unplayable
from trial.interactive_gym.remote_config import RemoteConfig

_NAMES = {
    "scene_header": "game_header_text",
    "scene_body": "instructions",
    "scene_body_filepath": "instructions_html_file",
    "in_game_scene_body": "game_page_text",
}
_FILES = {
    "in_game_scene_body_filepath": "game_page_text",
    "environment_initialization_code_filepath": "environment_initialization_code",
}
_IGNORED = {"on_game_step_code", "restart_pyodide"}


class _Scene:
    """A part of an experiment."""

    scene_id: str | None = None

    def scene(self, scene_id: str | None = None, experiment_config: Any = None, **_more: Any) -> Self:
        """Set the scene's id."""
        self.scene_id = scene_id or self.scene_id
        return self


Scene = _Scene
"""The name by which experiments import it, for type checkers."""


class SceneWrapper:
    """Several scenes that stand in a stager as one."""

    def __init__(self, scenes: Any, **_more: Any) -> None:
        self.scenes = list(scenes) if isinstance(scenes, list | tuple) else [scenes]


class GymScene(_Scene, RemoteConfig):
    """The scene of a game: a `RemoteConfig` in which the options for some texts have other names."""

    def __init__(self, scene_id: str | None = None, **_more: Any) -> None:
        super().__init__()
        self.scene_id = scene_id
        self.max_steps: int | None = None
        self.ignored: list[str] = []
        """The options of scenes that the experiment has set and that have no effect."""
        self.before: list[StaticScene] = []
        self.after: list[StaticScene] = []

    def _set(self, method: str, values: tuple[Any, ...], named: dict[str, Any]) -> Self:
        given: dict[str, Any] = {}
        for name, value in named.items():
            if name in _FILES:
                given[_FILES[name]] = Path(text_of(value)).read_text(encoding="utf-8")
            elif name == "max_steps":
                self.max_steps = value
            elif name in _IGNORED:
                self.ignored.append(name)
            else:
                given[_NAMES.get(name, name)] = value
        return super()._set(method, values, given)


class StaticScene(_Scene):
    """A page."""

    def __init__(self) -> None:
        self.scene_header = self.scene_subheader = self.scene_body = ""

    def display(
        self,
        scene_header: str | None = None,
        scene_subheader: str | None = None,
        scene_body: str | None = None,
        scene_body_filepath: str | None = None,
    ) -> Self:
        """Set the page's texts. Raises OSError if the file cannot be read."""
        if scene_body_filepath is not None:
            scene_body = Path(text_of(scene_body_filepath)).read_text(encoding="utf-8")
        self.scene_header = self.scene_header if scene_header is None else scene_header
        self.scene_subheader = self.scene_subheader if scene_subheader is None else scene_subheader
        self.scene_body = self.scene_body if scene_body is None else scene_body
        return self


class StartScene(StaticScene):
    """The first page."""


class EndScene(StaticScene):
    """The last page."""

    url: str | None = None
    append_subject_id = False

    def redirect(self, url: str | None = None, append_subject_id: bool | None = None) -> Self:
        """Set the address of the link on the page, and whether the participant's id is appended to it."""
        self.url = self.url if url is None else url
        self.append_subject_id = self.append_subject_id if append_subject_id is None else append_subject_id
        return self


class CompletionCodeScene(EndScene):
    """The last page, with the participant's completion code."""


class Stager:
    """Holds the scenes of an experiment in their order."""

    def __init__(self, scenes: Iterable[Any] = ()) -> None:
        self.scenes = list(_unpacked(scenes))


def _unpacked(scenes: Iterable[Any]) -> Iterator[Any]:
    for scene in scenes:
        yield from _unpacked(scene.scenes) if isinstance(scene, SceneWrapper) else (scene,)


class ExperimentConfig:
    """An experiment that consists of scenes."""

    def __init__(self) -> None:
        self.stager: Stager | None = None
        self.experiment_id: str | None = None
        self.hosted: dict[str, Any] = {}

    def experiment(self, experiment_id: str | None = None, stager: Stager | None = None, **_more: Any) -> Self:
        """Set the experiment's id and its scenes."""
        self.experiment_id = experiment_id or self.experiment_id
        self.stager = stager or self.stager
        return self

    def hosting(self, **options: Any) -> Self:
        """Set options of `RemoteConfig.hosting`: `host`, `port`, `max_ping`."""
        self.hosted |= options
        return self


def game_of(config: Any) -> Any:
    """Return the game of an experiment that consists of scenes. Its `before` and `after` get the pages around it.

    A `config` without scenes is returned as it is. Raises Unplayable if there is not exactly one game, or if a page
    cannot be shown.
    """
    stager = config.stager if isinstance(config, ExperimentConfig) else config
    if not isinstance(stager, Stager):
        return config
    games = [scene for scene in stager.scenes if isinstance(scene, GymScene)]
    if not games:
        raise Unplayable(
            "the stager has no game (GymScene); without one, a study is pages of steps/ alone (docs/pages.md)"
        )
    if len(games) > 1:
        raise Unplayable(
            f"the stager has {len(games)} games (GymScene), and a study has one game here: make an experiment of each, "
            "with its own file and link"
        )
    (game,) = games
    place = stager.scenes.index(game)
    game.before, game.after = stager.scenes[:place], stager.scenes[place + 1 :]
    plain = (StaticScene, StartScene, EndScene, CompletionCodeScene)
    for scene in [*game.before, *game.after]:
        if type(scene) not in plain:
            raise Unplayable(f"a {type(scene).__name__} is no page that can be shown; write a page of steps/ instead")
    if isinstance(config, ExperimentConfig):
        game.hosting(**config.hosted)
        game.env_name = game.env_name or config.experiment_id or game.scene_id
    return game


def __getattr__(name: str) -> Any:
    """Raise ImportError for a scene of Interactive Gym that is not here: `from … import` shows no other sentence."""
    if not name[:1].isupper():
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    known = ("GymScene", "SceneWrapper", "StaticScene", "StartScene", "EndScene", "CompletionCodeScene", "Stager")
    hint = did_you_mean(name, known) or "; its questions are written as a page of steps/ (docs/pages.md)"
    if name in ("RandomizeOrder", "RepeatScene"):
        hint = "; scenes are shown once, in the order of the stager"
    raise ImportError(f"there is no scene {name} here{hint}")
