"""The researcher's `Agent`: finding it, calling it, and the one used when a project brings none."""

from __future__ import annotations

import difflib
import importlib.util
import math
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from protocol.similar import nearest
from trial.agent import callbacks, environments, signatures
from trial.agent.hippo_config import hippo_config
from trial.agent.signatures import Signature, UnfitSignature
from trial.core.players import PLAYER
from trial.pictures.picture import Picture
from trial.pictures.reader import PictureReader

_METHODS = ("start", "step", "render", "reset", "close")
_USUAL = frozenset({"observation", "reward", "done", "info"})  # the dict of HIPPO's sample agent
_KNOWN = _USUAL | {"terminated", "truncated", "action"}
_OLD_GYM = Path(__file__).with_name("old_gym")
_OLD_ATARI = re.compile(r"[A-Z]\w*-v[04]")
_OF_ENV = ("step", "render", "reset", "close")
"""What the environment does itself if a class Agent has no such method."""


class AgentError(Exception):
    """The researcher's code breaks its contract. The message is for the researcher."""


@dataclass(frozen=True, slots=True)
class StepResult:
    """The results of one step of the environment. `action` is the index that the agent reports, if any."""

    observation: Any
    reward: float
    terminated: bool
    truncated: bool
    info: Mapping[str, Any] = field(default_factory=dict)
    action: int | None = None
    extra: Mapping[str, Any] | None = None
    """What else is in the dict that an agent of HIPPO's kind returns."""


class Agent:
    """The agent used when there is no agent.py: the environment alone, moved by the human's actions."""

    def __init__(self) -> None:
        self.env: Any = None

    def start(self, game: str) -> Any:
        """Make the environment named `game`.

        That is any Gymnasium id (Atari names, old ones too, load ale_py), or a module such as
        `pettingzoo.butterfly.cooperative_pong_v6`, which has `parallel_env` or `env`.
        """
        import gymnasium  # noqa: PLC0415 - an agent of the researcher's may do without

        if environments.is_module(game) and game not in gymnasium.registry:
            try:
                self.env = environments.made_by_module(game)
            except environments.PlayersUnknown as error:
                raise AgentError(str(error)) from None
            return self.env
        if game.startswith("ALE/") or (game not in gymnasium.registry and _OLD_ATARI.match(game)):
            import ale_py  # noqa: PLC0415

            gymnasium.register_envs(ale_py)
        self.env = gymnasium.make(game, render_mode="rgb_array")
        return self.env

    def step(self, action: int) -> Any:
        """Take the human's action. Returns observation, reward, terminated, truncated, info."""
        return self.env.step(action)

    def render(self) -> Any:
        """The present picture: height x width x 3 bytes."""
        return self.env.render()

    def reset(self, seed: int | None = None) -> Any:
        """Begin an episode."""
        return self.env.reset(seed=seed)

    def close(self) -> None:
        self.env.close()


