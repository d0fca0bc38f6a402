"""Calls the methods of the researcher's agent, which has one player, and reads what they return."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hippodrome.protocol.trial import TALK
from hippodrome.trial.agent import callbacks, environments, signatures
from hippodrome.trial.agent.loading import METHODS, Agent, AgentError, TalkGame, hippo_config, load, missing_methods
from hippodrome.trial.agent.signatures import FEEDBACK, TALK_METHODS, Signature, UnfitSignature
from hippodrome.trial.core.players import PLAYER
from hippodrome.trial.pictures.reader import Picture, PictureReader

_HIPPO_KEYS = frozenset({"observation", "reward", "done", "info"})  # what step() of HIPPO's sample agent returns
_KNOWN_KEYS = _HIPPO_KEYS | {"terminated", "truncated", "action"}
_ENV_METHODS = ("step", "render", "reset", "close")
"""The methods that a class Agent may lack: the environment's own method is called then."""


@dataclass(frozen=True, slots=True)
class StepResult:
    """The results of one step. `action` is the number of the action that the agent reports; None if it reports none."""

    observation: Any
    reward: float
    terminated: bool
    truncated: bool
    info: Mapping[str, Any] = field(default_factory=dict)
    action: int | None = None
    extra: Mapping[str, Any] | None = None
    """Further entries of the dict that `step` returned; None if there are none."""


