"""Answers the requests of one connection, and holds its environments. Does no I/O itself."""

from __future__ import annotations

import functools
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

from trial.gym import arrays, spaces, values
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
from trial.gym.forms import SUBPROTOCOL, MessageForm
from trial.gym.instance import CUT_OFF, MODES, Instance, InstanceStep, as_dict, guarded, number
from trial.gym.instance import make as make_instance
from trial.gym.limits import Limits, Rate
from trial.gym.recordings import ConnectionRecorder
from trial.gym.spaces import CodecError

_read = json.JSONDecoder().decode
_ENDS = ("false,{}]", "true,{}]")  # the end of an answer (done and info), by `terminated`
_ENDS_OF_FIVE = ("false,false,{}]", "true,false,{}]")  # the same for answers with terminated, truncated and info


class HeldEnvironment:
    """An environment of a connection, under its id (in JSON) and its handle (in binary messages)."""

    def __init__(self, instance: Instance, instance_id: str, handle: int) -> None:
        self.instance = instance
        self.instance_id = instance_id
        self.handle = handle
        self.decode = guarded(values.decoder, instance.env.action_space, action=True)
        """A function that reads an action from JSON data. It raises CodecError."""
        self.bytes = _bytes(instance.single_observation_space) * instance.size
        """The size of one step's observations in bytes, without parts whose size varies."""

    @functools.cached_property
    def layouts(self) -> tuple[ArrayLayout, ArrayLayout]:
        """The layouts of observations and of actions in binary messages. Raises CodecError."""
        return (
            arrays.layout(self.instance.single_observation_space),
            arrays.layout(self.instance.single_action_space, action=True),
        )