def load(folder: Path) -> Any:
    """A new `Agent` of the folder's agent.py, or the default one if there is no such file.

    Raises AgentError if the file has no fit class, and whatever the file itself raises.
    """
    path = folder / "agent.py"
    if not path.is_file():
        return Agent()
    # agent.py can import the files beside it, and `gym`; neither hides the modules of installed packages.
    sys.path.extend(str(place) for place in (folder, _OLD_GYM) if str(place) not in sys.path)
    spec = importlib.util.spec_from_file_location("agent", path)
    if spec is None or spec.loader is None:
        raise AgentError(f"{path.name} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules["agent"] = module
    spec.loader.exec_module(module)
    made = getattr(module, "Agent", None)
    if isinstance(made, type):
        missing = _missing(made)
        misspelt = {name: near for name in missing for near in _nearly(name, made)}
        if misspelt or "start" in missing:
            hint = "".join(f"; is {near} meant to be {name}?" for name, near in misspelt.items())
            raise AgentError(f"Agent in {path.name} has no {', '.join(misspelt or missing)}{hint}")
        return made()
    missing = _missing(module)
    if len(missing) == len(_METHODS):
        raise AgentError(f"{path.name} has no class Agent{_meant(module)}")
    if missing:
        raise AgentError(f"{path.name} has no class Agent, and of its functions no {', '.join(missing)}")
    return module


def _missing(methods: Any) -> list[str]:
    return [name for name in _METHODS if not callable(getattr(methods, name, None))]


def _meant(module: Any) -> str:
    """A question about the class of the file whose name is nearly `Agent`; empty if there is none."""
    near = nearest("Agent", (name for name, found in vars(module).items() if isinstance(found, type)))
    return f"; is {near} meant to be Agent?" if near else ""


def _nearly(name: str, made: type) -> list[str]:
    """A method of the class whose name differs in a letter."""
    # The agent is refused for it, so it must be more alike than what a message asks about (`protocol/similar.py`).
    others = [other for other in dir(made) if not other.startswith("_") and callable(getattr(made, other, None))]
    return difflib.get_close_matches(name, set(others) - set(_METHODS), n=1, cutoff=0.88)


class AgentAdapter:
    """Calls an agent and checks what it returns. All methods run on the agent's thread (`trial/agent/worker.py`).

    An agent is an object, or a module with functions of the same names.
    """

    def __init__(
        self,
        folder: Path,
        game: str | None,
        action_space: tuple[str, ...] | None,
        reader: PictureReader | None = None,
    ) -> None:
        """`reader` reads what `render` returns; by default pixels alone."""
        self._folder = folder
        self._game = game
        self._configured = action_space
        self.reader = reader or PictureReader()
        self._agent: Any = None
        self._returned: Any = None  # by start()
        self._signatures: dict[str, Signature] = {name: signatures.usual(name) for name in _METHODS}
        self._unusual_step: Callable[[Any], Any] | None = None
        self._unusual_render = False  # `render` takes something, or is the environment's
        self._of_env: dict[str, Callable[..., Any]] = {}  # methods that the agent leaves to the environment
        self._feedback: tuple[Callable[..., Any], bool] | None = None
        self._word = signatures.NO_WORD  # the newest since the last step
        self._env_says_action = False
        self.action_space: tuple[str, ...] = action_space or ()

    @property
    def callbacks(self) -> Mapping[str, Callable[..., Any]]:
        """The callbacks that the agent has, once it has started."""
        return callbacks.listening(self._agent)

    @property
    def env(self) -> Any:
        """The environment, as far as it is known: what `start` returned, or the agent's attribute `env`."""
        return self._returned if self._returned is not None else getattr(self._agent, "env", None)

    @property
    def agent(self) -> Any:
        """The researcher's agent, once it has started."""
        return self._agent

    @property
    def agent_module(self) -> Any:
        """The module that agent.py has become; None without one."""
        return sys.modules.get("agent") if (self._folder / "agent.py").is_file() else None

    @property
    def configured(self) -> tuple[str, ...]:
        """The names of the actions in config.yml."""
        return self._configured or ()

    def start(self) -> None:
        """Load the agent and start its game; `action_space` is known afterwards."""
        self.begin()
        self.name_actions()

    def begin(self) -> None:
        """Load the agent and start its game. Who plays it, and with which actions, is seen afterwards."""
        agent = load(self._folder)
        self._signatures |= _signatures(agent, ("start",))
        config = hippo_config(os.environ)
        returned = self._signatures["start"].call(agent.start, {signatures.GAME: self._game, signatures.CONFIG: config})
        missing = _missing(agent)
        if missing:
            returned = environments.playable(returned)
        self._of_env = _forwarded(missing, returned)
        self._returned, self._agent = returned, agent
        self._signatures |= _signatures(agent, _OF_ENV, self._of_env)
        if self._signatures["step"] != signatures.usual("step"):
            self._unusual_step = lambda action: self._call("step", action=action)
        elif "step" in self._of_env:
            self._unusual_step = self._of_env["step"]
        if self._signatures["render"] != signatures.usual("render") or "render" in self._of_env:
            self._unusual_render = True

    def name_actions(self) -> None:
        """Find out what the actions of the environment's one player are called. Raises AgentError if that fails."""
        self.action_space = self._configured or _action_names(self.env)

    @property
    def steps_itself(self) -> bool:
        """Whether the researcher's code takes the actions, and not the environment."""
        return not isinstance(self._agent, Agent) and "step" not in self._of_env

    @property
    def renders_by_player(self) -> bool:
        """Whether `render` takes a player and draws the view of that one."""
        return signatures.PLAYER in self._signatures["render"].order

    def _call(self, method: str, *, action: Any = None, seed: int | None = None, player: Any = PLAYER) -> Any:
        """Call a method with what it takes. Raises AgentError if it takes the environment, and that is not known."""
        env = self.env
        if env is None and self._signatures[method].needs_env:
            raise AgentError(f"{method}() takes the environment; return it from start(game), or keep it in self.env")
        given = {
            signatures.ENV: env,
            signatures.ACTION: action,
            signatures.WORD: self._word,
            signatures.SEED: seed,
            signatures.OPTIONS: None,
            signatures.MODE: "rgb_array",
            signatures.PLAYER: player,
        }
        if method == "step":
            self._word = signatures.NO_WORD
        function = self._of_env.get(method) or getattr(self._agent, method)
        return self._signatures[method].call(function, given)

    def reset(self, seed: int) -> tuple[Any, Mapping[str, Any], bool]:
        """Begin an episode: its first observation and info, if the agent returns them, and whether it took the seed."""
        seeded = signatures.SEED in self._signatures["reset"].named
        self.reader.begin_episode()
        result = self._call("reset", seed=seed)
        if isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], Mapping):
            # No action was chosen yet, so this is an environment that reports actions of its own.
            self._env_says_action = "action" in result[1]
            return result[0], result[1], seeded
        return result, {}, seeded

    def step(self, action: int) -> StepResult:
        """Take the human's action, or what the agent makes of it.

        An `action` in the info means that the agent chose it, even if it is the human's. Without an agent.py, and if
        the environment has an `action` in the info of `reset` too, it counts only if it differs from the human's. An
        `action` beside the info, in a dict, always counts.
        """
        if self.reader.due:  # steps of an earlier server are taken again without pictures
            self.render()
        result = self._agent.step(action) if self._unusual_step is None else self._unusual_step(action)
        outcome = read_step_result(result)
        if outcome.action is None or (isinstance(result, Mapping) and result.get("action") is not None):
            return outcome
        if isinstance(self._agent, Agent) or (self._env_says_action and outcome.action == action):
            return replace(outcome, action=None)
        return outcome

    def step_with(self, actions: Mapping[Any, Any]) -> Any:
        """What `step` returns for the actions of several players, which are given as they are."""
        return self._agent.step(actions) if self._unusual_step is None else self._unusual_step(actions)

    def draw(self, player: Any = PLAYER) -> Any:
        """What `render` returns, for this player if it takes one."""
        return self._call("render", player=player) if self._unusual_render else self._agent.render()

    def render(self) -> Picture:
        """The present picture. Raises FrameError or SceneError if it is none."""
        return self.reader.read(self.draw())

    def feedback(self, word: str, player: Any = PLAYER) -> None:
        """Hand good, bad, trainOnline, trainOffline or a word of the project's own to an agent that listens.

        A method `feedback(word, player)` hears whose participant said it too.
        """
        self._word = word
        listen = getattr(self._agent, "feedback", None)
        if callable(listen):
            if self._feedback is None or self._feedback[0] != listen:
                self._feedback = listen, signatures.names(listen, "player")
            listen(word, player=player) if self._feedback[1] else listen(word)

    def close(self) -> None:
        if self._agent is not None:
            self._call("close")