class AgentAdapter:
    """Calls an agent (see `load`) and checks what it returns.

    All methods run on the agent's thread (`hippodrome/trial/agent/worker.py`).
    """

    def __init__(
        self,
        folder: Path,
        game: str | None,
        action_space: tuple[str, ...] | None,
        reader: PictureReader | None = None,
    ) -> None:
        """`action_space` has the actions' names from config.yml; None or empty if config.yml has none.

        `reader` reads what `render` returns; the default reader takes pixels alone.
        """
        self._folder = folder
        self._game = game
        self.configured_actions: tuple[str, ...] = action_space or ()
        """The names of the actions in config.yml; empty if it has none."""
        self.reader = reader or PictureReader()
        self._agent: Any = None
        self._returned: Any = None  # the result of start()
        self._signatures: dict[str, Signature] = {name: signatures.usual(name) for name in METHODS}
        self._unusual_step: Callable[[Any], Any] | None = None
        self._unusual_render = False  # `render` has parameters, or it is the environment's method
        self._env_methods: dict[str, Callable[..., Any]] = {}  # methods of the environment that the agent lacks
        self._feedback: tuple[Callable[..., Any], bool] | None = None  # the agent's method; whether it takes the player
        self._word = signatures.NO_WORD  # the newest word of feedback since the last step
        self._options: dict[str, Any] | None = None
        self._answers: dict[str, Any] | None = None
        self._env_reports_action = False
        self.action_space: tuple[str, ...] = self.configured_actions
        """The names of the actions, by their numbers; without names in config.yml, empty until `name_actions`."""
        self._first_number = 0  # the environment's number of action 0, if its own `step` gets the actions

    @property
    def callbacks(self) -> Mapping[str, Callable[..., Any]]:
        """The callbacks that the agent has, once it has started."""
        return callbacks.listening(self._agent)

    @property
    def talk(self) -> Mapping[str, Callable[..., Any]]:
        """The methods `reply` and `moderate` that the agent has, once it has started."""
        return callbacks.listening(self._agent, TALK_METHODS)

    @property
    def env(self) -> Any:
        """The object that `start` returned, or the agent's attribute `env`; None if there is neither."""
        return self._returned if self._returned is not None else getattr(self._agent, "env", None)

    @property
    def agent(self) -> Any:
        """The researcher's agent, once it has started."""
        return self._agent

    @property
    def agent_module(self) -> Any:
        """The imported agent.py; None if the project has none, or before it is imported."""
        return sys.modules.get("agent") if (self._folder / "agent.py").is_file() else None

    def start(self, players: Sequence[str] = ()) -> None:
        """Load the agent and call its `start`. In the game `talk` an agent without `start` gets the built-in game.

        `players` are the names in `trial.players`. Raises AgentError if the agent lacks a method or a method cannot be
        called, and whatever its own code raises.
        """
        agent = load(self._folder, talks=self._game == TALK)
        missing = missing_methods(agent)
        if isinstance(agent, Agent) and self._game == TALK:
            returned = agent.env = TalkGame(players)
        elif "start" in missing:
            returned = TalkGame(players)
            missing.remove("start")
        else:
            self._signatures |= _signatures(agent, ("start",), {})
            given = {signatures.GAME: self._game, signatures.CONFIG: hippo_config(os.environ)}
            returned = self._signatures["start"].call(agent.start, given)
        if missing:
            returned = environments.playable(returned)
        self._env_methods = _env_methods(missing, returned)
        self._returned, self._agent = returned, agent
        self._signatures |= _signatures(agent, _ENV_METHODS, self._env_methods)
        if self._signatures["step"] != signatures.usual("step"):
            self._unusual_step = lambda action: self._call("step", action=action)
        elif "step" in self._env_methods:
            self._unusual_step = self._env_methods["step"]
        usual_render = self._signatures["render"] == signatures.usual("render")
        self._unusual_render = not usual_render or "render" in self._env_methods

    def name_actions(self) -> None:
        """Set `action_space` for an environment with one player: the names in config.yml, or the environment's.

        Raises AgentError if there are none in config.yml, and the environment does not say how many actions it has; or
        if the environment's own `step` gets the actions, and they are not numbers.
        """
        space = getattr(self.env, "action_space", None)
        try:
            environments.check_numbered(space, not self.steps_itself)
        except environments.PlayersUnknown as error:
            raise AgentError(str(error)) from None
        self._first_number = 0 if self.steps_itself else environments.first_number(space)
        self.action_space = self.configured_actions or _action_names(self.env)

    @property
    def action_starts(self) -> Mapping[str, int]:
        """The environment's number of action 0, by player, where it is not 0."""
        return {PLAYER: self._first_number} if self._first_number else {}

    @property
    def steps_itself(self) -> bool:
        """Whether the researcher's agent has a method `step`. Otherwise the environment's `step` gets the actions."""
        return not isinstance(self._agent, Agent) and "step" not in self._env_methods

    @property
    def renders_by_player(self) -> bool:
        """Whether `render` takes a player, and draws that player's view."""
        return signatures.PLAYER in self._signatures["render"].order

    @property
    def hears(self) -> bool:
        """Whether a word of feedback reaches the agent: by `feedback`, `on_feedback`, or an argument of `step`."""
        method = getattr(self._agent, "feedback", None)
        return callable(method) or FEEDBACK in self.callbacks or signatures.WORD in self._signatures["step"].order

    def _call(self, method: str, *, action: Any = None, seed: int | None = None, player: Any = PLAYER) -> Any:
        """Call a method of the agent with the arguments that its signature names.

        Raises AgentError if the method takes the environment, and `env` is None.
        """
        env = self.env
        if env is None and signatures.ENV in self._signatures[method].order:
            raise AgentError(f"{method}() takes the environment; return it from start(game), or keep it in self.env")
        given = {
            signatures.ENV: env,
            signatures.ACTION: action,
            signatures.WORD: self._word,
            signatures.SEED: seed,
            signatures.OPTIONS: self._options,
            signatures.ANSWERS: self._answers,
            signatures.MODE: "rgb_array",
            signatures.PLAYER: player,
        }
        if method == "step":
            self._word = signatures.NO_WORD
        function = self._env_methods.get(method) or getattr(self._agent, method)
        return self._signatures[method].call(function, given)

    def set_game(self, options: Mapping[str, Any], answers: Mapping[str, Any] | None = None) -> None:
        """Give `reset` these options and answers from now on, if it takes them: those of the game that is played.

        `answers` are the participant's answers to earlier steps; None if the game names none.
        """
        self._options = dict(options) or None
        self._answers = None if answers is None else dict(answers)

    def reset(self, seed: int) -> tuple[Any, Mapping[str, Any], bool]:
        """Begin an episode. Return its first observation, its info, and whether `reset` took the seed.

        The info is empty if `reset` returns an observation alone.
        """
        seeded = signatures.SEED in self._signatures["reset"].named
        self.reader.begin_episode()
        result = self._call("reset", seed=seed)
        if isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], Mapping):
            # No action was chosen yet, so it is the environment that reports an action, and not the agent.
            self._env_reports_action = "action" in result[1]
            return result[0], result[1], seeded
        return result, {}, seeded

    def step(self, action: int) -> StepResult:
        """Call `step` with the human's action, and read the result. Raises AgentError if it cannot be read.

        `action` of the result is set if the agent chose the action. The agent says so by an `action` in the dict that
        `step` returns, or in the info, even if it is the human's action. If the info of `reset` has an `action` too,
        the environment reports it: then the `action` in the info counts only if it differs from the human's. Without
        an agent.py it never counts.
        """
        if self.reader.first_due:  # no picture yet: an earlier server's steps are repeated without them
            self.render()
        number = self._first_number + action
        result = self._agent.step(number) if self._unusual_step is None else self._unusual_step(number)
        outcome = read_step_result(result)
        if outcome.action is not None and self._first_number:
            outcome = replace(outcome, action=outcome.action - self._first_number)
        if outcome.action is None or (isinstance(result, Mapping) and result.get("action") is not None):
            return outcome
        if isinstance(self._agent, Agent) or (self._env_reports_action and outcome.action == action):
            return replace(outcome, action=None)
        return outcome

    def step_with(self, actions: Mapping[Any, Any]) -> Any:
        """Call `step` with the actions of several players, by the environment's keys. Return its result as it is."""
        return self._agent.step(actions) if self._unusual_step is None else self._unusual_step(actions)

    def draw(self, player: Any = PLAYER) -> Any:
        """Call `render`, for this player if it takes one. Return its result as it is."""
        return self._call("render", player=player) if self._unusual_render else self._agent.render()

    def render(self) -> Picture:
        """Call `render` and read the picture. Raises FrameError or SceneError if `render` returned no picture."""
        return self.reader.read(self.draw())

    def feedback(self, word: str, player: Any = PLAYER) -> None:
        """Call `feedback(word)`, or `feedback(word, player)`, if the agent has this method.

        `word` is good, bad, trainOnline, trainOffline or a control of the project's own; the participant of `player`
        has sent it. `step` gets the newest word too, if it takes one.
        """
        self._word = word
        method = getattr(self._agent, "feedback", None)
        if callable(method):
            if self._feedback is None or self._feedback[0] != method:
                self._feedback = method, signatures.names(method, "player")
            method(word, player=player) if self._feedback[1] else method(word)

    def close(self) -> None:
        """Call `close`, if the agent was loaded."""
        if self._agent is not None:
            self._call("close")


