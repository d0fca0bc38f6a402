"""`RemoteEnv` and `RemoteVectorEnv`: environments that run on a server, with Gymnasium's interface (docs/gym.md)."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Dict, Tuple
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, iterate

from trial.gym import arrays, spaces, values
from trial.gym.client import TIMEOUT, GymClient
from trial.gym.spaces import CodecError

Columns = tuple[Any, Any, Any, Any, list[dict[str, Any]]]


class _RemoteInstance:
    """Sends the requests about one environment or vector on the server, and reads the answers."""

    def __init__(self, client: GymClient, env_id: str, **params: Any) -> None:
        self.client = client
        self.closer = weakref.finalize(self, client.close)
        try:
            client.read(self._read, client.call("make", env_id=env_id, **params))
        except BaseException:
            self.closer()
            raise

    def _read(self, description: Any) -> None:
        try:
            self.instance_id = str(description["instance_id"])
            self._handle, self.num_envs = int(description["handle"]), int(description["num_envs"])
            if not 0 <= self._handle <= 0xFFFF or self.num_envs < 0:
                raise ValueError("a number is out of range")
            self.observation_space = spaces.build(description["observation_space"])
            self.action_space = spaces.build(description["action_space"])
            self._actions = arrays.layout(self.action_space)
            self.observations = arrays.layout(self.observation_space)
            self.render_mode: str | None = description.get("render_mode")
            self.metadata = dict(description.get("metadata") or {})
            self.spec: Mapping[str, Any] = description.get("spec") or {}
            # The mode human would open a window on the server. Gymnasium's wrapper HumanRendering opens one here.
            modes = self.metadata.get("render_modes") or []
            self.metadata["render_modes"] = [mode for mode in modes if mode != "human"]
        except CodecError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CodecError(f"It describes no environment: {type(error).__name__}: {error}.") from error

    def steps(self, kind: int, steps: int, actions: Any) -> arrays.StepRows:
        size = self.num_envs or 1
        batch = self._batch(actions, steps * size)
        message = arrays.step_request(kind, self._handle, steps, self._actions, batch, num_envs=size)
        rows: arrays.StepRows = self.client.read(self._read_steps, self.client.send(message), kind, steps)
        return rows

    def _read_steps(self, reply: bytes, kind: int, steps: int) -> arrays.StepRows:
        size = self.num_envs or 1
        arrays.check_reply(reply, kind, self._handle, steps, size)
        rows = arrays.read_steps(reply, self.observations)
        if any(step >= len(rows.rewards) // size for step, _ in rows.infos):
            raise CodecError("It has an info of a step that was not taken.")
        return rows

    def reset(self, seed: Any, options: Any) -> tuple[Any, dict[str, Any]]:
        reply = self.client.send(arrays.reset_request(self._handle, seed, options))
        batch, infos = self.client.read(self._read_reset, reply)
        return batch, infos[0][1] if infos else {}

    def _read_reset(self, reply: bytes) -> tuple[Any, arrays.Infos]:
        arrays.check_reply(reply, arrays.RESET, self._handle, 1, self.num_envs or 1)
        return arrays.read_reset_reply(reply, self.observations)

    def render(self) -> Any:
        return self.client.read(values.rendered, self.client.call("render", instance_id=self.instance_id))

    def close(self) -> None:
        self.closer()

    def _batch(self, actions: Any, rows: int) -> Any:
        """Make a batch of the actions, a list or an array. Raises CodecError."""
        if len(actions) != rows:
            raise CodecError(f"{rows} actions are needed, not {len(actions)}.")
        space = self.action_space
        if isinstance(actions, np.ndarray) and actions.dtype == space.dtype and actions.shape[1:] == space.shape:
            return actions
        return arrays.batch_of(self._actions, actions)


@dataclass(frozen=True)
class _Maker:
    """Makes another RemoteEnv, with a connection of its own: the entry point in a RemoteEnv's spec."""

    url: str
    env_id: str
    metadata: dict[str, Any]
    connection: dict[str, Any] = field(repr=False)  # not in the text of this object, since it may hold a token

    def __call__(self, **options: Any) -> RemoteEnv:
        return RemoteEnv(self.url, self.env_id, **self.connection, **options)


