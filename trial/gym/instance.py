"""One environment of a connection, or a vector of them, behind one set of calls. What it raises becomes a GymError."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from trial.gym import overrides
from trial.gym.errors import EnvironmentFailed, GymError, WrongAction, WrongParameters, of
from trial.gym.recordings import ConnectionRecorder, Recorded

CUT_OFF = "TimeLimit.truncated"
"""The key of an info by which gym's TimeLimit says that its limit ended the episode."""

MODES = {mode.value: mode for mode in AutoresetMode}


class InstanceStep(NamedTuple):
    """The results of one step."""

    observation: Any
    reward: Any
    terminated: Any
    truncated: Any
    info: Any


def guarded(call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Call the researcher's code. Raises GymError for whatever it raises, SystemExit included."""
    try:
        return call(*arguments, **named)
    except GymError:
        raise
    except BaseException as error:
        raise EnvironmentFailed(f"The environment raised {of(error)}") from error


class Instance:
    """An environment, or a vector of them.

    `mode`: how `step_many` goes on after the end of an episode (Gymnasium's `AutoresetMode`).
    """

    num_envs = 0
    """How many environments a vector has; 0 for a single one."""

    def __init__(self, env: Any, seed: int | None, mode: AutoresetMode = AutoresetMode.NEXT_STEP) -> None:
        self.env = env
        self.mode = mode
        self.seed = seed
        self._ended = False  # the last step of `step_many` ended an episode
        self._process = overrides.replaced("process_step")
        self._reset_takes_seed = _reset_takes_seed(env)
        if seed is not None:
            guarded(self._seed, seed)

    @property
    def processes(self) -> bool:
        """Whether a program's own `process_step` changes its steps."""
        return self._process is not None

    @property
    def first(self) -> Any:
        """The environment, or the first one of a vector."""
        return self.env

    @property
    def size(self) -> int:
        """How many environments it counts for."""
        return self.num_envs or 1

    @property
    def single_observation_space(self) -> Any:
        """The observation space of one environment."""
        return self.env.observation_space

    @property
    def single_action_space(self) -> Any:
        """The action space of one environment."""
        return self.env.action_space

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        """The first observation and its info; the seed given to `make` is for the first reset, if that has none."""
        first, self.seed = self.seed, None
        seed = first if seed is None else seed
        self._ended = False
        return guarded(self._reset, seed, options)  # type: ignore[no-any-return]

    def step(self, action: Any) -> InstanceStep:
        """One step. Raises WrongAction, as Gymie does whatever the environment raises."""
        try:
            found = self.env.step(action)
            return InstanceStep(*_five(found))
        except GymError:
            raise
        except BaseException as error:
            raise WrongAction(action, of(error)) from error

    def processed(self, step: InstanceStep) -> InstanceStep:
        """The step after the program's own `process_step`, if it has one."""
        if self._process is None:
            return step
        observation, reward, terminated, truncated, info = step
        done = terminated or truncated
        info = as_dict(info)
        if truncated:
            info = {**info, CUT_OFF: not terminated}
        answered = guarded(self._process, (observation, reward, done, info))
        try:
            observation, reward, changed, info = answered
        except (TypeError, ValueError):
            raise EnvironmentFailed("process_step must return observation, reward, done and info.") from None
        if bool(changed) != bool(done):
            terminated, truncated = changed, False
        return InstanceStep(observation, reward, terminated, truncated, info)

    def steps(self, actions: Sequence[Any]) -> Iterator[Any]:
        """Take a step for each action: their results. Raises GymError.

        After an episode, the next one begins as `mode` says: with `NextStep` the step after its end resets, and its
        action is not used; with `SameStep` the last step answers the first observation of the next episode, and its
        info holds `final_obs` and `final_info`; with `Disabled` no step is taken after the end.
        """
        mode, step = self.mode, self.env.step
        at, action = 0, None
        try:
            for at, action in enumerate(actions):  # noqa: B007 - the except clause names it
                if not self._ended:
                    found = step(action)
                    if type(found) is not tuple or len(found) != 5:
                        found = _five(found)
                    if found[2] or found[3]:
                        found = self._end(found)
                elif mode is AutoresetMode.DISABLED:
                    return
                else:
                    observation, info = self.reset()
                    found = (observation, 0.0, False, False, info)
                yield found
        except (GymError, GeneratorExit):
            raise
        except BaseException as error:
            where = f" (step {at} of this request)" if len(actions) > 1 else ""
            raise WrongAction(action, of(error) + where) from error

    def _end(self, found: Any) -> Any:
        """What the last step of an episode answers."""
        observation, reward, terminated, truncated, last = found
        if self.mode is not AutoresetMode.SAME_STEP:
            self._ended = True
            return found
        first, info = self.reset()
        return first, reward, terminated, truncated, {**info, "final_obs": observation, "final_info": last}

    def render(self) -> Any:
        """What the environment's `render` returns."""
        if getattr(self.env, "render_mode", None) is None and hasattr(self.env, "spec"):
            raise WrongParameters('It cannot be rendered; make it with "render_mode": "rgb_array".')
        return guarded(self.env.render)

    def close(self) -> None:
        """Close the environment. Raises EnvironmentFailed."""
        guarded(self.env.close)

    def _seed(self, seed: int) -> None:
        self.env.action_space.seed(seed)

    def _reset(self, seed: int | None, options: Any) -> tuple[Any, Any]:
        if seed is not None and not self._reset_takes_seed:
            self.env.seed(seed)
            seed = None
        named = {name: value for name, value in (("seed", seed), ("options", options)) if value is not None}
        found = self.env.reset(**named)
        if isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], dict):
            return found
        return found, {}  # of gym's old kind


