"""Interactive Gym's `RemoteConfig`, and the table of its options: the key of config.yml that each becomes here.

`python -m hippodrome.trial.interactive_gym.options` prints the table of docs/interactive-gym.md.
"""

# ruff: noqa: E501 - a table

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Self

from hippodrome.protocol.similar import did_you_mean


class Unplayable(ValueError):
    """The experiment cannot be played here. The message is for the researcher."""


class InputModes:
    """Whether a key acts once at each press, or as long as it is held."""

    SingleKeystroke = "single_keystroke"
    PressedKeys = "pressed_keys"


class PolicyTypes:
    """The values of `policy_mapping` for players without a policy of the researcher's."""

    Human = "human"
    Random = "random"


class ActionSettings:
    """The action of a player who has chosen none."""

    PreviousSubmittedAction = "previous_submitted_action"
    DefaultAction = "default_action"


class RemoteConfig:
    """The settings of an experiment, each an attribute. docs/interactive-gym.md has a table of them."""

    def __init__(self) -> None:
        self.set_options: set[str] = set()
        """The options that the experiment has set by methods."""
        self.scenes: list[Any] = []
        """The scenes of the experiment in their order, if it consists of scenes."""
        for option in OPTIONS:
            setattr(self, option.name, option.new_default())

    def environment(self, **options: Any) -> Self:
        """Set options, and return the config. None leaves an option as it is. Raises TypeError for an unknown option."""
        for name, value in options.items():
            if name not in BY_NAME:
                raise TypeError(f"RemoteConfig has no option {name}{did_you_mean(name, BY_NAME)}")
            if value is not None:
                self.set_options.add(name)
                setattr(self, name, value)
        return self

    policies = gameplay = rendering = hosting = user_experience = logging = pyodide = environment

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"RemoteConfig has no option {name}{did_you_mean(name, BY_NAME)}")

    @property
    def humans(self) -> list[Any]:
        """The players that participants play."""
        return [player for player, plays in self.policy_mapping.items() if plays == PolicyTypes.Human]


@dataclass(frozen=True, slots=True)
class Look:
    """What the environment is like."""

    several: bool
    """Whether it has several players."""
    actions: tuple[str, ...]
    """The names of the actions, by number."""
    objects: bool
    """Whether it is drawn by objects, and not by pixels."""
    game: Any
    """The `RemoteGame` of its first episode."""

    def action(self, option: str, number: Any) -> str:
        """Return the name of an action. Raises Unplayable if there is none of this number; `option` names the place."""
        try:
            return self.actions[range(len(self.actions))[operator.index(number)]]
        except (TypeError, IndexError):
            raise Unplayable(f"{option} is the action {number!r}; there are 0 to {len(self.actions) - 1}") from None


@dataclass(frozen=True, slots=True)
class Option:
    """An option of `RemoteConfig`."""

    name: str
    default: Any
    """The default value; a type such as `list` stands for an empty value of this type."""
    key: str = ""
    """The key of config.yml that it becomes."""
    meaning: str = ""
    """What else the documentation says about it."""
    value: Callable[[RemoteConfig, Look], Any] | None = None
    """Returns the key's value, or None if config.yml does not need the key; by default the option's own value."""
    ignored: str = ""
    """Why the option has no effect. It is printed if an experiment sets the option."""

    def new_default(self) -> Any:
        """Return the default value. A list or a dictionary is a new one at each call."""
        return self.default() if isinstance(self.default, type) else self.default


def settings(config: RemoteConfig, look: Look) -> dict[str, dict[str, Any]]:
    """Return the sections of config.yml with the keys that the options become. Raises Unplayable."""
    sections: dict[str, dict[str, Any]] = {"project": {}, "trial": {}}
    for option in OPTIONS:
        value = option.value(config, look) if option.value else getattr(config, option.name)
        if option.key and value is not None:
            *path, key = option.key.split(".")
            place: dict[str, Any] = sections
            for part in path:
                place = place.setdefault(part, {})
            place[key] = value
    return sections


def without_effect(config: RemoteConfig) -> list[str]:
    """Return a sentence about each option that the experiment has set and that has no effect."""
    return [
        f"{option.name} has no effect: {option.ignored}"
        for option in OPTIONS
        if option.ignored and getattr(config, option.name) != option.new_default()
    ]


def table() -> str:
    """Return the options as a table in Markdown."""
    rows = ["| option of `RemoteConfig` | what becomes of it |", "|---|---|"]
    for option in OPTIONS:
        no_effect = f"no effect: {option.ignored}" if option.ignored else ""
        meaning = "; ".join(filter(None, (option.key and f"`{option.key}`", option.meaning, no_effect)))
        rows.append(f"| `{option.name}` | {meaning} |")
    return "\n".join(rows) + "\n"


