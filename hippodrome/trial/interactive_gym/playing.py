"""Plays an experiment: the agent and the policies of the project's agent.py, which call the experiment's functions."""

from __future__ import annotations

import collections
import os
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hippodrome.protocol import environment as variables
from hippodrome.trial.core.players import ALL
from hippodrome.trial.interactive_gym import inference, script
from hippodrome.trial.interactive_gym.objects import fields_of
from hippodrome.trial.interactive_gym.options import RemoteConfig, Unplayable


class GameStatus:
    """The values of `RemoteGame.status`."""

    Done = "done"
    Active = "active"
    Inactive = "inactive"
    Reset = "reset"


def _unrecorded(name: str, value: Any) -> None:
    """Record nothing: only a callback can record values."""


class RemoteGame:
    """The present facts about the game, in Interactive Gym's attributes. Changing them does not change the game.

    `current_ping` is always 0, and `document_focus_status` always true: neither is measured here.
    """

    def __init__(self, config: Any, env: Any, players: Mapping[Any, Any], subject: str = "") -> None:
        """`players` is `policy_mapping`. `subject` is the participant's id; empty if several people play."""
        self.config = config
        self.env = env
        self.status = GameStatus.Inactive
        self.obs: Any = None
        self.game_id: Any = 0
        self.game_uuid = str(uuid.uuid4())
        self.tick_num = 0
        self.episode_num = 0
        self.human_players = {key: subject for key, plays in players.items() if plays == "human"}
        self.bot_players = {key: plays for key, plays in players.items() if plays != "human"}
        self.episode_rewards: dict[Any, float] = collections.defaultdict(float)
        self.total_rewards: dict[Any, float] = collections.defaultdict(float)
        self.total_positive_rewards: dict[Any, float] = collections.defaultdict(float)
        self.total_negative_rewards: dict[Any, float] = collections.defaultdict(float)
        self.prev_rewards: dict[Any, float] = {}
        self.prev_actions: dict[Any, Any] = {}
        self._ends: Sequence[Any] = (False, False)  # `terminated` and `truncated` of the last step
        self.current_ping: dict[Any, int] = collections.defaultdict(int)
        self.document_focus_status: dict[Any, bool] = collections.defaultdict(lambda: True)
        self.record: Callable[[str, Any], None] = _unrecorded
        """In a callback: `record(name, value)` writes a value into the recording (docs/callbacks.md)."""

    def began(self, observation: Any) -> None:
        """Set the attributes after the environment has been reset."""
        self.status = GameStatus.Active
        self.obs = observation
        self.prev_rewards, self.prev_actions = {}, {}
        self._ends = (False, False)
        self.tick_num = 0
        self.episode_num += 1
        self.episode_rewards = collections.defaultdict(float)

    def stepped(self, actions: Mapping[Any, Any], result: tuple[Any, Any, Any, Any, Any]) -> None:
        """Set the attributes after a step has been taken."""
        self.obs, rewards, *self._ends, _ = result
        self.prev_actions = dict(actions)
        self.prev_rewards = rewards if isinstance(rewards, dict) else {"reward": rewards}
        for key, reward in (rewards if isinstance(rewards, dict) else {0: rewards}).items():
            self.episode_rewards[key] += reward
            self.total_rewards[key] += reward
            self.total_positive_rewards[key] += max(0, reward)
            self.total_negative_rewards[key] += min(0, reward)
        self.tick_num += 1
        if self.over:
            last = self.episode_num >= self.config.num_episodes
            self.status = GameStatus.Done if last else GameStatus.Reset

    @property
    def over(self) -> bool:
        """Whether the episode has ended for all players."""
        ends = self._ends
        if not all(isinstance(end, Mapping) for end in ends):
            return any(map(bool, ends))
        players = {player for end in ends for player in end} - {ALL}
        all_ended = all(any(end.get(player) for end in ends) for player in players)
        return any(end.get(ALL) for end in ends) or (bool(players) and all_ended)


