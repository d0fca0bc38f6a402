"""The agent and the policies of the project that `server_app.run` makes from an experiment.

The project's agent.py gets them from `on_server.py`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from protocol import environment as variables
from trial.interactive_gym.configuration_constants import PolicyTypes
from trial.interactive_gym.object_contexts import fields_of
from trial.interactive_gym.remote_config import RemoteConfig
from trial.interactive_gym.remote_game import RemoteGame


class Unplayable(ValueError):
    """The experiment cannot be played here. The message is for the researcher."""


class Several:
    """Wraps an environment with several players: adds the attributes by which a PettingZoo `ParallelEnv` names them."""

    def __init__(self, env: Any, players: Iterable[Any]) -> None:
        self.env = env
        self.possible_agents = list(players)

    @property
    def unwrapped(self) -> Any:
        """The environment itself."""
        return getattr(self.env, "unwrapped", self.env)

    def action_space(self, player: Any) -> Any:
        """Return the space of a player's actions; None if it is not known."""
        return space_of(self.env, "action_space", player)

    def observation_space(self, player: Any) -> Any:
        """Return the space of a player's observations; None if it is not known."""
        return space_of(self.env, "observation_space", player)


def space_of(env: Any, name: str, player: Any) -> Any:
    """Return a player's space, by a method, a map by player, or the space of all players; None if it is not known."""
    for attribute in (getattr(env, name, None), getattr(env, f"{name}s", None)):
        if callable(attribute) and not hasattr(attribute, "sample"):
            try:
                return attribute(player)
            except (KeyError, TypeError, NotImplementedError):
                continue
        # `key in space` would ask a Dict space whether the key is a sample of it: so take its dict.
        by_player = getattr(attribute, "spaces", attribute)
        if isinstance(by_player, Mapping):
            if player in by_player:
                return by_player[player]
        elif attribute is not None:
            return attribute
    return None


def mapping_of(config: RemoteConfig) -> dict[Any, Any]:
    """Return `policy_mapping`. If it is empty, the only player is human: `human_id`, or else player_0."""
    if config.policy_mapping:
        return dict(config.policy_mapping)
    return {"player_0" if config.human_id is None else config.human_id: PolicyTypes.Human}


def humans_of(config: RemoteConfig) -> list[Any]:
    """Return the players that participants play."""
    return [player for player, plays in mapping_of(config).items() if plays == PolicyTypes.Human]


def make_environment(config: RemoteConfig) -> Any:
    """Make an environment as Interactive Gym does.

    Raises Unplayable if the config does not say how, and what the experiment's code raises.
    """
    if config.env_creator is not None:
        return config.env_creator(**config.env_config, render_mode="rgb_array")
    if config.environment_initialization_code:
        names: dict[str, Any] = {"__name__": "environment_initialization"}
        exec(compile(config.environment_initialization_code, "environment_initialization_code", "exec"), names)  # noqa: S102 - the researcher's own code
        if "env" not in names:
            raise Unplayable("environment_initialization_code makes no variable env")
        return names["env"]
    raise Unplayable("there is no environment: give environment(env_creator=…) a function that makes it")


class ExperimentAgent:
    """The agent of an experiment, with the methods of a class `Agent` (docs/agent.md)."""

    def __init__(self, config: RemoteConfig) -> None:
        self._config = config
        self._raw: Any = None  # the experiment's environment
        self._first = True  # whether the next picture is the episode's first
        self.game: RemoteGame | None = None
        self.env: Any = None
        self.several = False

    # ---- the five methods

    def start(self, _game: str | None = None) -> Any:
        """Make the environment, and return it."""
        config = self._config
        self._raw = make_environment(config)
        players = mapping_of(config)
        self.several = len(players) > 1 or _has_players(self._raw)
        self.game = RemoteGame(config, self._raw, players, os.environ.get(variables.USER_ID, ""))
        self.env = Several(self._raw, players) if self.several else self._raw
        return self.env

    def reset(self, seed: int | None = None) -> Any:
        """Begin an episode. Return its observation and infos."""
        game = self._game
        alone = len(game.human_players) == 1
        for key in game.human_players:  # with several participants, the researcher's code gets no participant's id
            game.human_players[key] = os.environ.get(variables.USER_ID, "") if alone else str(key)
        result = self._raw.reset(seed=seed)
        observation, infos = map(self._own, result if isinstance(result, tuple) and len(result) == 2 else (result, {}))
        game.began(observation, infos)
        self._first = True
        return observation, infos

    def step(self, action: Any) -> Any:
        """Take one step with an action, or with a map of the players' actions. Return the environment's five values."""
        game = self._game
        actions = action if isinstance(action, Mapping) else dict.fromkeys(mapping_of(self._config), action)
        # Interactive Gym's games in the browser give a map to every environment, also to one with a single player.
        by_player = self.several or self._config.run_through_pyodide
        result = tuple(map(self._own, self._raw.step(actions if by_player else action)))
        game.stepped(actions, result)
        return result

    def render(self) -> Any:
        """Return the present picture: objects with the HUD's text, or pixels."""
        config, game = self._config, self._game
        hud = "" if config.hud_text_fn is None else str(config.hud_text_fn(game))
        if config.env_to_state_fn is None:
            drawn = self._raw.render()
            if not isinstance(drawn, list):
                return drawn
        else:
            drawn = config.env_to_state_fn(self._raw, config)
        objects = [fields_of(each) for each in drawn]
        pixels = next((each for each in objects if _kind(each) == "rendered_env_rgb"), None)
        if pixels is not None:
            return _pixels(pixels)
        if self._first:
            self._first = False
            objects = [*({**fields_of(each), "permanent": True} for each in config.state_init), *objects]
        return {"objects": objects, "hud": hud}

    def close(self) -> None:
        """Close the environment, if it has a method `close`."""
        close = getattr(self._raw, "close", None)
        if callable(close):
            close()

    def _own(self, value: Any) -> Any:
        """Return the value of the only player, if the environment returned a map by player for a single one."""
        players = mapping_of(self._config)
        return value[next(iter(players))] if not self.several and _is_by_player(value, players) else value

    @property
    def _game(self) -> RemoteGame:
        assert self.game is not None, "start() comes first"
        return self.game