def number(value: float) -> float:
    """Return a whole number as an int, so that config.yml has 5 and not 5.0."""
    return int(value) if value == int(value) else value


def _keys(config: RemoteConfig, look: Look) -> Mapping[str, str] | None:
    return {
        "+".join(map(str, keys)) if isinstance(keys, tuple) else str(keys): look.action(repr(keys), action)
        for keys, action in config.action_mapping.items()
    } or None


def _input(config: RemoteConfig, _look: Look) -> str | None:
    return "single" if config.input_mode == InputModes.SingleKeystroke else None


def _buffer(config: RemoteConfig, look: Look) -> int | None:
    repeats = (
        config.action_population_method == ActionSettings.PreviousSubmittedAction and not config.run_through_pyodide
    )
    return 10_000 if repeats and _input(config, look) else None


def _patience(config: RemoteConfig, _look: Look) -> float | None:
    if len(config.humans) < 2 or config.waitroom_timeout is None:
        return None
    return number(max(10, min(3600, round(config.waitroom_timeout / 1000, 3))))


def _scene(name: str) -> Callable[[RemoteConfig, Look], Any]:
    """Return the function `value` of an option by which objects are drawn."""

    def value(config: RemoteConfig, look: Look) -> Any:
        own_value = getattr(config, name)
        return (round(own_value) if isinstance(own_value, float) else own_value) if look.objects else None

    return value


def _if_several(name: str) -> Callable[[RemoteConfig, Look], Any]:
    """Return the function `value` of an option about the round trips of several participants."""
    return lambda config, _: getattr(config, name) if len(config.humans) > 1 and config.max_ping is not None else None


def _if_set(name: str) -> Callable[[RemoteConfig, Look], Any]:
    """Return the function `value` of an option whose default is not taken over."""
    return lambda config, _: getattr(config, name) if name in config.set_options else None


