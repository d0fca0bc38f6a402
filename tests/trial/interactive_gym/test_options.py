"""RemoteConfig has the options of Interactive Gym, and the documentation says what becomes of each."""

from __future__ import annotations

from pathlib import Path

import pytest

from hippodrome.trial.interactive_gym import objects, options
from hippodrome.trial.interactive_gym.options import RemoteConfig
from hippodrome.trial.pictures.scene import as_scene

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
    "frame_skip",
    "num_episodes",
    "action_mapping",
    "human_id",
    "default_action",
    "action_population_method",
    "input_mode",
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
    # and those of a GymScene alone
    "max_steps",
    "on_game_step_code",
    "restart_pyodide",
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


def test_methods_can_be_chained_and_the_value_none_changes_nothing() -> None:
    config = RemoteConfig().rendering(fps=24, game_width=None).gameplay(num_episodes=3)
    assert (config.fps, config.game_width, config.num_episodes) == (24, 600, 3)
    assert config.logging(logfile="x").pyodide(run_through_pyodide=False).environment(env_config={"a": 1}) is config


def test_two_configs_do_not_share_lists() -> None:
    RemoteConfig().assets_to_preload.append("one")
    assert RemoteConfig().assets_to_preload == []


def test_an_unknown_option_is_refused_with_the_one_that_was_meant() -> None:
    with pytest.raises(TypeError, match=r"RemoteConfig has no option fsp; did you mean fps\?"):
        RemoteConfig().rendering(fsp=3)


def test_interactive_gyms_objects_become_a_scene_without_problems() -> None:
    drawn = [
        objects.Sprite("a", 0.1, 0.2, 30, 36, image_name="cook", frame="EAST.png", tween=True),
        objects.Line("b", "#000000", 3, [(0, 0), (1, 1)], fill_below=True, permanent=True),
        objects.Circle("c", "#ff0000", 0.5, 0.5, 10, alpha=0.5),
        objects.Polygon("d", "#00ff00", [(0, 0), (1, 1), (0, 1)]),
        objects.Text("e", "Time", 0.1, 0.1),
    ]
    scene = as_scene([each.as_dict() for each in drawn])
    assert scene.problems == ()
    assert set(scene.objects) == {"a", "b", "c", "d", "e"}
    assert scene.permanent == {"b"}