class VectorInstance(Instance):
    """Several environments of a kind that take their steps together (Gymnasium's `SyncVectorEnv`)."""

    def __init__(self, make: Callable[[], Any], count: int, seed: int | None, mode: AutoresetMode) -> None:
        super().__init__(guarded(SyncVectorEnv, [make] * count, autoreset_mode=mode), seed, mode)
        self.num_envs = count

    @property
    def first(self) -> Any:
        return self.env.envs[0]

    @property
    def single_observation_space(self) -> Any:
        return self.env.single_observation_space

    @property
    def single_action_space(self) -> Any:
        return self.env.single_action_space

    def processed(self, step: InstanceStep) -> InstanceStep:
        return step

    def steps(self, actions: Sequence[Any]) -> Iterator[Any]:
        return map(self.step, actions)


def make(
    env_id: str,
    seed: int | None,
    num_envs: int,
    mode: AutoresetMode,
    options: dict[str, Any],
    *,
    recorder: ConnectionRecorder | None = None,
) -> Instance:
    """Make an environment, or with `num_envs` a vector of that many, all recorded by `recorder`. Raises GymError."""
    own = overrides.replaced("get_env")
    getter = overrides.get_env if own is None else own

    def single() -> Any:
        given = {"seed": seed, **options} if own is not None and seed is not None else options
        env = guarded(getter, env_id, **given)
        if env is None:
            raise EnvironmentFailed("get_env returned no environment.")
        return env if recorder is None else recorder.record(env, env_id, seed)

    if num_envs:
        return VectorInstance(single, num_envs, seed, mode)
    return Instance(single(), seed, mode)


def _reset_takes_seed(env: Any) -> bool:
    """False for an environment of gym's old kind, which has a method `seed` for that."""
    env = env.env if isinstance(env, Recorded) else env
    if not callable(getattr(env, "seed", None)):
        return True
    try:
        parameters = inspect.signature(env.reset).parameters.values()
    except (TypeError, ValueError):
        return True
    if any(parameter.name == "seed" for parameter in parameters):
        return True
    # gym's old wrappers hand on whatever they are given, to a reset that takes nothing.
    return isinstance(env, gymnasium.Env) and any(one.kind is one.VAR_KEYWORD for one in parameters)


def _five(found: Any) -> Any:
    """What `step` returned, of gym's old kind too. Raises EnvironmentFailed for what is neither."""
    if isinstance(found, tuple | list) and len(found) in (4, 5):
        return found if len(found) == 5 else _old(found)
    raise EnvironmentFailed("step() must return five values: observation, reward, terminated, truncated and info.")


def _old(found: Any) -> InstanceStep:
    observation, reward, done, info = found
    cut = bool(info.get(CUT_OFF)) if isinstance(info, dict) else False
    return InstanceStep(observation, reward, bool(done) and not cut, bool(done) and cut, info)


def number(reward: Any) -> float:
    """The reward of one environment as a number of Python's. Raises EnvironmentFailed."""
    if type(reward) is float:
        return reward
    try:
        return float(reward.item() if isinstance(reward, np.ndarray) else reward)
    except (TypeError, ValueError):
        words = f"step() returned a reward that is no number: {type(reward).__name__}."
        raise EnvironmentFailed(words) from None


def as_dict(info: Any) -> Any:
    """An info as Gymnasium has it: what is none is the value of `info` in one."""
    return info if isinstance(info, Mapping) else {} if info is None else {"info": info}