class RemoteEnv(gymnasium.Env[Any, Any]):
    """An environment that runs on a server: `RemoteEnv("ws://127.0.0.1:5000/", "CartPole-v1")`.

    It has a connection of its own, which ends with `close`, with a `with` block, or when the object is no longer used.
    `render_mode` and `options` are those of `gymnasium.make`. `token` is put into the address (`?token=`), for a
    trial's server, or for a proxy that asks for one. `timeout` is in seconds, for connecting and for each answer. `ca`
    is a file of certificates to trust (PEM), for `wss://`. `np_random` is a generator of the client: the environment
    draws its random numbers on the server, by the seed of `reset`.

    Its methods raise RemoteError with the server's sentence. They raise ConnectionLost, a RemoteError, if the
    connection has ended: then the environment is closed, and a new RemoteEnv makes a new one.
    """

    # `gymnasium.make` reads the modes of the class, which are the usual ones. An instance has its environment's modes.
    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "ansi"]}  # noqa: RUF012

    def __init__(
        self,
        url: str,
        env_id: str,
        *,
        render_mode: str | None = None,
        token: str | None = None,
        ca: str | None = None,
        timeout: float = TIMEOUT,
        **options: Any,
    ) -> None:
        _refuse_window(render_mode)
        connection = {"token": token, "ca": ca, "timeout": timeout}
        given = options if render_mode is None else options | {"render_mode": render_mode}
        remote = _RemoteInstance(GymClient(url, token=token, ca=ca, timeout=timeout), env_id, **given)
        self._remote = remote
        self.observation_space = remote.observation_space
        self.action_space = remote.action_space
        self.metadata = remote.metadata
        self.render_mode = remote.render_mode
        self.spec = EnvSpec(
            env_id,
            entry_point=_Maker(url, env_id, remote.metadata, connection),
            reward_threshold=remote.spec.get("reward_threshold"),
            nondeterministic=bool(remote.spec.get("nondeterministic", False)),
            max_episode_steps=remote.spec.get("max_episode_steps"),
            kwargs=given,
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode. Return its first observation and info."""
        super().reset(seed=seed)
        batch, info = self._remote.reset(seed if seed is None else int(seed), options)
        return self._remote.observations.rows(batch, 1)[0], info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one step. Raises CodecError if `action` does not have the shape and kind of the action space."""
        remote = self._remote
        rows = remote.steps(arrays.STEP, 1, [action])
        observation = remote.observations.rows(rows.observations, 1)[0]
        info = rows.infos[0][1] if rows.infos else {}
        return observation, float(rows.rewards[0]), bool(rows.terminated[0]), bool(rows.truncated[0]), info

    def step_many(self, actions: Any) -> Columns:
        """Take a step for each action, with one message. Return observations, rewards, terminated, truncated, infos.

        `actions` is a list of actions, or an array of them. The observations are one batch, in the form of Gymnasium's
        vector environments, and the infos a list. After an episode the next one begins, as in Gymnasium's vector
        environments. By default (`autoreset_mode="NextStep"`) the step after the end does not use its action: it resets
        the environment, and its reward is 0. With `"SameStep"`, the last step of an episode has the next episode's
        first observation, and `final_obs` and `final_info` in its info. With `"Disabled"`, no further step is taken, so
        there are fewer results than actions. `autoreset_mode` is an option of the constructor.
        """
        rows = self._remote.steps(arrays.STEP_MANY, len(actions), actions)
        return *rows[:4], _infos(rows.infos, len(rows.rewards))

    def render(self) -> Any:
        """Return what the environment's `render` returns. Pictures come without loss."""
        return self._remote.render()

    def close(self) -> None:
        """Close the environment and the connection. May be called again."""
        if hasattr(self, "_remote"):
            self._remote.close()


class RemoteVectorEnv(VectorEnv[Any, Any, Any]):
    """A vector of equal environments that run on a server: a `SyncVectorEnv` over a connection.

    `RemoteVectorEnv("ws://127.0.0.1:5000/", "CartPole-v1", num_envs=8)` makes one. `autoreset_mode` is as in
    `RemoteEnv.step_many`. The other parameters are those of `RemoteEnv`.
    """

    def __init__(
        self,
        url: str,
        env_id: str,
        num_envs: int,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        token: str | None = None,
        ca: str | None = None,
        timeout: float = TIMEOUT,
        **options: Any,
    ) -> None:
        super().__init__()
        _refuse_window(render_mode)
        mode = AutoresetMode(autoreset_mode)
        given = options if render_mode is None else options | {"render_mode": render_mode}
        client = GymClient(url, token=token, ca=ca, timeout=timeout)
        remote = _RemoteInstance(client, env_id, num_envs=num_envs, autoreset_mode=mode.value, **given)
        self._remote = remote
        self.num_envs = remote.num_envs
        self.metadata = remote.metadata | {"autoreset_mode": mode}
        self.render_mode = remote.render_mode
        self.single_observation_space = remote.observation_space
        self.single_action_space = remote.action_space
        self.observation_space = batch_space(remote.observation_space, self.num_envs)
        self.action_space = batch_space(remote.action_space, self.num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in each environment, or as `options["reset_mask"]` selects (see `SyncVectorEnv`)."""
        seeds = [None if one is None else int(one) for one in seed] if isinstance(seed, list | tuple) else seed
        return self._remote.reset(seeds if seeds is None or isinstance(seeds, list) else int(seeds), options)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take a step of each environment. Return observations, rewards, terminated, truncated and the info."""
        results = self._remote.steps(arrays.STEP, 1, self._rows(actions))
        return *results[:4], results.infos[0][1] if results.infos else {}

    def step_many(self, actions: Any) -> Columns:
        """Take a step of each environment for each element of `actions`, with one message.

        Return observations, rewards, terminated and truncated with the steps as the first axis, and a list of infos.
        """
        rows = [row for one in actions for row in self._rows(one)]
        results = self._remote.steps(arrays.STEP_MANY, len(actions), rows)
        taken = len(results.rewards) // self.num_envs
        rewards, terminated, truncated = (column.reshape(taken, self.num_envs) for column in results[1:4])
        observations = _by_step(self.single_observation_space, results.observations, taken, self.num_envs)
        return observations, rewards, terminated, truncated, _infos(results.infos, taken)

    def render(self) -> tuple[Any, ...] | None:
        """Return a picture of each environment."""
        pictures = self._remote.render()
        return None if pictures is None else tuple(pictures)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close_extras(self, **_: Any) -> None:
        """Close the environments and the connection."""
        if hasattr(self, "_remote"):
            self._remote.close()

    def _rows(self, actions: Any) -> Any:
        space = self.action_space
        if isinstance(actions, np.ndarray) and actions.dtype == space.dtype and actions.shape == space.shape:
            return list(actions)
        return list(iterate(space, actions))


def _infos(pairs: arrays.Infos, steps: int) -> list[dict[str, Any]]:
    """Return an info for every step; {} for those without one."""
    infos: list[dict[str, Any]] = [{} for _ in range(steps)]
    for step, info in pairs:
        infos[step] = info
    return infos


def _by_step(space: Any, batch: Any, steps: int, num_envs: int) -> Any:
    """Return the rows of several steps as a batch: its first axis is for steps, its second for environments."""
    if isinstance(space, Dict):
        return {key: _by_step(part, batch[key], steps, num_envs) for key, part in space.spaces.items()}
    if isinstance(space, Tuple):
        parts = zip(space.spaces, batch, strict=True)
        return tuple(_by_step(part, column, steps, num_envs) for part, column in parts)
    if isinstance(batch, np.ndarray):
        return batch.reshape(steps, num_envs, *batch.shape[1:])
    return tuple(batch[first : first + num_envs] for first in range(0, len(batch), num_envs))


def _refuse_window(render_mode: str | None) -> None:
    if render_mode == "human":
        raise ValueError(
            'A server has no window; use render_mode="rgb_array", and gymnasium.wrappers.HumanRendering around it.'
        )
