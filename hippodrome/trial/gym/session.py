"""Answers the requests of one connection, and holds its environments. Does no I/O itself."""

from __future__ import annotations

import contextlib
import json
import uuid
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from hippodrome.trial.gym import overrides, spaces, values
from hippodrome.trial.gym.forms import (
    SUBPROTOCOL,
    EnvironmentFailed,
    GymError,
    InstanceNotFound,
    InvalidMessage,
    LimitReached,
    MessageForm,
    MethodNotFound,
    WrongParameters,
    described,
    short,
)
from hippodrome.trial.gym.instance import Instance, guarded
from hippodrome.trial.gym.recordings import ConnectionRecorder
from hippodrome.trial.gym.spaces import CodecError

MAX_STEPS = 65_536
"""The most steps of one message."""

_MODES = {mode.value: mode for mode in AutoresetMode}


class GymSession:
    """Answers the requests of one connection in its form."""

    def __init__(self, form: MessageForm, recorder: ConnectionRecorder | None = None) -> None:
        self.form = form
        self._recorder = recorder
        self._instances: dict[str, Instance] = {}
        self._methods: dict[str, Callable[..., Any]] = {
            "make": self._make,
            "step": self._step,
            "step_many": self._step_many,
            "reset": self._reset,
            "close": self._close,
            "observation_space": lambda instance_id: spaces.describe(self._found(instance_id).env.observation_space),
            "action_space": lambda instance_id: spaces.describe(self._found(instance_id).env.action_space),
            "action_sample": lambda instance_id: guarded(self._found(instance_id).env.action_space.sample),
            "render": self._render,
        }

    def answer(self, message: str | bytes) -> str | bytes | GymError:
        """Carry out a request, and return the answer; in Gymie's form an error, which closes the connection."""
        try:
            method, params = self._read(message)
            result = self._call(method, params)
            return str(result) if self.form.gymie and method == "make" else self._written(result)
        except GymError as raised:
            error = raised
        except CodecError as raised:
            error = EnvironmentFailed(str(raised))
        except BaseException as raised:  # noqa: BLE001 - raised by a value that the environment returned
            error = EnvironmentFailed(f"What the environment returned cannot be sent: {described(raised)}")
        if self.form.gymie:
            return error
        return self._written({"error": {"type": type(error).__name__, "message": str(error)}})

    def _call(self, method: Any, params: Any) -> Any:
        call = self._methods.get(method) if isinstance(method, str) else None
        if call is None:
            raise MethodNotFound(f"Method `{short(str(method), 80)}` not found")
        try:
            return call(**params)
        except TypeError as error:
            if error.__traceback__ is None or error.__traceback__.tb_next is not None:
                raise
            why = str(error).partition("() ")[2] if isinstance(params, dict) else "they must be an object"
            raise WrongParameters(f"Parameters `{short(str(params), 80)}` are wrong", why) from None

    def end(self) -> None:
        """Close all environments. Errors that they raise (`GymError`) are ignored."""
        for instance in self._instances.values():
            with contextlib.suppress(GymError):
                instance.close()

    def _read(self, message: str | bytes) -> tuple[Any, Any]:
        if isinstance(message, bytes) and not self.form.exact:
            raise InvalidMessage(f"Binary messages are for the subprotocol {SUBPROTOCOL}.")
        try:
            request = json.loads(message) if isinstance(message, str) else values.from_bytes(message)
        except (ValueError, RecursionError):
            raise InvalidMessage(f"Message `{short(str(message[:80]), 80)}` is invalid") from None
        if not isinstance(request, dict):
            raise InvalidMessage(f"Message `{short(str(message[:80]), 80)}` is invalid")
        if "method" not in request or "params" not in request:
            raise InvalidMessage(f"Message keys {short(str(list(request)), 80)} are missing or invalid")
        return request["method"], request["params"]

    def _written(self, result: Any) -> str | bytes:
        return values.to_bytes(result) if self.form.exact else values.to_text(result)

    # ---- the methods that a request may name; their parameters are those of the request, and they return the answer

    def _make(
        self,
        env_id: str,
        seed: int | None = None,
        autoreset_mode: str = AutoresetMode.NEXT_STEP.value,
        **options: Any,
    ) -> Any:
        """Make an environment. `options` go to `gymnasium.make`, or to the program's own `get_env`."""
        _check(isinstance(env_id, str), "env_id must be a text.")
        _check(_is_seed(seed), "seed must be a whole number of 0 or more.")
        mode = _MODES.get(autoreset_mode) if isinstance(autoreset_mode, str) else None
        if mode is None:
            raise WrongParameters(f"autoreset_mode must be one of {', '.join(_MODES)}.")
        own = overrides.replaced("get_env")
        arguments = {"seed": seed, **options} if own is not None and seed is not None else options
        env = guarded(own or overrides.get_env, env_id, **arguments)
        if env is None:
            raise EnvironmentFailed("get_env returned no environment.")
        if self._recorder is not None:
            env = self._recorder.record(env, env_id, seed)
        description = _description(env) if self.form.exact else {}
        instance_id = uuid.uuid4().hex
        self._instances[instance_id] = Instance(env, seed, mode)
        return instance_id if self.form.gymie else {"instance_id": instance_id} | description

    def _step(self, instance_id: str, action: Any, render: bool = False) -> Any:
        """Take one step."""
        instance = self._found(instance_id)
        if render:
            instance.render()
        step = instance.step(action)
        return list(step) if self.form.five else instance.with_done(step)

    def _step_many(self, instance_id: str, actions: Any) -> Any:
        """Take a step for each action, and answer with five lists. After the end of an episode, begin the next one."""
        instance = self._found(instance_id)
        _check(isinstance(actions, list | tuple | np.ndarray), "actions must be a list.")
        if len(actions) > MAX_STEPS:
            raise LimitReached(f"One request may ask for {MAX_STEPS} steps, not for {len(actions)}.")
        steps = list(instance.steps(actions))
        columns: list[Any] = [[step[at] for step in steps] for at in range(5)]
        if self.form.exact:
            columns[0] = values.stacked(instance.env.observation_space, columns[0])
            columns[1:4] = np.array(columns[1]), np.array(columns[2], bool), np.array(columns[3], bool)
        return columns

    def _reset(self, instance_id: str, seed: Any = None, options: Any = None) -> Any:
        """Begin an episode."""
        instance = self._found(instance_id)
        _check(_is_seed(seed), "seed must be a whole number of 0 or more.")
        _check(options is None or isinstance(options, dict), "options must be an object.")
        observation, info = instance.reset(seed, options)
        return [observation, info] if self.form.five else observation

    def _close(self, instance_id: str) -> bool:
        """Close an environment."""
        instance = self._found(instance_id)
        del self._instances[instance_id]
        instance.close()
        return True

    def _render(self, instance_id: str) -> Any:
        """Answer with what the environment's `render` returns; in JSON a picture is a PNG."""
        rendered = self._found(instance_id).render()
        return rendered if self.form.exact else values.picture(rendered)

    def _found(self, instance_id: Any) -> Instance:
        try:
            return self._instances[instance_id]
        except (KeyError, TypeError):
            raise InstanceNotFound(short(str(instance_id), 80)) from None


def _description(env: Any) -> dict[str, Any]:
    """Describe an environment for RemoteEnv. Raises CodecError."""
    spec = getattr(env, "spec", None)
    attributes = ("max_episode_steps", "reward_threshold", "nondeterministic")
    return {
        "observation_space": spaces.describe(env.observation_space),
        "action_space": spaces.describe(env.action_space),
        "render_mode": getattr(env, "render_mode", None),
        "metadata": dict(getattr(env, "metadata", None) or {}),
        "spec": {} if spec is None else {name: getattr(spec, name) for name in attributes},
    }


def _check(condition: bool, words: str) -> None:
    if not condition:
        raise WrongParameters(words)


def _is_seed(seed: Any) -> bool:
    return seed is None or (type(seed) is int and seed >= 0)