class GymSession:
    """Answers the requests of one connection, in its form and within its limits."""

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
        """Carry out a request in JSON, and return the reply. Raises GymError."""
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
            reason = str(error).partition("() ")[2] if isinstance(params, dict) else "they must be an object"
            raise WrongParameters(f"Parameters `{short(str(params), 80)}` are wrong", reason) from None
        except CodecError as error:
            raise EnvironmentFailed(str(error)) from error

    def answer_arrays(self, data: bytes) -> bytes:
        """Carry out a binary request, and return the reply. Raises GymError."""
        if not self.form.arrays:
            raise InvalidMessage(f"Binary messages are for the subprotocol {SUBPROTOCOL}.")
        try:
            request = arrays.read_request(data)
        except CodecError as error:
            raise InvalidMessage(str(error)) from None
        held = self._by_handle.get(request.handle)
        if held is None:
            raise InstanceNotFound(str(request.handle))
        try:
            if request.kind == arrays.RESET:
                return self._reset_arrays(held, request)
            return self._step_arrays(held, request)
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
        instance, count = held.instance, request.steps
        self._allow(held, count)
        observations, actions = held.layouts
        try:
            batch = arrays.read_actions(request, actions, instance.size)
        except CodecError as error:
            action = arrays.refused(request, instance.single_action_space, instance.size)
            raise WrongAction(action, str(error)) from None
        take = _vector_steps if instance.num_envs else _single_steps
        return arrays.steps_reply(request.kind, held.handle, observations, take(held, batch, count))

    def end(self) -> None:
        """Close all environments. Errors that they raise (`GymError`) are ignored."""
        while self._held:
            _, held = self._held.popitem()
            try:
                held.instance.close()
            except GymError:
                continue

    # ---- the methods that a request may name, with the parameters of the request; each returns the answer

    def make(
        self,
        env_id: str,
        seed: int | None = None,
        num_envs: int | None = None,
        autoreset_mode: str = AutoresetMode.NEXT_STEP.value,
        **options: Any,
    ) -> str:
        """Make an environment, or a vector of `num_envs`, and answer with its id. `options` go to `gymnasium.make`."""
        _check(type(env_id) is str, "env_id must be a text")
        _check(_is_seed(seed), "seed must be a whole number of 0 or more")
        _check(num_envs is None or (type(num_envs) is int and num_envs > 0), "num_envs must be 1 or more")
        _check(
            type(autoreset_mode) is str and autoreset_mode in MODES,
            f"autoreset_mode must be one of {', '.join(MODES)}",
        )
        used = sum(held.instance.size for held in self._held.values())
        if used + (num_envs or 1) > self._limits.environments:
            raise LimitReached(
                f"A connection may have {self._limits.environments} environments; it has {used}. Close some."
            )
        mode = MODES[autoreset_mode]
        instance = make_instance(env_id, seed, num_envs or 0, mode, options, recorder=self._recorder)
        self._handles += 1
        held = HeldEnvironment(instance, uuid.uuid4().hex, self._handles)
        self._held[held.instance_id] = self._by_handle[held.handle] = held
        if self.form.bare_id:
            return held.instance_id
        return values.to_text(_description(held) if self.form.arrays else {"instance_id": held.instance_id})

    def step(self, instance_id: str, action: Any, render: bool = False) -> str:
        """Take one step of an environment, or of all environments of a vector."""
        held = self._find(instance_id)
        instance = held.instance
        if self._rate is not None:
            self._rate.take(instance.size, time.monotonic())
        if render:
            instance.render()
        step = instance.step(self._action(held, action))
        if instance.processes:
            step = instance.processed(step)
        return self._quick_answer(step) or values.to_text(self._shaped(step, instance))

    def step_many(self, instance_id: str, actions: Any) -> str:
        """Take a step for each action, and answer with five lists. After the end of an episode, begin the next one."""
        held = self._find(instance_id)
        _check(isinstance(actions, list), "actions must be a list")
        self._allow(held, len(actions))
        decoded = [self._action(held, action) for action in actions]
        steps = [held.instance.processed(InstanceStep(*step)) for step in held.instance.steps(decoded)]
        columns = [[step[at] for step in steps] for at in range(5)]
        if not held.instance.num_envs:
            columns[1] = [number(reward) for reward in columns[1]]
        columns[4] = [as_dict(info) for info in columns[4]]
        columns[2:4] = [[_truth(flag) for flag in column] for column in columns[2:4]]
        return values.to_text(columns)

    def reset(self, instance_id: str, seed: Any = None, options: Any = None) -> str:
        """Begin an episode. Answer with its first observation; if `form.five`, with the observation and its info."""
        held = self._find(instance_id)
        _check(
            _is_seed(seed) or (isinstance(seed, list) and held.instance.num_envs > 0 and all(map(_is_seed, seed))),
            "seed must be a whole number of 0 or more",
        )
        _check(options is None or isinstance(options, dict), "options must be an object")
        observation, info = held.instance.reset(seed, options)
        return values.to_text([observation, info] if self.form.five else observation)

    def close(self, instance_id: str) -> str:
        """Close an environment."""
        held = self._find(instance_id)
        del self._held[instance_id], self._by_handle[held.handle]
        held.instance.close()
        return values.to_text(True)

    def observation_space(self, instance_id: str) -> str:
        """Answer with the description of the observation space; for a vector, of the space of all its environments."""
        return values.to_text(spaces.describe(self._find(instance_id).instance.env.observation_space))

    def action_space(self, instance_id: str) -> str:
        """Answer with the description of the action space; for a vector, of the space of all its environments."""
        return values.to_text(spaces.describe(self._find(instance_id).instance.env.action_space))

    def action_sample(self, instance_id: str) -> str:
        """Answer with a random action of the action space."""
        return values.to_text(guarded(self._find(instance_id).instance.env.action_space.sample))

    def render(self, instance_id: str) -> str:
        """Answer with what the environment's `render` returns; a picture as PNG."""
        return values.to_text(values.picture(self._find(instance_id).instance.render()))

    # ---- shared by these methods

    def _allow(self, held: HeldEnvironment, steps: int) -> None:
        """Raise LimitReached if a request for `steps` steps exceeds a limit."""
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

    def _quick_answer(self, step: InstanceStep) -> str:
        """Write the answer to a usual step (an array of numbers, no info) in a faster way. Empty for any other step."""
        observation, reward, terminated, truncated, info = step
        if info or type(observation) is not np.ndarray or observation.dtype.kind not in "fiu":
            return ""
        if type(reward) is not float or type(terminated) is not bool or type(truncated) is not bool or truncated:
            return ""
        numbers = f"[{observation.tolist()!r},{reward!r},"  # Python writes finite numbers as JSON has them
        if "n" in numbers:  # nan or inf
            return ""
        return numbers + (_ENDS_OF_FIVE[terminated] if self.form.five else _ENDS[terminated])

    def _shaped(self, step: InstanceStep, instance: Instance) -> list[Any]:
        """Return the step's results in the connection's form."""
        observation, reward, terminated, truncated, info = step
        if type(observation) is np.ndarray and not self.form.arrays:
            observation = observation.tolist()
        if not instance.num_envs:
            reward = number(reward)
        info = as_dict(info)
        if self.form.five:
            return [observation, reward, _truth(terminated), _truth(truncated), info]
        if type(terminated) is np.ndarray:
            return [observation, reward, terminated | truncated, info]
        if truncated and not instance.processes:  # a program's `process_step` got this in the info, and may remove it
            info = {**info, CUT_OFF: not terminated}
        return [observation, reward, bool(terminated or truncated), info]


