"""The table of all options of Interactive Gym's RemoteConfig: the method that sets each, its default, its meaning here.

`python -m trial.interactive_gym.options` prints the table of docs/interactive-gym.md.
"""

# ruff: noqa: E501 - a table

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from trial.interactive_gym.configuration_constants import ActionSettings, InputModes


@dataclass(frozen=True, slots=True)
class Option:
    """An option. `method` is empty for attributes that no method sets."""

    name: str
    method: str
    default: Any
    """The default value; a type such as `list` stands for an empty value of this type."""
    becomes: str
    """The option's meaning here, for the table in docs/interactive-gym.md."""
    ignored: str = ""
    """The reason, if the option has no effect here. It is printed if an experiment sets the option."""
    of_several: bool = False
    """Whether the option has an effect if several players are human. Then `ignored` is about other experiments."""

    def new_default(self) -> Any:
        """Return the default value. A list or a dictionary is a new one at each call."""
        return self.default() if isinstance(self.default, type) else self.default

    def read(self, value: Any) -> Any:
        """Return the value that the experiment sets; as a text, if the option is one."""
        is_text = isinstance(self.default, str) or self.name.endswith(("_url", "_file"))
        return text_of(value) if is_text and (value is not None or self.default is not None) else value


def text_of(value: Any) -> str:
    """Return the text that an option or a scene is given. Parts of a list, or of a tuple by a stray comma, are joined."""
    if isinstance(value, list | tuple):
        return "\n".join(map(text_of, value))
    return "" if value is None else str(value)


_ALONE = "each participant plays alone, so none waits for another"
_LOBBY = "a participant waits only until others are there"
_PING = (
    "no participant is turned away for a slow connection; what a connection cannot carry is left out of its pictures"
)
_PYODIDE = "the environment runs on a participant's server, and not in the browser"