OPTIONS: tuple[Option, ...] = (
    # environment
    Option("env_creator", None, "", "called on the server with `env_config` and `render_mode=\"rgb_array\"`"),
    Option("env_name", None, "trial.game", "a name only", lambda config, _: config.env_name or "experiment"),
    Option("env_config", dict, "", "given to `env_creator`"),
    Option("seed", 42, "trial.seed", "if you set it (Interactive Gym never uses it); otherwise each episode has a random seed, which the recording holds", _if_set("seed")),
    # policies
    Option("policy_mapping", dict, "", "`trial.players`: `Human` → `human`, `Random` → `random`, else a class in `agent.py`. If several players are human, `project.players` is their number: [several people](#several-people)"),
    Option("load_policy_fn", None, "", "called on the server, once for each policy; the path of a file below the present folder leads to its copy in the project. An ONNX file without functions is loaded and asked by those of `onnx_inference_utils`"),
    Option("policy_inference_fn", None, "", "called on the server, on a thread of its own for each player"),
    Option("frame_skip", 4, "trial.frameSkip", "in the other steps, a policy's player takes `default_action`, as in Interactive Gym (`trial.policyActions: single`)", lambda config, look: config.frame_skip if look.several else None),
    # gameplay
    Option("num_episodes", 1, "trial.maxEpisodes"),
    Option("max_steps", None, "trial.maxSteps", "", lambda config, _: None if config.max_steps is None else int(config.max_steps)),
    Option("action_mapping", dict, "trial.keys", "a tuple of keys becomes `ArrowLeft+ArrowUp`", _keys),
    Option("human_id", None, "", "", None, "`policy_mapping` says which players are human"),
    Option("default_action", None, "trial.idleAction", "", lambda config, look: None if config.default_action is None else look.action("default_action", config.default_action)),
    Option("input_mode", InputModes.PressedKeys, "trial.input", "`PressedKeys` → `held`, `SingleKeystroke` → `single`. A key that stays down then acts once, where Interactive Gym takes it again at each repetition by the keyboard; up to 4 presses wait for their step, there one. With `PressedKeys` and several keys down, the newest counts, there the first", _input),
    Option("action_population_method", ActionSettings.DefaultAction, "trial.actionBufferLifespan", "`PreviousSubmittedAction` with `SingleKeystroke`: a participant's action goes on until the next (10000); with `PressedKeys` it makes no difference, since the server knows which keys are held. For policies it has no effect. As in Interactive Gym, it is the other way round with `run_through_pyodide`: no effect for participants, and policies' actions go on (`trial.policyActions: held`)", _buffer),
    Option("callback", None, "trial.callbackSeconds", "10, since Interactive Gym waits for callbacks as long as they take; [callbacks](callbacks.md) of the project's `agent.py` call it with a `RemoteGame`; `remote_game.record(name, value)` writes into the recording, and so does what a method returns", lambda config, _: 10 if config.callback else None),
    Option("reset_freeze_s", 0, "trial.resetFreeze", "", lambda config, _: config.reset_freeze_s or None),
    # rendering
    Option("env_to_state_fn", None, "", "called on the server; its objects are drawn by the [browser](objects.md). Without it, `env.render()` is shown"),
    Option("hud_text_fn", None, "", "called on the server; the text stands beside the score"),
    Option("location_representation", "relative", "trial.scene.coordinates", "", _scene("location_representation")),
    Option("game_width", 600, "trial.scene.width", "", _scene("game_width")),
    Option("game_height", 400, "trial.scene.height", "", _scene("game_height")),
    Option("fps", 10, "trial.startingFrameRate", "Interactive Gym waits 1/fps after each step, so it is a little slower", lambda config, _: round(config.fps)),
    Option("background", "#FFFFFF", "trial.scene.background", "", _scene("background")),
    Option("state_init", list, "", "objects of each episode's first picture, which stay"),
    Option("assets_to_preload", list, "", "images and atlases are copied to the project's `assets/` under the `name` of each"),
    Option("preload_specs", None, "", "", None, "Interactive Gym does not read it; assets_to_preload names the images"),
    Option("assets_dir", "./static/assets/", "", "", None, "only the images that `assets_to_preload` names are copied"),
    Option("animation_configs", list, "", "", None, "name the frames of each animation in its atlas (docs/objects.md)"),
    # hosting
    Option("host", None, "", "", None, "on one machine only its own browsers reach a study; for others deploy it (docs/aws.md)"),
    Option("port", 8000, "", "the port at which the study runs on this machine"),
    Option("max_concurrent_games", 1, "project.maxServers", "if you set it", _if_set("max_concurrent_games")),
    Option("max_ping", None, "trial.maxPing", "if several players are human", _if_several("max_ping")),
    Option("min_ping_measurements", 5, "trial.pingSamples", "if several players are human", _if_several("min_ping_measurements")),
    # user_experience
    Option("page_title", "interactive-gym", "", "`project.name`"),
    Option("instructions_html_file", None, "", "a page of `steps/`, named by `trial.instructions`: it is shown before the game, and can be read again in a pause"),
    Option("instructions", "", "", "the same, as text or HTML"),
    Option("experiment_end_redirect_url", None, "", "a link on the last page, and after `redirect_timeout` the browser goes there"),
    Option("end_game_redirect_url", None, "", "an older name of `experiment_end_redirect_url`"),
    Option("waitroom_timeout_redirect_url", None, "", "where the last page leads those who found no other to play with"),
    Option("append_subject_id_to_redirect", False, "", "the participant's id is appended to that address"),
    Option("append_subject_name_to_redirect", False, "", "an older name of `append_subject_id_to_redirect`"),
    Option("redirect_timeout", 5000, "", "milliseconds until the last page leads on"),
    Option("waitroom_timeout", None, "project.patience", "if several players are human: milliseconds there, seconds here (10 to 3600)", _patience),
    Option("waitroom_time_randomization_interval_s", (0, 0), "", "", None, "a participant waits only until others are there"),
    Option("welcome_header_text", "", "", "the heading of the first page, `steps/welcome.html`"),
    Option("welcome_text", "", "", "the text of the first page"),
    Option("game_header_text", "", "", "the heading of the instructions, if they have no `<h1>`"),
    Option("game_page_text", "", "", "a part of the instructions"),
    Option("game_page_html_fn", None, "", "called once when the project is made, for the first human player; its HTML is a part of the instructions"),
    Option("between_episode_header", "", "", "the heading of the page between two episodes, named by `trial.betweenEpisodes`"),
    Option("between_episode_text", "", "", "the text of that page"),
    Option("final_page_header_text", "", "", "the heading of the last page, `steps/final.html`"),
    Option("final_page_text", "", "", "the text of the last page"),
    Option("reset_timeout", 3000, "trial.betweenEpisodes", "milliseconds there, seconds here; a page between two episodes stays until participants go on themselves", lambda config, _: number(config.reset_timeout / 1000)),
    # logging
    Option("logfile", "./server_log.log", "", "", None, "the logs of a run are in the folder that it names, and those on AWS come from `hippodrome logs`"),
    # pyodide
    Option("run_through_pyodide", False, "", "", None, "the environment runs on a participant's server, and not in the browser"),
    Option("environment_initialization_code", "", "", "without an `env_creator`, run on the server; its variable `env` is the environment"),
    Option("packages_to_install", list, "", "lines of the project's `requirements.txt`"),
    Option("on_game_step_code", "", "", "", None, "the game runs on a server"),
    Option("restart_pyodide", False, "", "", None, "the game runs on a server"),
)  # fmt: skip

BY_NAME = {option.name: option for option in OPTIONS}

if __name__ == "__main__":
    print(table(), end="")