def _description(held: HeldEnvironment) -> dict[str, Any]:
    """Build the answer to `make` for the form `arrays`: a description of the environment."""
    instance = held.instance
    return {
        "instance_id": held.instance_id,
        "handle": held.handle,
        "num_envs": instance.num_envs,
        "autoreset_mode": instance.mode.value,
        "render_mode": getattr(instance.env, "render_mode", None),
        "metadata": _metadata(instance.env),
        "spec": _spec(instance.first),
        "observation_space": spaces.describe(instance.single_observation_space, compact=True),
        "action_space": spaces.describe(instance.single_action_space, compact=True),
    }


def _single_steps(held: HeldEnvironment, batch: Any, count: int) -> arrays.StepRows:
    """Take `count` steps of a single environment, with a batch of actions."""
    observations, actions = held.layouts
    taken = observations.empty(count)
    put, instance = observations.put, held.instance
    rewards: list[float] = []
    terminated: list[Any] = []
    truncated: list[Any] = []
    infos: arrays.Infos = []
    steps = instance.steps(actions.rows(batch, count))
    if instance.processes:
        steps = (instance.processed(InstanceStep(*step)) for step in steps)
    for at, (observation, reward, is_terminated, is_truncated, info) in enumerate(steps):
        put(taken, at, observation)
        rewards.append(reward)
        terminated.append(is_terminated)
        truncated.append(is_truncated)
        if info:
            infos.append((at, as_dict(info)))
    return arrays.StepRows(
        taken, _numbers(rewards), np.array(terminated, np.bool_), np.array(truncated, np.bool_), infos
    )


def _vector_steps(held: HeldEnvironment, batch: Any, count: int) -> arrays.StepRows:
    """Take `count` steps of all environments of a vector, with a batch of actions."""
    observations, actions = held.layouts
    instance, size = held.instance, held.instance.size
    each = list(actions.rows(batch, count * size))
    taken = observations.empty(count * size)
    rewards: list[Any] = []
    terminated: list[Any] = []
    truncated: list[Any] = []
    infos: arrays.Infos = []
    together = [_together(instance, each[at : at + size]) for at in range(0, len(each), size)]
    for at, (observation, reward, are_terminated, are_truncated, info) in enumerate(instance.steps(together)):
        observations.put_batch(taken, at * size, observation, size)
        rewards.append(reward)
        terminated.append(are_terminated)
        truncated.append(are_truncated)
        if info:
            infos.append((at, info))
    return arrays.StepRows(taken, np.concatenate(rewards), np.concatenate(terminated), np.concatenate(truncated), infos)


def _together(instance: Instance, actions: Sequence[Any]) -> Any:
    """Join the actions of a vector's environments to one action of the vector."""
    if isinstance(instance.env.action_space, Tuple):
        return tuple(actions)
    empty: Any = create_empty_array(instance.single_action_space, instance.size)
    return concatenate(instance.single_action_space, actions, empty)


def _metadata(env: Any) -> Any:
    metadata = dict(getattr(env, "metadata", None) or {})
    metadata.pop("autoreset_mode", None)  # an enumeration, which is sent in a field of its own
    return values.plain(metadata)


def _spec(env: Any) -> Any:
    spec = getattr(env, "spec", None)
    names = ("id", "max_episode_steps", "reward_threshold", "nondeterministic")
    return None if spec is None else values.plain({name: getattr(spec, name, None) for name in names})


def _numbers(rewards: list[Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Convert the rewards to an array. Raises EnvironmentFailed if one is no number."""
    try:
        array = np.array(rewards, np.float64)
        if array.ndim == 1 and not np.isnan(array).any():  # NumPy turns None into NaN
            return array
    except (TypeError, ValueError):
        pass
    return np.array([number(reward) for reward in rewards], np.float64)


def _check(condition: bool, words: str) -> None:
    if not condition:
        raise WrongParameters(f"{words}.")


def _is_seed(seed: Any) -> bool:
    return seed is None or (type(seed) is int and seed >= 0)


def _truth(flag: Any) -> Any:
    """Convert a flag to a bool. The flags of a vector stay an array."""
    return flag if isinstance(flag, np.ndarray) else bool(flag)


def _bytes(space: Any) -> int:
    """Return the size of one observation in bytes, without parts whose size varies."""
    shape, dtype = getattr(space, "shape", None), getattr(space, "dtype", None)
    if shape is None or dtype is None:
        inner = getattr(space, "spaces", None)
        parts = inner.values() if isinstance(inner, Mapping) else inner if isinstance(inner, tuple | list) else ()
        return sum(map(_bytes, parts))
    return int(math.prod(shape) * np.dtype(dtype).itemsize)