class ListeningAgent(ExperimentAgent):
    """The agent of an experiment with a callback, which it calls as Interactive Gym does.

    `on_game_tick_start` gets the state before a step. Nothing changes between two steps, so it is called after the
    previous step, or after the reset.
    """

    def on_episode_start(self, session: Any) -> Any:
        """Call the experiment's `on_episode_start`, and `on_game_tick_start` for the first step."""
        self._tell(session, "on_episode_start", "on_game_tick_start")

    def on_tick(self, session: Any) -> Any:
        """Call the experiment's callbacks of a step, and `on_game_tick_start` for the next step."""
        more = () if self._game.over else ("on_game_tick_start",)
        self._tell(session, "on_game_tick_end", "on_graphics_start", "on_graphics_end", *more)

    def on_episode_end(self, session: Any) -> Any:
        """Call the experiment's `on_episode_end`."""
        self._tell(session, "on_episode_end")

    def on_session_end(self, session: Any) -> Any:
        """Call the experiment's `on_game_end` if the game ends in the middle of an episode, as Interactive Gym does."""
        if not self._game.over:
            self._tell(session, "on_game_end")

    def _tell(self, session: Any, *events: str) -> None:
        """Call these methods of the callback, and record what each returns.

        If a method raises, the others are still called. Then the first exception is raised.
        """
        game, raised = self._game, []
        game.record = session.record
        for event in events:
            method = getattr(self._config.callback, event, None)
            if callable(method):
                try:
                    value = method(game)
                except Exception as error:  # noqa: BLE001 - the callback's other methods are still called
                    raised.append(error)
                else:
                    if value is not None:
                        session.record(event, value)
        if raised:
            raise raised[0]


def agent_class(config: RemoteConfig) -> type:
    """Make the class `Agent` for the project's agent.py."""
    base = ExperimentAgent if config.callback is None else ListeningAgent

    class Agent(base):  # type: ignore[misc, valid-type]
        """The experiment's agent."""

        def __init__(self) -> None:
            super().__init__(config)

    return Agent


def policy_class(config: RemoteConfig, player: Any, locate: Callable[[Any], Any]) -> type:
    """Make a class for agent.py that plays this player by the experiment's functions.

    `locate` gets the value in `policy_mapping`. If this names a file, it returns the file's path, else the value.
    """

    class Policy:
        """A policy of the experiment."""

        def __init__(self) -> None:
            plays = locate(config.policy_mapping[player])
            self._policy = plays if config.load_policy_fn is None else config.load_policy_fn(plays)

        def act(self, observation: Any, _info: Any) -> int:
            """Choose an action by the experiment's function."""
            if config.policy_inference_fn is not None:
                return int(config.policy_inference_fn(observation, self._policy))
            return int(self._policy(observation))

    return Policy


def located(folder: Path) -> Callable[[Any], Any]:
    """Make the argument `locate` of `policy_class`: it finds policies' files in the project's folder."""

    def locate(name: Any) -> Any:
        if isinstance(name, str | os.PathLike):
            for path in (folder / name, folder / "policies" / Path(name).name):
                if path.is_file():
                    return str(path)
        return name

    return locate


def _has_players(env: Any) -> bool:
    spaces = getattr(env, "action_spaces", None)
    return isinstance(spaces, Mapping) or bool(getattr(env, "possible_agents", None))


def _is_by_player(value: Any, players: Mapping[Any, Any]) -> bool:
    return isinstance(value, Mapping) and value.keys() == players.keys()


def _kind(value: Any) -> Any:
    return value.get("object_type") if isinstance(value, Mapping) else None


def _pixels(value: Mapping[str, Any]) -> Any:
    import numpy as np  # noqa: PLC0415 - only where pixels are drawn

    return np.asarray(value["game_image"], np.uint8)