def _signatures(
    agent: Any, methods: Sequence[str], of_env: Mapping[str, Callable[..., Any]] | None = None
) -> dict[str, Signature]:
    """How these methods are called. Raises AgentError if one cannot be."""
    others = of_env or {}
    try:
        return {name: signatures.read(name, others.get(name) or getattr(agent, name)) for name in methods}
    except UnfitSignature as error:
        raise AgentError(str(error)) from None


def _forwarded(missing: Sequence[str], returned: Any) -> dict[str, Callable[..., Any]]:
    """The methods of what `start` returned that stand for those that the class lacks. Raises AgentError."""
    lacking = [name for name in missing if not callable(getattr(returned, name, None))]
    if lacking:
        why = "" if returned is None else f", and neither has what start() returned ({type(returned).__name__})"
        raise AgentError(f"Agent in agent.py has no {', '.join(lacking)}{why}")
    return {name: getattr(returned, name) for name in missing}


def read_step_result(result: Any) -> StepResult:
    """Read what `step` returned: a five-tuple, an old four-tuple, HIPPO's dict, or whether the episode is done.

    Raises AgentError for all else.
    """
    if isinstance(result, Mapping):
        return _read_dict(result)
    if isinstance(result, tuple | list) and len(result) == 5:
        observation, reward, terminated, truncated, info = result
        return _outcome(observation, reward, bool(terminated), bool(truncated), info)
    if isinstance(result, tuple | list) and len(result) == 4:
        observation, reward, done, info = result
        return _outcome(observation, reward, *_done(done, info), info)
    if isinstance(result, bool | np.bool_):  # later agents of HIPPO
        return StepResult(None, 0.0, bool(result), False)
    raise AgentError("step() must return (observation, reward, terminated, truncated, info) or a dict of these")


def _read_dict(result: Mapping[str, Any]) -> StepResult:
    info, action = result.get("info"), result.get("action")
    terminated, truncated = _done(result.get("done", False), info)
    if "terminated" in result:
        terminated = bool(result["terminated"])
    if "truncated" in result:
        truncated = bool(result["truncated"])
    outcome = _outcome(result.get("observation"), result.get("reward", 0.0), terminated, truncated, info, action=action)
    if result.keys() <= _USUAL:
        return outcome
    extra = {key: value for key, value in result.items() if key not in _KNOWN}
    if "done" in result and "terminated" in result:
        extra["done"] = result["done"]
    if action is not None and outcome.action is None:  # no index: it is kept as it is
        extra["action"] = action
    return replace(outcome, extra=extra) if extra else outcome


def _done(done: Any, info: Any) -> tuple[bool, bool]:
    """Gym's old `done` as terminated and truncated: Gym's time limit said so in the info."""
    over = bool(done)
    truncated = over and isinstance(info, Mapping) and info.get("TimeLimit.truncated") in (True, np.True_)
    return over and not truncated, truncated


def _outcome(
    observation: Any, reward: Any, terminated: bool, truncated: bool, info: Any, *, action: Any = None
) -> StepResult:
    try:
        if isinstance(reward, np.ndarray):
            reward = reward.item()  # of an array that holds one number
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
    inner = getattr(env, "unwrapped", env)
    for candidate in (env, inner):
        meanings = getattr(candidate, "get_action_meanings", None)
        if callable(meanings):
            return tuple(str(name).strip().lower() for name in meanings())
    count = getattr(getattr(env, "action_space", None), "n", None)
    if count is None:
        raise AgentError(
            "list the game's actions as trial.actionSpace in config.yml; the environment does not name them"
        )
    return tuple(str(index) for index in range(int(count)))