class GameCallback:
    """A callback that does nothing: the base class of an experiment's callbacks, with a method for each event.

    Those of the waiting room are never called: participants wait in the lobby, before their server runs.
    """

    def __init__(self, **_options: Any) -> None:
        """Take any options, as Interactive Gym does."""


_EVENTS = "episode_start episode_end game_tick_start game_tick_end graphics_start graphics_end game_end "
_WAITING = "waitroom_start waitroom_join waitroom_end waitroom_timeout"
for _event in (_EVENTS + _WAITING).split():
    setattr(GameCallback, f"on_{_event}", lambda _self, _remote_game: None)


class Several:
    """An environment with several players, which names them as a PettingZoo `ParallelEnv` does."""

    def __init__(self, env: Any, players: Iterable[Any]) -> None:
        self.env = env
        self.possible_agents = list(players)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)


def _make_environment(config: RemoteConfig) -> Any:
    """Make an environment as Interactive Gym does. Raises Unplayable if the config does not say how."""
    if config.env_creator is not None:
        return config.env_creator(**config.env_config, render_mode="rgb_array")
    names: dict[str, Any] = {"__name__": "environment_initialization"}
    code = config.environment_initialization_code
    exec(compile(code, "environment_initialization_code", "exec"), names)  # noqa: S102 - the researcher's own code
    if "env" not in names:
        raise Unplayable("there is no environment: give environment(env_creator=…) a function that makes it")
    return names["env"]


class ExperimentAgent:
    """The agent of an experiment, with the methods of a class `Agent` (docs/agent.md)."""

    def __init__(self, config: RemoteConfig) -> None:
        self._config = config
        self._players = config.policy_mapping
        self._raw: Any = None  # the experiment's environment
        self._takes_map = True  # whether the environment's `step` gets a map of actions by player
        self._first_step = True
        self._first_picture = True  # of the episode
        self.game: Any = None
        self.env: Any = None
        self.several = False

    # ---- the five methods

    def start(self, _game: str | None = None) -> Any:
        """Make the environment, and return it."""
        self._raw = _make_environment(self._config)
        has_players = isinstance(getattr(self._raw, "action_spaces", None), Mapping)
        self.several = len(self._players) > 1 or has_players or bool(getattr(self._raw, "possible_agents", None))
        self.game = RemoteGame(self._config, self._raw, self._players, os.environ.get(variables.USER_ID, ""))
        self.env = Several(self._raw, self._players) if self.several else self._raw
        return self.env

    def reset(self, seed: int | None = None) -> Any:
        """Begin an episode. Return its observation and infos."""
        game = self.game
        alone = len(game.human_players) == 1
        for key in game.human_players:  # with several participants, the researcher's code gets no participant's id
            game.human_players[key] = os.environ.get(variables.USER_ID, "") if alone else str(key)
        result = self._raw.reset(seed=seed)
        observation, infos = map(self._own, result if isinstance(result, tuple) and len(result) == 2 else (result, {}))
        game.began(observation)
        self._first_picture = True
        return observation, infos

    def step(self, action: Any) -> Any:
        """Take one step with an action, or with a map of the players' actions. Return the environment's five values."""
        actions = action if isinstance(action, Mapping) else dict.fromkeys(self._players, action)
        result = tuple(map(self._own, self._step(actions)))
        self.game.stepped(actions, result)
        return result

    def render(self) -> Any:
        """Return the present picture: objects with the HUD's text, or pixels."""
        config = self._config
        hud = "" if config.hud_text_fn is None else str(config.hud_text_fn(self.game))
        if config.env_to_state_fn is None:
            drawn = self._raw.render()
            if not isinstance(drawn, list):
                return drawn
        else:
            drawn = config.env_to_state_fn(self._raw, config)
        objects = [fields_of(thing) for thing in drawn]
        if self._first_picture:
            self._first_picture = False
            objects = [*({**fields_of(thing), "permanent": True} for thing in config.state_init), *objects]
        return {"objects": objects, "hud": hud}

    def close(self) -> None:
        """Close the environment, if it has a method `close`."""
        close = getattr(self._raw, "close", None)
        if callable(close):
            close()

    def _step(self, actions: Mapping[Any, Any]) -> Any:
        """Take one step. As in Interactive Gym, an environment that refuses a map of one player gets the action."""
        first, self._first_step = self._first_step, False
        if self._takes_map:
            try:
                return self._raw.step(actions)
            except (AssertionError, TypeError, KeyError, IndexError, ValueError):
                if self.several or not first:
                    raise
                self._takes_map = False
        return self._raw.step(next(iter(actions.values())))

    def _own(self, value: Any) -> Any:
        """Return the value of the only player, if the environment returned a map by player for a single one."""
        if self.several or not isinstance(value, Mapping) or value.keys() != self._players.keys():
            return value
        return value[next(iter(self._players))]


