"""Calls one environment of a connection, or a vector of them. Exceptions of the environment become GymErrors."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from trial.gym import overrides
from trial.gym.errors import EnvironmentFailed, GymError, WrongAction, WrongParameters, described
from trial.gym.recordings import ConnectionRecorder, Recorded

CUT_OFF = "TimeLimit.truncated"
"""The key in an info by which gym's TimeLimit says that its limit ended the episode."""

MODES = {mode.value: mode for mode in AutoresetMode}
"""Gymnasium's autoreset modes by their names in requests."""


class InstanceStep(NamedTuple):
    """The results of one step."""

    observation: Any
    reward: Any
    terminated: Any
    truncated: Any
    info: Any


def guarded(call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Call the researcher's code. Raises a GymError for each exception that it raises, also for SystemExit."""
    try:
        return call(*arguments, **named)
    except GymError:
        raise
    except BaseException as error:
        raise EnvironmentFailed(f"The environment raised {described(error)}") from error


class Instance:
    """A single environment. `VectorInstance` is a vector of environments.

    `mode` is Gymnasium's `AutoresetMode`: how `steps` continues after the end of an episode.
    """

    num_envs = 0
    """The number of environments of a vector; 0 for a single environment."""

    def __init__(self, env: Any, seed: int | None, mode: AutoresetMode = AutoresetMode.NEXT_STEP) -> None:
        self.env = env
        self.mode = mode
        self.seed = seed
        self._ended = False  # whether the last step of `step_many` ended an episode
        self._process = overrides.replaced("process_step")
        self._reset_takes_seed = _reset_takes_seed(env)
        if seed is not None:
            guarded(lambda: env.action_space.seed(seed))

    @property
    def processes(self) -> bool:
        """Whether a program's own `process_step` changes this environment's steps."""
        return self._process is not None

    @property
    def first(self) -> Any:
        """The environment itself; of a vector, its first environment."""
        return self.env

    @property
    def size(self) -> int:
        """The number of environments: 1 for a single one."""
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
        """Begin an episode. Return its first observation and info.

        Without `seed`, the first reset uses the seed of `make`. Raises EnvironmentFailed.
        """
        made_with, self.seed = self.seed, None
        seed = made_with if seed is None else seed
        self._ended = False
        return guarded(self._reset, seed, options)  # type: ignore[no-any-return]

    def step(self, action: Any) -> InstanceStep:
        """Take one step. Raises WrongAction if the environment raises an exception, as Gymie does."""
        try:
            return InstanceStep(*_five(self.env.step(action)))
        except GymError:
            raise
        except BaseException as error:
            raise WrongAction(action, described(error)) from error

    def processed(self, step: InstanceStep) -> InstanceStep:
        """Let the program's own `process_step` change the step. Without one, return the step as it is."""
        if self._process is None:
            return step
        observation, reward, terminated, truncated, info = step
        done = terminated or truncated
        info = as_dict(info)
        if truncated:
            info = {**info, CUT_OFF: not terminated}
        processed = guarded(self._process, (observation, reward, done, info))
        try:
            observation, reward, new_done, info = processed
        except (TypeError, ValueError):
            raise EnvironmentFailed("process_step must return observation, reward, done and info.") from None
        if bool(new_done) != bool(done):
            terminated, truncated = new_done, False
        return InstanceStep(observation, reward, terminated, truncated, info)

    def steps(self, actions: Sequence[Any]) -> Iterator[Any]:
        """Take a step for each action, and yield the five results of each. Raises GymError.

        After an episode, the next one begins as `mode` says. With `NextStep` the step after the end resets, and its
        action is not used. With `SameStep` the last step has the first observation of the next episode, and its info
        has `final_obs` and `final_info`. With `Disabled` no step is taken after the end.
        """
        mode, step = self.mode, self.env.step
        at, action = 0, None
        try:
            for at, action in enumerate(actions):  # noqa: B007 - the except clause names it
                if not self._ended:
                    results = step(action)
                    if type(results) is not tuple or len(results) != 5:
                        results = _five(results)
                    if results[2] or results[3]:
                        results = self._end(results)
                elif mode is AutoresetMode.DISABLED:
                    return
                else:
                    observation, info = self.reset()
                    results = (observation, 0.0, False, False, info)
                yield results
        except (GymError, GeneratorExit):
            raise
        except BaseException as error:
            where = f" (step {at} of this request)" if len(actions) > 1 else ""
            raise WrongAction(action, described(error) + where) from error

    def _end(self, results: Any) -> Any:
        """Return the results of an episode's last step, in the form that `mode` requires."""
        observation, reward, terminated, truncated, last_info = results
        if self.mode is not AutoresetMode.SAME_STEP:
            self._ended = True
            return results
        first, info = self.reset()
        return first, reward, terminated, truncated, {**info, "final_obs": observation, "final_info": last_info}

    def render(self) -> Any:
        """Call the environment's `render`. Raises WrongParameters if it was made without a render mode."""
        if getattr(self.env, "render_mode", None) is None and hasattr(self.env, "spec"):
            raise WrongParameters('It cannot be rendered; make it with "render_mode": "rgb_array".')
        return guarded(self.env.render)

    def close(self) -> None:
        """Close the environment. Raises EnvironmentFailed."""
        guarded(self.env.close)

    def _reset(self, seed: int | None, options: Any) -> tuple[Any, Any]:
        if seed is not None and not self._reset_takes_seed:
            self.env.seed(seed)
            seed = None
        named = {name: value for name, value in (("seed", seed), ("options", options)) if value is not None}
        result = self.env.reset(**named)
        if isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict):
            return result
        return result, {}  # an environment of gym's old kind returns the observation alone


