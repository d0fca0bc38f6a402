"""Calls one environment of a connection. Exceptions of the environment become GymErrors."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from hippodrome.trial.gym import overrides, values
from hippodrome.trial.gym.forms import EnvironmentFailed, GymError, WrongAction, WrongParameters, described
from hippodrome.trial.gym.recordings import Recorded
from hippodrome.trial.gym.spaces import CodecError

CUT_OFF = "TimeLimit.truncated"
"""The key in an info by which gym's TimeLimit says that its limit ended the episode."""


class Step(NamedTuple):
    """The results of one step."""

    observation: Any
    reward: float
    terminated: bool
    truncated: bool
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
    """An environment. `mode` is Gymnasium's `AutoresetMode`: how `steps` continues after the end of an episode."""

    def __init__(self, env: Any, seed: int | None, mode: AutoresetMode) -> None:
        self.env = env
        self._seed = seed
        self._mode = mode
        self._ended = False  # whether the last step of `steps` ended an episode
        self._process_step = overrides.replaced("process_step")
        if seed is not None:
            guarded(lambda: env.action_space.seed(seed))

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        """Begin an episode. Return its first observation and info.

        Without `seed`, the first reset uses the seed of `make`. Raises EnvironmentFailed.
        """
        made_with, self._seed = self._seed, None
        self._ended = False
        return guarded(self._reset, made_with if seed is None else seed, options)  # type: ignore[no-any-return]

    def _reset(self, seed: int | None, options: Any) -> tuple[Any, Any]:
        if seed is not None and not _reset_takes_seed(self.env):
            self.env.seed(seed)
            seed = None
        keywords = {name: value for name, value in (("seed", seed), ("options", options)) if value is not None}
        result = self.env.reset(**keywords)
        if isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict):
            return result
        return result, {}  # an environment of gym's old kind returns the observation alone

    def step(self, action: Any) -> Step:
        """Take one step. Raises WrongAction, also if the environment raises an exception, as Gymie does."""
        return self._step(self._action(action))

    def steps(self, actions: Iterable[Any]) -> Iterator[Step]:
        """Take a step for each action, and yield its results. Raises GymError; for a wrong action, before any step.

        After an episode, the next one begins as `mode` says. With `NextStep` the step after the end resets, and its
        action is not used. With `SameStep` the last step has the first observation of the next episode, and its info
        has `final_obs` and `final_info`. With `Disabled` no step is taken after the end.
        """
        for at, action in enumerate([self._action(action) for action in actions]):
            if self._ended and self._mode is AutoresetMode.DISABLED:
                return
            if self._ended:
                observation, info = self.reset()
                yield Step(observation, 0.0, False, False, info)
                continue
            try:
                step = self._step(action)
            except WrongAction as error:
                where = f" (step {at} of this request)"
                raise WrongAction(error.args[0], f"{error.args[1]}{where}") from error
            if step.terminated or step.truncated:
                if self._mode is AutoresetMode.SAME_STEP:
                    first, info = self.reset()
                    info = {**info, "final_obs": step.observation, "final_info": step.info}
                    step = step._replace(observation=first, info=info)
                else:
                    self._ended = True
            yield step

    def _action(self, data: Any) -> Any:
        try:
            return values.read(self.env.action_space, data, action=True)
        except CodecError as error:
            raise WrongAction(values.to_text(data), str(error)) from None

    def _step(self, action: Any) -> Step:
        try:
            results = self.env.step(action)
        except GymError:
            raise
        except BaseException as error:
            raise WrongAction(action, described(error)) from error
        step = _read(results)
        return step if self._process_step is None else self._processed(step)

    def _processed(self, step: Step) -> Step:
        """Let the program's own `process_step` change the step."""
        done = step.terminated or step.truncated
        info = {**step.info, CUT_OFF: not step.terminated} if step.truncated else step.info
        processed = guarded(self._process_step, (step.observation, step.reward, done, info))  # type: ignore[arg-type]
        try:
            observation, reward, new_done, info = processed
        except (TypeError, ValueError):
            raise EnvironmentFailed("process_step must return observation, reward, done and info.") from None
        if bool(new_done) != done:
            step = step._replace(terminated=bool(new_done), truncated=False)
        return step._replace(observation=observation, reward=_number(reward), info=_as_dict(info))

    def with_done(self, step: Step) -> list[Any]:
        """Return the four results of a step as gym had them: observation, reward, done and info."""
        info = step.info
        if step.truncated and self._process_step is None:  # which may have removed it
            info = {**info, CUT_OFF: not step.terminated}
        return [step.observation, step.reward, step.terminated or step.truncated, info]

    def render(self) -> Any:
        """Call the environment's `render`. Raises WrongParameters if it was made without a render mode."""
        if getattr(self.env, "render_mode", None) is None and hasattr(self.env, "spec"):
            raise WrongParameters('It cannot be rendered; make it with "render_mode": "rgb_array".')
        return guarded(self.env.render)

    def close(self) -> None:
        """Close the environment. Raises EnvironmentFailed."""
        guarded(self.env.close)


def _reset_takes_seed(env: Any) -> bool:
    """Whether `reset` takes a seed. An environment of gym's old kind has a method `seed` instead."""
    env = env.env if isinstance(env, Recorded) else env
    if not callable(getattr(env, "seed", None)):
        return True
    try:
        parameters = inspect.signature(env.reset).parameters.values()
    except (TypeError, ValueError):
        return True
    # gym's old wrappers pass all keyword arguments on, to a reset that takes none.
    return any(parameter.name == "seed" for parameter in parameters) or (
        isinstance(env, gymnasium.Env) and any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    )


def _read(results: Any) -> Step:
    """Read a step's five results, or the four of gym's old kind. Raises EnvironmentFailed for anything else."""
    if not isinstance(results, tuple | list) or len(results) not in (4, 5):
        raise EnvironmentFailed("step() must return five values: observation, reward, terminated, truncated and info.")
    observation, reward, terminated, *cut, info = results
    truncated = bool(cut[0]) if cut else bool(terminated) and isinstance(info, dict) and bool(info.get(CUT_OFF))
    terminated = bool(terminated) and bool(cut or not truncated)
    return Step(observation, _number(reward), terminated, truncated, _as_dict(info))


def _number(reward: Any) -> float:
    """Convert a reward to a float. Raises EnvironmentFailed if that is impossible."""
    try:
        return float(reward.item() if isinstance(reward, np.ndarray) else reward)
    except (TypeError, ValueError, OverflowError):
        raise EnvironmentFailed(f"step() returned a reward that cannot be a float: {type(reward).__name__}.") from None


def _as_dict(info: Any) -> Any:
    """Convert an info to a dict: None to {}; anything else that is no dict becomes the value of the key `info`."""
    return info if isinstance(info, Mapping) else {} if info is None else {"info": info}