class ListeningAgent(ExperimentAgent):
    """The agent of an experiment with a callback, which it calls as Interactive Gym does.

    `on_game_tick_start` gets the state before a step. Nothing changes between two steps, so it is called after the
    previous step, or after the reset.
    """

    def on_episode_start(self, session: Any) -> Any:
        """Call the experiment's `on_episode_start`, and `on_game_tick_start` for the first step."""
        self._call(session, "on_episode_start", "on_game_tick_start")

    def on_tick(self, session: Any) -> Any:
        """Call the experiment's callbacks of a step, and `on_game_tick_start` for the next step."""
        next_step = () if self.game.over else ("on_game_tick_start",)
        self._call(session, "on_game_tick_end", "on_graphics_start", "on_graphics_end", *next_step)

    def on_episode_end(self, session: Any) -> Any:
        """Call the experiment's `on_episode_end`."""
        self._call(session, "on_episode_end")

    def on_session_end(self, session: Any) -> Any:
        """Call the experiment's `on_game_end` if the game ends in the middle of an episode, as Interactive Gym does."""
        if not self.game.over:
            self._call(session, "on_game_end")

    def _call(self, session: Any, *events: str) -> None:
        """Call these methods of the callback, and record what each returns."""
        self.game.record = session.record
        for event in events:
            method = getattr(self._config.callback, event, None)
            value = method(self.game) if callable(method) else None
            if value is not None:
                session.record(event, value)


def functions_of(config: RemoteConfig, plays: Any) -> tuple[Any, Any]:
    """Return the functions that load and ask a policy. For an ONNX file without functions they are `inference.py`'s."""
    if isinstance(plays, str) and plays.endswith(".onnx") and config.policy_inference_fn is None:
        return inference.load_onnx_policy_fn, inference.onnx_model_inference_fn
    return config.load_policy_fn, config.policy_inference_fn


class Experiment:
    """The experiment of a project, for its agent.py."""

    def __init__(self, agent_file: str, script_path: str, arguments: Sequence[str]) -> None:
        """Run the experiment's script, a copy in the folder of agent.py. Raises Unplayable, and what it raises."""
        self._folder = Path(agent_file).resolve().parent
        self._config, _ = script.load(script_path, arguments, self._folder)

    def agent(self) -> type:
        """Make the class `Agent` for agent.py."""
        config = self._config
        base = ExperimentAgent if config.callback is None else ListeningAgent

        class Agent(base):  # type: ignore[misc, valid-type]
            """The experiment's agent."""

            def __init__(self) -> None:
                super().__init__(config)

        return Agent

    def policy(self, player: Any) -> type:
        """Make a class for agent.py that plays this player by the experiment's functions."""
        plays = self._config.policy_mapping[player]
        load, choose = functions_of(self._config, plays)
        if isinstance(plays, str) and (self._folder / plays).is_file():
            plays = str(self._folder / plays)

        class Policy:
            """A policy of the experiment."""

            def __init__(self) -> None:
                self._policy = plays if load is None else load(plays)

            def act(self, observation: Any, _info: Any) -> int:
                """Choose an action by the experiment's function."""
                return int(choose(observation, self._policy))

        return Policy