OPTIONS: tuple[Option, ...] = (
    # environment
    Option("env_creator", "environment", None, "called by the project's `agent.py` with `env_config` and `render_mode=\"rgb_array\"`"),
    Option("env_name", "environment", None, "`trial.game`, a name only"),
    Option("env_config", "environment", dict, "given to `env_creator`"),
    Option("seed", "environment", 42, "`trial.seed`, if you set it (Interactive Gym never uses it); otherwise each episode has a random seed, which the recording holds"),
    # policies
    Option("policy_mapping", "policies", dict, "`trial.players`: `Human` → `human`, `Random` → `random`, else a class in `agent.py` or a file of `policies/`. If several players are human, `project.players` is their number: [several people](#several-people)"),
    Option("load_policy_fn", "policies", None, "called on the server, once for each policy; a path is that of the copy in the project"),
    Option("policy_inference_fn", "policies", None, "called on the server, on a thread of its own for each player"),
    Option("frame_skip", "policies", 4, "`trial.frameSkip`. In the other steps, a policy's player takes `default_action`, as in Interactive Gym (`trial.policyActions: single`)"),
    Option("available_policies", "", dict, "kept; neither Interactive Gym nor Hippodrome reads it"),
    Option("policy_configs", "", dict, "kept; neither Interactive Gym nor Hippodrome reads it"),
    # gameplay
    Option("num_episodes", "gameplay", 1, "`trial.maxEpisodes`"),
    Option("action_mapping", "gameplay", dict, "`trial.keys`; a tuple of keys becomes `ArrowLeft+ArrowUp`"),
    Option("human_id", "gameplay", None, "the player that is human, if `policy_mapping` is empty"),
    Option("default_action", "gameplay", None, "`trial.idleAction`"),
    Option("action_population_method", "gameplay", ActionSettings.DefaultAction, "`PreviousSubmittedAction` with `SingleKeystroke`: a participant's action goes on until the next (`trial.actionBufferLifespan: 10000`); with `PressedKeys` it makes no difference, since the server knows which keys are held. For policies it has no effect. As in Interactive Gym, it is the other way round with `run_through_pyodide`: no effect for participants, and policies' actions go on (`trial.policyActions: held`). `DefaultAction`: nothing goes on"),
    Option("input_mode", "gameplay", InputModes.PressedKeys, "`trial.input`: `PressedKeys` → `held`, `SingleKeystroke` → `single`. A key that stays down then acts once, where Interactive Gym takes it again at each repetition by the keyboard; up to 4 presses wait for their step, there one. With `PressedKeys` and several keys down, the newest counts, there the first"),
    Option("game_has_composite_actions", "", False, "follows from `action_mapping`"),
    Option("callback", "gameplay", None, "[callbacks](callbacks.md) of the project's `agent.py` call it with a `RemoteGame`; `remote_game.record(name, value)` writes into the recording, and so does what a method returns"),
    Option("reset_freeze_s", "gameplay", 0, "`trial.resetFreeze`"),
    # rendering
    Option("env_to_state_fn", "rendering", None, "called by `render()` of the project's `agent.py`; its objects are drawn by the [browser](objects.md). Without it, `env.render()` is shown"),
    Option("preload_specs", "rendering", None, "as `assets_to_preload`"),
    Option("hud_text_fn", "rendering", None, "called by `render()`; the text stands beside the score"),
    Option("location_representation", "rendering", "relative", "`trial.scene.coordinates`"),
    Option("game_width", "rendering", 600, "`trial.scene.width`"),
    Option("game_height", "rendering", 400, "`trial.scene.height`"),
    Option("fps", "rendering", 10, "`trial.startingFrameRate`. Interactive Gym waits 1/fps after each step, so it is a little slower"),
    Option("background", "rendering", "#FFFFFF", "`trial.scene.background`"),
    Option("state_init", "rendering", list, "objects of each episode's first picture, which stay"),
    Option("assets_dir", "rendering", "./static/assets/", "where images are looked for; those that are found are copied to the project's `assets/`"),
    Option("assets_to_preload", "rendering", list, "images and atlases are copied to the project's `assets/` under the `name` of each"),
    Option("animation_configs", "rendering", list, "`animations` of the atlas of the sprite sheet; they repeat for ever, whatever `repeat` says"),
    # hosting
    Option("host", "hosting", None, "no effect", "on one machine only its own browsers reach a study; for others deploy it (docs/aws.md)"),
    Option("port", "hosting", 8000, "the port of `python experiment.py`"),
    Option("max_concurrent_games", "hosting", 1, "`project.maxServers`, if you set it"),
    Option("max_ping", "hosting", None, "`trial.maxPing`", _PING, of_several=True),
    Option("min_ping_measurements", "", 5, "`trial.pingSamples`", _PING, of_several=True),
    # user_experience
    Option("page_title", "user_experience", "interactive-gym", "`project.name`"),
    Option("instructions_html_file", "user_experience", None, "a page of `steps/`, named by `trial.instructions`: it is shown before the game, and can be read again in a pause"),
    Option("instructions", "user_experience", "", "the same, as text or HTML"),
    Option("experiment_end_redirect_url", "user_experience", None, "a link on the last page, and after `redirect_timeout` the browser goes there"),
    Option("end_game_redirect_url", "user_experience", None, "an older name of `experiment_end_redirect_url`"),
    Option("waitroom_timeout_redirect_url", "user_experience", None, "where the last page leads those who found no other to play with", _ALONE, of_several=True),
    Option("append_subject_id_to_redirect", "user_experience", False, "the participant's id is appended to that address"),
    Option("append_subject_name_to_redirect", "user_experience", False, "an older name of `append_subject_id_to_redirect`"),
    Option("redirect_timeout", "user_experience", 5000, "milliseconds until the last page leads on"),
    Option("waitroom_timeout", "user_experience", None, "`project.patience`: milliseconds there, seconds here (10 to 3600)", _ALONE, of_several=True),
    Option("waitroom_time_randomization_interval_s", "user_experience", (0, 0), "no effect", _LOBBY),
    Option("welcome_header_text", "user_experience", "", "the heading of the first page, `steps/welcome.html`"),
    Option("welcome_text", "user_experience", "", "the text of the first page"),
    Option("game_header_text", "user_experience", "", "the heading of the instructions, if they have no `<h1>`"),
    Option("game_page_text", "user_experience", "", "a part of the instructions"),
    Option("game_page_html_fn", "user_experience", None, "called once when the project is made, for the human player; its HTML is a part of the instructions"),
    Option("between_episode_header", "", "", "the heading of the page between two episodes, named by `trial.betweenEpisodes`"),
    Option("between_episode_text", "", "", "the text of that page"),
    Option("final_page_header_text", "user_experience", "", "the heading of the last page, `steps/final.html`"),
    Option("final_page_text", "user_experience", "", "the text of the last page"),
    Option("reset_timeout", "", 3000, "`trial.betweenEpisodes`: milliseconds there, seconds here; no effect if there is a page between two episodes, from which participants go on themselves"),
    # logging
    Option("logfile", "logging", "./server_log.log", "no effect", "the logs of `make run` are in the folder that it names, and those on AWS come from `make logs`"),
    # pyodide
    Option("run_through_pyodide", "pyodide", False, "no effect", _PYODIDE),
    Option("environment_initialization_code", "pyodide", "", "without an `env_creator`, run on the server; its variable `env` is the environment"),
    Option("packages_to_install", "pyodide", list, "lines of the project's `requirements.txt`"),
)  # fmt: skip

BY_NAME = {option.name: option for option in OPTIONS}


def of_method(method: str) -> tuple[str, ...]:
    """Return the names of the options that a method sets, in the order of its parameters."""
    return tuple(option.name for option in OPTIONS if option.method == method)


def table() -> str:
    """Return the options as a table in Markdown."""
    rows = ["| option of `RemoteConfig` | set by | what becomes of it |", "|---|---|---|"]
    for option in OPTIONS:
        why = f": {option.ignored}" if option.ignored else ""
        if option.of_several:
            why = f"; if one player is human no effect{why}"
        rows.append(
            f"| `{option.name}` | {f'`{option.method}()`' if option.method else 'attribute'} | {option.becomes}{why} |"
        )
    return "\n".join(rows) + "\n"


_ASSERTIONS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "location_representation": (lambda value: value in ("relative", "pixels"), "must be relative or pixels"),
    "num_episodes": (lambda value: type(value) is int and value >= 1, "must be a whole number of at least 1"),
    "max_concurrent_games": (lambda value: value >= 1, "must be at least 1"),
    "run_through_pyodide": (lambda value: isinstance(value, bool), "must be true or false"),
}


def problem_of(name: str, value: Any) -> str | None:
    """Return a sentence on why Interactive Gym refuses this value of the option; None if it does not."""
    is_allowed, rule = _ASSERTIONS.get(name, (lambda _: True, ""))
    return None if is_allowed(value) else f"{name} {rule}, not {value!r}"


if __name__ == "__main__":
    print(table(), end="")
