"""The methods of one connection, and its environments. No I/O but what the environments do."""

from __future__ import annotations

import json
import math
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Tuple
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import concatenate, create_empty_array

from trial.gym import arrays, instance, spaces, values
from trial.gym.arrays import ArrayLayout
from trial.gym.errors import (
    EnvironmentFailed,
    GymError,
    InstanceNotFound,
    InvalidMessage,
    LimitReached,
    MethodNotFound,
    WrongAction,
    WrongParameters,
    short,
)
from trial.gym.forms import MessageForm
from trial.gym.instance import Instance, InstanceStep, as_dict, guarded, number
from trial.gym.limits import Limits, Rate
from trial.gym.recordings import ConnectionRecorder
from trial.gym.spaces import CodecError

_read = json.JSONDecoder().decode
_ENDS = ("false,{}]", "true,{}]")
_ENDS_OF_FIVE = ("false,false,{}]", "true,false,{}]")


class HeldEnvironment:
    """An environment and what is made once for it."""

    def __init__(self, made: Instance, instance_id: str, handle: int) -> None:
        self.instance = made
        self.instance_id = instance_id
        self.handle = handle
        env = made.env
        self.decode = guarded(_decoder, env.action_space)
        self.bytes = _bytes(made.single_observation_space) * made.size
        self._layouts: tuple[ArrayLayout, ArrayLayout] | None = None

    @property
    def layouts(self) -> tuple[ArrayLayout, ArrayLayout]:
        """How observations and actions lie in binary messages. Raises CodecError."""
        if self._layouts is None:
            made = self.instance
            self._layouts = (
                arrays.layout(made.single_observation_space),
                arrays.layout(made.single_action_space, action=True),
            )
        return self._layouts


