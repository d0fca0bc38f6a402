"""Looks at an experiment on the researcher's machine: makes its environment, and begins one episode."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from protocol.session import MAX_PLAYERS
from trial.interactive_gym import onnx_inference_utils
from trial.interactive_gym.configuration_constants import ActionSettings, InputModes, PolicyTypes
from trial.interactive_gym.playing import ExperimentAgent, Unplayable, humans_of, mapping_of, space_of
from trial.interactive_gym.remote_config import RemoteConfig

_FASTEST = 240
_WORDS = re.compile(r"_+|(?<=[a-z0-9])(?=[A-Z])")  # between the words of a name


@dataclass(frozen=True, slots=True)
class Look:
    """The facts that were found about an experiment."""

    several: bool
    """Whether the environment has several players."""
    actions: int
    """The number of actions; of several players, the highest number."""
    counts: Mapping[Any, int]
    """The number of actions by player."""
    spaces: Mapping[Any, Any]
    """With several players: the observation space of each player; None if it is not known."""
    observations: Mapping[Any, Any]
    """With several players: the first observation of each player who has one."""
    human: Any
    """The first human player."""
    joined_as_sorted: bool
    """False if the last player's observation is a dictionary whose keys are not sorted.

    Interactive Gym joins its parts in the dictionary's order; Hippodrome's policies join them in the sorted order.
    """
    objects: bool
    """Whether the game is drawn by objects, and not by pixels."""
    game: Any
    """The experiment's RemoteGame, for `game_page_html_fn`."""


def look(config: RemoteConfig) -> Look:
    """Make the environment, begin an episode and draw it. Raises Unplayable, and what the experiment's code raises."""
    _check(config)
    agent = ExperimentAgent(config)
    env = agent.start(None)
    try:
        observation, _ = agent.reset(1)
        players = tuple(mapping_of(config))
        if agent.several:
            _check_players(players, observation)
        counts = {player: _count(env, player, several=agent.several) for player in players}
        picture = agent.render()
        by_player = observation if agent.several and isinstance(observation, Mapping) else None
        last = observation if by_player is None else by_player.get(players[-1])
        return Look(
            several=agent.several,
            actions=max(counts.values()),
            counts=counts,
            spaces={player: env.observation_space(player) for player in players} if agent.several else {},
            observations={player: by_player[player] for player in players if player in by_player} if by_player else {},
            human=next(iter(agent.game.human_players)) if agent.game else None,
            joined_as_sorted=not isinstance(last, Mapping) or list(last) == sorted(last, key=str),
            objects=isinstance(picture, Mapping),
            game=agent.game,
        )
    finally:
        agent.close()


def is_file(config: RemoteConfig, plays: Any) -> bool:
    """Whether `plays` is an ONNX file that Hippodrome itself plays, since the experiment has no functions for that."""
    ours = (onnx_inference_utils.load_onnx_policy_fn, onnx_inference_utils.onnx_model_inference_fn)
    functions = (config.load_policy_fn, config.policy_inference_fn)
    return isinstance(plays, str) and plays.endswith(".onnx") and functions in (ours, (None, None))


def names_of(config: RemoteConfig, actions: int, module: Mapping[str, Any]) -> list[str]:
    """Name the actions by the constants of the experiment's module (`LEFT = 1`), if each action has exactly one.

    Otherwise the actions' numbers are their names.
    """
    constants: dict[int, list[str]] = {}
    for name, value in module.items():
        if type(value) is int and 0 <= value < actions and name[:1].isupper():
            constants.setdefault(value, []).append(name.lower())
    if len(constants) == actions and all(len(names) == 1 for names in constants.values()):
        named = [constants[number][0] for number in range(actions)]
        if len(set(named)) == actions:
            return named
    return [str(number) for number in range(actions)]


def labels_of(names: Iterable[str], module: Mapping[str, Any]) -> dict[str, str]:
    """Return the labels of actions whose constants have several words, for participants: `Pick up` for `PickUp`."""
    labels = {}
    for name in names:
        constant = next((key for key, value in module.items() if type(value) is int and key.lower() == name), name)
        label = _WORDS.sub(" ", constant).lower().capitalize()
        if " " in label:
            labels[name] = label
    return labels


def _check(config: RemoteConfig) -> None:
    """Raise Unplayable for options that cannot work with any environment."""
    if "eventlet" in sys.modules:
        raise Unplayable("take `import eventlet` and `eventlet.monkey_patch()` out: it changes Python's own threads")
    mapping, humans = mapping_of(config), humans_of(config)
    if not humans:
        raise Unplayable("policy_mapping has no PolicyTypes.Human: say which player the participant plays")
    if len(humans) > MAX_PLAYERS:
        raise Unplayable(
            f"policy_mapping has {len(humans)} humans; at most {MAX_PLAYERS} participants play together: give the "
            "others a policy or PolicyTypes.Random"
        )
    for player, plays in mapping.items():
        known = plays in (PolicyTypes.Human, PolicyTypes.Random) if isinstance(plays, str) else False
        if not known and config.policy_inference_fn is None and not callable(plays) and not is_file(config, plays):
            raise Unplayable(f"there is no policies(policy_inference_fn=…) that could play {player} by {plays!r}")
    if not 1 <= round(config.fps) <= _FASTEST:
        raise Unplayable(f"fps must be from 1 to {_FASTEST}, not {config.fps}")
    modes = (InputModes.PressedKeys, InputModes.SingleKeystroke)
    if config.input_mode not in modes:
        raise Unplayable(f"input_mode must be one of {', '.join(modes)}, not {config.input_mode!r}")
    methods = (ActionSettings.DefaultAction, ActionSettings.PreviousSubmittedAction)
    if config.action_population_method not in methods:
        raise Unplayable(f"action_population_method must be one of {', '.join(methods)}")


def check_actions(config: RemoteConfig, actions: int) -> None:
    """Raise Unplayable if a key or `default_action` names an action that does not exist."""
    for key, action in {**config.action_mapping, "default_action": config.default_action}.items():
        if key == "default_action" and action is None:
            continue
        if isinstance(action, bool) or not _is_whole(action) or not 0 <= int(action) < actions:
            raise Unplayable(f"{key!r} leads to the action {action!r}; there are 0 to {actions - 1}")


def _is_whole(value: Any) -> bool:
    try:
        return bool(int(value) == value)
    except (TypeError, ValueError, OverflowError):
        return False


def _check_players(players: tuple[Any, ...], observation: Any) -> None:
    """Raise Unplayable if there are observations of players who are not in `policy_mapping`."""
    observed = list(observation) if isinstance(observation, Mapping) else []
    if not set(observed) <= set(players):
        raise Unplayable(
            f"the environment's players are {', '.join(map(repr, observed))}, and policy_mapping has "
            f"{', '.join(map(repr, players))}: write the environment's names"
        )


def _count(env: Any, player: Any, *, several: bool) -> int:
    """Return the number of a player's actions. Raises Unplayable if the environment does not say it."""
    space = env.action_space(player) if several else space_of(env, "action_space", player)
    count = getattr(space, "n", None)
    if count is None:
        if space is None:
            raise Unplayable(
                f"the environment does not say which actions {player!r} has: let action_space be a map that has the "
                f"key {player!r}, or a method, and its value a Discrete space"
            )
        raise Unplayable(f"the actions of {player} must be numbered (a Discrete space); they are {str(space)[:80]}")
    return int(count)