class VectorInstance(Instance):
    """A vector of equal environments that take their steps together (Gymnasium's `SyncVectorEnv`)."""

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
    """Make an environment, or a vector if `num_envs` is not 0. `recorder` records each environment. Raises GymError."""
    own = overrides.replaced("get_env")
    get_env = overrides.get_env if own is None else own

    def single() -> Any:
        arguments = {"seed": seed, **options} if own is not None and seed is not None else options
        env = guarded(get_env, env_id, **arguments)
        if env is None:
            raise EnvironmentFailed("get_env returned no environment.")
        return env if recorder is None else recorder.record(env, env_id, seed)

    if num_envs:
        return VectorInstance(single, num_envs, seed, mode)
    return Instance(single(), seed, mode)


def _reset_takes_seed(env: Any) -> bool:
    """Whether `reset` takes a seed. An environment of gym's old kind has a method `seed` instead."""
    env = env.env if isinstance(env, Recorded) else env
    if not callable(getattr(env, "seed", None)):
        return True
    try:
        parameters = inspect.signature(env.reset).parameters.values()
    except (TypeError, ValueError):
        return True
    if any(parameter.name == "seed" for parameter in parameters):
        return True
    # gym's old wrappers pass all keyword arguments on, to a reset that takes none.
    return isinstance(env, gymnasium.Env) and any(one.kind is one.VAR_KEYWORD for one in parameters)


def _five(results: Any) -> Any:
    """Read a step's five results, or the four of gym's old kind. Raises EnvironmentFailed for anything else."""
    if not isinstance(results, tuple | list) or len(results) not in (4, 5):
        raise EnvironmentFailed("step() must return five values: observation, reward, terminated, truncated and info.")
    if len(results) == 5:
        return results
    observation, reward, done, info = results
    cut_off = bool(info.get(CUT_OFF)) if isinstance(info, dict) else False
    return InstanceStep(observation, reward, bool(done) and not cut_off, bool(done) and cut_off, info)


def number(reward: Any) -> float:
    """Convert one environment's reward to a float. Raises EnvironmentFailed if it is no number."""
    if type(reward) is float:
        return reward
    try:
        return float(reward.item() if isinstance(reward, np.ndarray) else reward)
    except (TypeError, ValueError):
        sentence = f"step() returned a reward that is no number: {type(reward).__name__}."
        raise EnvironmentFailed(sentence) from None


def as_dict(info: Any) -> Any:
    """Convert an info to a dict: None to {}; anything else that is no dict becomes the value of the key `info`."""
    return info if isinstance(info, Mapping) else {} if info is None else {"info": info}