class GymSession:
    """Answers the requests of one connection. Its environments are closed with it."""

    def __init__(self, form: MessageForm, limits: Limits, recorder: ConnectionRecorder | None = None) -> None:
        self.form = form
        self._limits = limits
        self._rate = Rate(limits.steps_per_second) if limits.steps_per_second else None
        self._recorder = recorder
        self._held: dict[str, HeldEnvironment] = {}
        self._by_handle: dict[int, HeldEnvironment] = {}
        self._handles = 0
        self._methods: dict[str, Callable[..., str]] = {
            name: getattr(self, name)
            for name in (
                "make",
                "step",
                "step_many",
                "reset",
                "close",
                "observation_space",
                "action_space",
                "action_sample",
                "render",
            )
        }

    def answer(self, text: str) -> str:
        """The reply to a request. Raises GymError."""
        try:
            message = _read(text)
        except (ValueError, RecursionError):
            raise InvalidMessage(f"Message `{short(text, 80)}` is invalid") from None
        if type(message) is not dict:
            raise InvalidMessage(f"Message `{short(text, 80)}` is invalid")
        try:
            method, params = message["method"], message["params"]
        except KeyError:
            raise InvalidMessage(f"Message keys {short(str(list(message)), 80)} are missing or invalid") from None
        call = self._methods.get(method) if type(method) is str else None
        if call is None:
            raise MethodNotFound(f"Method `{short(str(method), 80)}` not found")
        try:
            return call(**params)
        except TypeError as error:
            if error.__traceback__ is None or error.__traceback__.tb_next is not None:
                raise
            why = str(error).partition("() ")[2] if isinstance(params, dict) else "they must be an object"
            raise WrongParameters(f"Parameters `{short(str(params), 80)}` are wrong", why) from None
        except CodecError as error:
            raise EnvironmentFailed(str(error)) from error

    def answer_arrays(self, data: bytes) -> bytes:
        """The reply to a binary request. Raises GymError."""
        if not self.form.arrays:
            raise InvalidMessage(f"Binary messages are for the subprotocol {arrays.SUBPROTOCOL}.")
        try:
            request = arrays.read_request(data)
        except CodecError as error:
            raise InvalidMessage(str(error)) from None
        held = self._by_handle.get(request.handle)
        if held is None:
            raise InstanceNotFound(str(request.handle))
        try:
            return (
                self._reset_arrays(held, request) if request.kind == arrays.RESET else self._step_arrays(held, request)
            )
        except CodecError as error:
            raise EnvironmentFailed(str(error)) from error

    def _reset_arrays(self, held: HeldEnvironment, request: arrays.ArrayRequest) -> bytes:
        try:
            seed, options = arrays.read_reset(request)
        except CodecError as error:
            raise WrongParameters(str(error)) from None
        _check(not isinstance(seed, list) or held.instance.num_envs > 0, "seed must be one number")
        observations, _ = held.layouts
        observation, info = held.instance.reset(seed, options)
        if held.instance.num_envs:
            batch = observation
        else:
            batch = observations.empty(1)
            observations.put(batch, 0, observation)
        return arrays.reset_reply(held.handle, observations, held.instance.size, batch, [(0, info)])

    def _step_arrays(self, held: HeldEnvironment, request: arrays.ArrayRequest) -> bytes:
        made, count = held.instance, request.steps
        self.allow(held, count)
        observations, actions = held.layouts
        try:
            batch = arrays.read_actions(request, actions, made.size)
        except CodecError as error:
            raise WrongAction(arrays.refused(request, made.single_action_space, made.size), str(error)) from None
        steps = self._vector_steps(held, batch, count) if made.num_envs else self._single_steps(held, batch, count)
        return arrays.steps_reply(request.kind, held.handle, observations, steps)

    def _single_steps(self, held: HeldEnvironment, batch: Any, count: int) -> arrays.StepRows:
        observations, actions = held.layouts
        found = observations.empty(count)
        put, made = observations.put, held.instance
        rewards: list[float] = []
        terminated: list[Any] = []
        truncated: list[Any] = []
        infos: arrays.Infos = []
        steps = made.steps(actions.rows(batch, count))
        if made.processes:
            steps = (made.processed(InstanceStep(*step)) for step in steps)
        for at, (observation, reward, end, cut, info) in enumerate(steps):
            put(found, at, observation)
            rewards.append(reward)
            terminated.append(end)
            truncated.append(cut)
            if info:
                infos.append((at, as_dict(info)))
        return arrays.StepRows(found, _numbers(rewards), _flags(terminated), _flags(truncated), infos)

    def _vector_steps(self, held: HeldEnvironment, batch: Any, count: int) -> arrays.StepRows:
        observations, actions = held.layouts
        made = held.instance
        each = list(actions.rows(batch, count * made.size))
        found = observations.empty(count * made.size)
        rewards: list[Any] = []
        terminated: list[Any] = []
        truncated: list[Any] = []
        infos: arrays.Infos = []

        together = [_together(made, each[at : at + made.size]) for at in range(0, len(each), made.size)]
        for at, (observation, reward, end, cut, info) in enumerate(made.steps(together)):
            observations.put_batch(found, at * made.size, observation, made.size)
            rewards.append(reward)
            terminated.append(end)
            truncated.append(cut)
            if info:
                infos.append((at, info))
        return arrays.StepRows(
            found, np.concatenate(rewards), np.concatenate(terminated), np.concatenate(truncated), infos
        )

    def end(self) -> None:
        """Close all environments; what they raise is ignored."""
        while self._held:
            _, held = self._held.popitem()
            try:
                held.instance.close()
            except GymError:
                continue

    # ---- the methods of a request; their parameters are those of the message

    def make(
        self,
        env_id: str,
        seed: int | None = None,
        num_envs: int | None = None,
        autoreset_mode: str = AutoresetMode.NEXT_STEP.value,
        **options: Any,
    ) -> str:
        """Make an environment, or a vector of `num_envs`; its id. `options` are the environment's own."""
        _check(type(env_id) is str, "env_id must be a text")
        _check(_is_seed(seed), "seed must be a whole number of 0 or more")
        _check(num_envs is None or (type(num_envs) is int and num_envs > 0), "num_envs must be 1 or more")
        _check(
            type(autoreset_mode) is str and autoreset_mode in instance.MODES,
            f"autoreset_mode must be one of {', '.join(instance.MODES)}",
        )
        used = sum(held.instance.size for held in self._held.values())
        if used + (num_envs or 1) > self._limits.environments:
            raise LimitReached(
                f"A connection may have {self._limits.environments} environments; it has {used}. Close some."
            )
        made = instance.make(
            env_id, seed, num_envs or 0, instance.MODES[autoreset_mode], options, recorder=self._recorder
        )
        self._handles += 1
        held = HeldEnvironment(made, uuid.uuid4().hex, self._handles)
        self._held[held.instance_id] = self._by_handle[held.handle] = held
        if self.form.bare_id:
            return held.instance_id
        return self.form.result(self._described(held) if self.form.arrays else {"instance_id": held.instance_id})

    def step(self, instance_id: str, action: Any, render: bool = False) -> str:
        """One step of an environment, or of all environments of a vector."""
        held = self._find(instance_id)
        made = held.instance
        if self._rate is not None:
            self._rate.take(made.size, time.monotonic())
        if render:
            made.render()
        found = made.step(self._action(held, action))
        if made.processes:
            found = made.processed(found)
        return self._plain(found) or self.form.result(self._shaped(found, made))

    def step_many(self, instance_id: str, actions: Any) -> str:
        """A step for each action, with the next episode begun after each end; five lists."""
        held = self._find(instance_id)
        _check(isinstance(actions, list), "actions must be a list")
        self.allow(held, len(actions))
        decoded = [self._action(held, action) for action in actions]
        steps = [held.instance.processed(InstanceStep(*step)) for step in held.instance.steps(decoded)]
        columns = [[step[at] for step in steps] for at in range(5)]
        if not held.instance.num_envs:
            columns[1] = [number(reward) for reward in columns[1]]
        columns[4] = [as_dict(info) for info in columns[4]]
        columns[2:4] = [[_truth(flag) for flag in column] for column in columns[2:4]]
        return self.form.result(columns)

    def reset(self, instance_id: str, seed: Any = None, options: Any = None) -> str:
        """Begin an episode: its first observation, or observation and info."""
        held = self._find(instance_id)
        _check(
            _is_seed(seed) or (isinstance(seed, list) and held.instance.num_envs > 0 and all(map(_is_seed, seed))),
            "seed must be a whole number of 0 or more",
        )
        _check(options is None or isinstance(options, dict), "options must be an object")
        observation, info = held.instance.reset(seed, options)
        return self.form.result([observation, info] if self.form.five else observation)

    def close(self, instance_id: str) -> str:
        """Close an environment."""
        held = self._find(instance_id)
        del self._held[instance_id], self._by_handle[held.handle]
        held.instance.close()
        return self.form.result(True)

    def observation_space(self, instance_id: str) -> str:
        """The description of the observation space; of a vector, for all of its environments together."""
        return self.form.result(spaces.describe(self._find(instance_id).instance.env.observation_space))

    def action_space(self, instance_id: str) -> str:
        """The description of the action space; of a vector, for all of its environments together."""
        return self.form.result(spaces.describe(self._find(instance_id).instance.env.action_space))

    def action_sample(self, instance_id: str) -> str:
        """A random action."""
        return self.form.result(guarded(self._find(instance_id).instance.env.action_space.sample))

    def render(self, instance_id: str) -> str:
        """What the environment's `render` returns, pictures as PNG."""
        return self.form.result(values.picture(self._find(instance_id).instance.render()))

    # ---- what the methods share

    def allow(self, held: HeldEnvironment, steps: int) -> None:
        """Check the limits of a request for so many steps. Raises LimitReached."""
        if steps > arrays.MAX_STEPS:
            raise LimitReached(f"One request may ask for {arrays.MAX_STEPS} steps, not for {steps}.")
        if steps * held.bytes > self._limits.reply_bytes:
            raise LimitReached(
                f"The observations of {steps} steps are more than {self._limits.reply_bytes // 2**20} MB."
            )
        if self._rate is not None:
            self._rate.take(steps * held.instance.size, time.monotonic())

    def _find(self, instance_id: Any) -> HeldEnvironment:
        try:
            return self._held[instance_id]
        except (KeyError, TypeError):
            raise InstanceNotFound(short(str(instance_id), 80)) from None

    def _action(self, held: HeldEnvironment, action: Any) -> Any:
        try:
            return held.decode(action)
        except CodecError as error:
            raise WrongAction(json.dumps(action), str(error)) from None

    def _plain(self, found: InstanceStep) -> str:
        """The answer to the usual step, as fast as can be: numbers in an array, and no info. Empty for another one."""
        observation, reward, terminated, truncated, info = found
        if info or type(observation) is not np.ndarray or observation.dtype.kind not in "fiu":
            return ""
        if type(reward) is not float or type(terminated) is not bool or type(truncated) is not bool or truncated:
            return ""
        end = _ENDS[terminated] if not self.form.five else _ENDS_OF_FIVE[terminated]
        said = f"[{observation.tolist()!r},{reward!r},{end}"  # Python writes finite numbers as JSON has them
        return "" if "n" in said else said  # but nan and inf

    def _shaped(self, found: InstanceStep, made: Instance) -> list[Any]:
        observation, reward, terminated, truncated, info = found
        if type(observation) is np.ndarray and not self.form.arrays:
            observation = observation.tolist()
        if not made.num_envs:
            reward = number(reward)
        info = as_dict(info)
        if self.form.five:
            return [observation, reward, _truth(terminated), _truth(truncated), info]
        if type(terminated) is np.ndarray:
            return [observation, reward, terminated | truncated, info]
        if truncated and not made.processes:  # a program has been told, and answers what it wants
            info = {**info, instance.CUT_OFF: not terminated}
        return [observation, reward, bool(terminated or truncated), info]

    def _described(self, held: HeldEnvironment) -> dict[str, Any]:
        made = held.instance
        return {
            "instance_id": held.instance_id,
            "handle": held.handle,
            "num_envs": made.num_envs,
            "autoreset_mode": made.mode.value,
            "render_mode": getattr(made.env, "render_mode", None),
            "metadata": _metadata(made.env),
            "spec": _spec(made.first),
            "observation_space": spaces.describe(made.single_observation_space, compact=True),
            "action_space": spaces.describe(made.single_action_space, compact=True),
        }