def _signatures(
    agent: Any, methods: Sequence[str], env_methods: Mapping[str, Callable[..., Any]]
) -> dict[str, Signature]:
    """Return the signatures of these methods. Raises AgentError if one of them cannot be called."""
    try:
        return {name: signatures.read(name, env_methods.get(name) or getattr(agent, name)) for name in methods}
    except UnfitSignature as error:
        raise AgentError(str(error)) from None


def _env_methods(missing: Sequence[str], returned: Any) -> dict[str, Callable[..., Any]]:
    """Return the environment's methods of the names in `missing`. Raises AgentError if the environment lacks one."""
    lacking = [name for name in missing if not callable(getattr(returned, name, None))]
    if lacking:
        why = "" if returned is None else f", and neither has what start() returned ({type(returned).__name__})"
        raise AgentError(f"Agent in agent.py has no {', '.join(lacking)}{why}")
    return {name: getattr(returned, name) for name in missing}


def read_step_result(result: Any) -> StepResult:
    """Read what `step` returned.

    That is Gymnasium's five values, Gym's old four, HIPPO's dict, or only whether the episode is done, as a bool.
    Raises AgentError for anything else.
    """
    if isinstance(result, Mapping):
        return _read_dict(result)
    if isinstance(result, tuple | list) and len(result) == 5:
        observation, reward, terminated, truncated, info = result
        return _outcome(observation, reward, bool(terminated), bool(truncated), info)
    if isinstance(result, tuple | list) and len(result) == 4:
        observation, reward, done, info = result
        return _outcome(observation, reward, *_done(done, info), info)
    if isinstance(result, bool | np.bool_):  # later agents of HIPPO return `done` alone
        return StepResult(None, 0.0, bool(result), False)
    wanted = "step() must return (observation, reward, terminated, truncated, info) or a dict of these"
    raise AgentError(f"{wanted}; it returned nothing" if result is None else wanted)


def _read_dict(result: Mapping[str, Any]) -> StepResult:
    info, action = result.get("info"), result.get("action")
    terminated, truncated = _done(result.get("done", False), info)
    if "terminated" in result:
        terminated = bool(result["terminated"])
    if "truncated" in result:
        truncated = bool(result["truncated"])
    outcome = _outcome(result.get("observation"), result.get("reward", 0.0), terminated, truncated, info, action=action)
    if result.keys() <= _HIPPO_KEYS:
        return outcome
    extra = {key: value for key, value in result.items() if key not in _KNOWN_KEYS}
    if "done" in result and "terminated" in result:
        extra["done"] = result["done"]
    if action is not None and outcome.action is None:  # it is not the number of an action: record it as it is
        extra["action"] = action
    return replace(outcome, extra=extra) if extra else outcome


def _done(done: Any, info: Any) -> tuple[bool, bool]:
    """Split Gym's old `done` into terminated and truncated. Gym's TimeLimit says in the info if it has truncated."""
    over = bool(done)
    truncated = over and isinstance(info, Mapping) and info.get("TimeLimit.truncated") in (True, np.True_)
    return over and not truncated, truncated


def _outcome(
    observation: Any, reward: Any, terminated: bool, truncated: bool, info: Any, *, action: Any = None
) -> StepResult:
    try:
        if isinstance(reward, np.ndarray):
            reward = reward.item()  # the number in an array that holds one
        number = float(reward if reward is not None else 0.0)
    except (TypeError, ValueError) as error:
        raise AgentError(f"step() returned a reward that is no number: {type(reward).__name__}") from error
    if not math.isfinite(number):
        raise AgentError("step() returned a reward that is not finite")
    details: Mapping[str, Any] = info if isinstance(info, Mapping) else {} if info is None else {"info": info}
    if action is None:
        action = details.get("action")
    try:
        taken = None if action is None or isinstance(action, bool) else int(action)
    except (TypeError, ValueError, OverflowError):
        taken = None
    return StepResult(observation, number, terminated, truncated, details, taken)


def _action_names(env: Any) -> tuple[str, ...]:
    names = environments.action_meanings(env)
    if names:
        return tuple(names)
    count = environments.count_of(getattr(env, "action_space", None))
    if count is None:
        raise AgentError(environments.ACTIONS_UNKNOWN)
    return tuple(str(index) for index in range(count))
