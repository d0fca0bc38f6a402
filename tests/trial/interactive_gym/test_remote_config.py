"""RemoteConfig has every option of Interactive Gym, and the documentation says what becomes of each."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import trial
from trial.interactive_gym import callback, object_contexts, options
from trial.interactive_gym.remote_config import RemoteConfig
from trial.pictures.scene import as_scene

ROOT = Path(__file__).resolve().parents[3]

# Interactive Gym's options, from its remote_config.py: commit af766f1 of its repository, and for the last row b87d2cb.
ITS_OPTIONS = [
    "env_creator",
    "env_name",
    "env_config",
    "seed",
    "host",
    "port",
    "max_concurrent_games",
    "load_policy_fn",
    "policy_inference_fn",
    "policy_mapping",
    "available_policies",
    "policy_configs",
    "frame_skip",
    "num_episodes",
    "action_mapping",
    "human_id",
    "default_action",
    "action_population_method",
    "input_mode",
    "game_has_composite_actions",
    "max_ping",
    "min_ping_measurements",
    "callback",
    "env_to_state_fn",
    "preload_specs",
    "hud_text_fn",
    "location_representation",
    "game_width",
    "game_height",
    "fps",
    "background",
    "state_init",
    "assets_dir",
    "assets_to_preload",
    "animation_configs",
    "experiment_end_redirect_url",
    "waitroom_timeout_redirect_url",
    "append_subject_id_to_redirect",
    "redirect_timeout",
    "instructions_html_file",
    "waitroom_time_randomization_interval_s",
    "page_title",
    "game_header_text",
    "welcome_header_text",
    "welcome_text",
    "game_page_text",
    "game_page_html_fn",
    "between_episode_header",
    "between_episode_text",
    "final_page_text",
    "final_page_header_text",
    "instructions",
    "reset_timeout",
    "reset_freeze_s",
    "waitroom_timeout",
    "logfile",
    "run_through_pyodide",
    "environment_initialization_code",
    "packages_to_install",
    "end_game_redirect_url",
    "append_subject_name_to_redirect",
]
ITS_DEFAULTS = {
    "seed": 42,
    "port": 8000,
    "frame_skip": 4,
    "num_episodes": 1,
    "fps": 10,
    "game_width": 600,
    "game_height": 400,
    "background": "#FFFFFF",
    "location_representation": "relative",
    "input_mode": "pressed_keys",
    "action_population_method": "default_action",
    "redirect_timeout": 5000,
    "reset_timeout": 3000,
    "page_title": "interactive-gym",
}


def test_every_option_is_there() -> None:
    assert sorted(ITS_OPTIONS) == sorted(options.BY_NAME)
    config = RemoteConfig()
    for name in ITS_OPTIONS:
        getattr(config, name)
    assert {name: getattr(config, name) for name in ITS_DEFAULTS} == ITS_DEFAULTS


def test_the_documentation_says_what_each_option_becomes() -> None:
    assert options.table() in (ROOT / "docs/interactive-gym.md").read_text()


def test_names_are_imported_from_interactive_gyms_modules() -> None:
    lines = (
        "from trial.remote_game import RemoteGame",
        "from trial.object_contexts import Circle, Line, Polygon",
        "from trial.stager import Stager",
        "import trial.callback",
        "from trial import callback, remote_game",
        "assert trial.callback is callback and remote_game.RemoteGame is RemoteGame",
        "assert callback.__name__ == 'trial.interactive_gym.callback'",
    )
    subprocess.run([sys.executable, "-c", "\n".join(lines)], cwd=ROOT, check=True)
    unknown = subprocess.run(
        [sys.executable, "-c", "import trial.waiting_room"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert "No module named 'trial.waiting_room'" in unknown.stderr


def test_methods_can_be_chained_and_the_value_none_changes_nothing() -> None:
    config = RemoteConfig().rendering(fps=24, game_width=None).gameplay(num_episodes=3).hosting("127.0.0.1", 5703)
    assert (config.fps, config.game_width, config.num_episodes, config.host, config.port) == (
        24, 600, 3, "127.0.0.1", 5703,
    )  # fmt: skip
    assert config.given == {"fps", "num_episodes", "host", "port"}
    assert config.logging(logfile="x").pyodide(run_through_pyodide=False).environment(env_config={"a": 1}) is config


def test_two_configs_do_not_share_lists() -> None:
    RemoteConfig().assets_to_preload.append("one")
    assert RemoteConfig().assets_to_preload == []


@pytest.mark.parametrize(
    ("method", "given", "said"),
    [
        ("rendering", {"fsp": 3}, r"rendering\(\) has no option fsp; did you mean fps\?"),
        ("hosting", {"fps": 3}, r"hosting\(\) has no option fps$"),
        ("gameplay", {"num_episodes": 0}, "num_episodes must be a whole number of at least 1, not 0"),
        ("rendering", {"location_representation": "metres"}, "location_representation must be relative or pixels"),
        ("hosting", {"max_concurrent_games": 0}, "max_concurrent_games must be at least 1"),
    ],
)
def test_unknown_options_and_wrong_values_are_refused(method: str, given: dict[str, object], said: str) -> None:
    with pytest.raises((TypeError, AssertionError), match=said):
        getattr(RemoteConfig(), method)(**given)


def test_composite_actions_and_waiting_rooms_are_described_as_by_interactive_gym() -> None:
    config = RemoteConfig().gameplay(action_mapping={"a": 1, ("a", "b"): 2})
    assert config.game_has_composite_actions
    assert not config.simulate_waiting_room
    assert config.user_experience(waitroom_time_randomization_interval_s=(5, 25)).simulate_waiting_room
    plain = config.environment(env_creator=print).to_dict(serializable=True)
    assert "env_creator" not in plain
    assert plain["fps"] == 10


def test_everything_that_an_experiment_imports_is_in_trial_and_none_of_it_is_loaded_before() -> None:
    for name in trial._INTERACTIVE_GYM:
        assert getattr(trial, name) is not None
    program = "import sys, trial; print([name for name in sys.modules if name.startswith('trial')])"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['trial']"
    with pytest.raises(AttributeError):
        trial.no_such_name  # noqa: B018


def test_interactive_gyms_objects_become_a_scene_without_problems() -> None:
    objects = [
        object_contexts.Sprite("a", 0.1, 0.2, 30, 36, image_name="cook", frame="EAST.png", tween=True),
        object_contexts.Line("b", "#000000", 3, [(0, 0), (1, 1)], fill_below=True, permanent=True),
        object_contexts.Circle("c", "#ff0000", 0.5, 0.5, 10, alpha=0.5),
        object_contexts.Polygon("d", "#00ff00", [(0, 0), (1, 1), (0, 1)]),
        object_contexts.Text("e", "Time", 0.1, 0.1),
    ]
    scene = as_scene([each.as_dict() for each in objects])
    assert scene.problems == ()
    assert set(scene.objects) == {"a", "b", "c", "d", "e"}
    assert scene.permanent == {"b"}


def test_several_callbacks_are_told_in_turn() -> None:
    told = []

    class First(callback.GameCallback):
        def on_game_tick_end(self, remote_game: object) -> None:
            told.append(("first", remote_game))

    class Second(callback.GameCallback):
        def on_game_tick_end(self, remote_game: object) -> None:
            told.append(("second", remote_game))

    both = callback.MultiCallback([First, Second])
    both.on_game_tick_end("the game")
    both.on_episode_start("the game")
    assert told == [("first", "the game"), ("second", "the game")]


class RecordingGame:
    """A game that keeps the values that are recorded."""

    def __init__(self) -> None:
        self.recorded: list[Any] = []

    def record(self, name: str, value: Any) -> None:
        self.recorded.append((name, value))


class Score(callback.GameCallback):
    def on_episode_end(self, remote_game: object) -> Any:
        return {"score": 3}


class Pace(callback.GameCallback):
    def on_episode_end(self, remote_game: object) -> Any:
        return [1, 2]


class Broken(callback.GameCallback):
    def on_episode_end(self, remote_game: object) -> Any:
        raise KeyError("score")


def test_what_several_callbacks_return_is_kept_by_their_names() -> None:
    several = callback.MultiCallback([Score, callback.GameCallback, Pace, Score])
    assert several.on_episode_end("the game") == {"Score": {"score": 3}, "Pace": [1, 2], "Score 2": {"score": 3}}
    assert several.on_game_tick_end("the game") is None


def test_a_callback_that_raises_takes_nothing_from_the_others() -> None:
    told = RecordingGame()
    with pytest.raises(KeyError):
        callback.MultiCallback([Score, Broken, Pace]).on_episode_end(told)
    assert told.recorded == [("on_episode_end", {"Score": {"score": 3}, "Pace": [1, 2]})]