def _together(made: Instance, actions: Sequence[Any]) -> Any:
    """The actions of a vector's environments as one action of the vector."""
    if isinstance(made.env.action_space, Tuple):
        return tuple(actions)
    empty: Any = create_empty_array(made.single_action_space, made.size)
    return concatenate(made.single_action_space, actions, empty)


def _metadata(env: Any) -> Any:
    found = dict(getattr(env, "metadata", None) or {})
    found.pop("autoreset_mode", None)  # an enumeration; it stands beside
    return values.plain(found)


def _spec(env: Any) -> Any:
    spec = getattr(env, "spec", None)
    names = ("id", "max_episode_steps", "reward_threshold", "nondeterministic")
    return None if spec is None else values.plain({name: getattr(spec, name, None) for name in names})


def _numbers(rewards: list[Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
    try:
        found = np.array(rewards, np.float64)
        if found.ndim == 1 and not np.isnan(found).any():  # numpy makes NaN of None
            return found
    except (TypeError, ValueError):
        pass
    return np.array([number(reward) for reward in rewards], np.float64)


def _flags(said: list[Any]) -> np.ndarray[Any, np.dtype[np.bool_]]:
    return np.array(said, np.bool_)


def _decoder(space: Any) -> Callable[[Any], Any]:
    return values.decoder(space, action=True)


def _check(right: bool, words: str) -> None:
    if not right:
        raise WrongParameters(f"{words}.")


def _is_seed(seed: Any) -> bool:
    return seed is None or (type(seed) is int and seed >= 0)


def _truth(flag: Any) -> Any:
    return flag if isinstance(flag, np.ndarray) else bool(flag)


def _bytes(space: Any) -> int:
    """The bytes of one observation; 0 for a space whose values differ in size."""
    shape, dtype = getattr(space, "shape", None), getattr(space, "dtype", None)
    if shape is None or dtype is None:
        inner = getattr(space, "spaces", None)
        parts = inner.values() if isinstance(inner, Mapping) else inner if isinstance(inner, tuple | list) else ()
        return sum(map(_bytes, parts))
    return int(math.prod(shape) * np.dtype(dtype).itemsize)
