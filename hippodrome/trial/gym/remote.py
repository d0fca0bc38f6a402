"""`RemoteEnv`: an environment that runs on a server, with Gymnasium's interface (docs/gym.md)."""

from __future__ import annotations

import weakref
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from hippodrome.trial.gym import spaces, values
from hippodrome.trial.gym.client import TIMEOUT, GymClient

Columns = tuple[Any, Any, Any, Any, list[dict[str, Any]]]


class RemoteEnv(gymnasium.Env[Any, Any]):
    """An environment that runs on a server: `RemoteEnv("ws://127.0.0.1:5000/", "CartPole-v1")`.

    It has a connection of its own, which ends with `close`, with a `with` block, or when the object is no longer used.
    `render_mode` and `options` are those of `gymnasium.make`. `timeout` is in seconds, for connecting and for each
    answer. `ca` is a file of certificates to trust (PEM), for `wss://`. `np_random` is a generator of the client: the
    environment draws its random numbers on the server, by the seed of `reset`.

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
        ca: str | None = None,
        timeout: float = TIMEOUT,
        **options: Any,
    ) -> None:
        if render_mode == "human":
            raise ValueError(
                'A server has no window; use render_mode="rgb_array", and gymnasium.wrappers.HumanRendering around it.'
            )
        params = options if render_mode is None else options | {"render_mode": render_mode}
        self._client = client = GymClient(url, ca=ca, timeout=timeout)
        self._closer = weakref.finalize(self, client.close)
        try:
            facts = client.call("make", env_id=env_id, **params)
            try:
                self._id = facts["instance_id"]
                self.observation_space = spaces.build(facts["observation_space"])
                self.action_space = spaces.build(facts["action_space"])
                self.render_mode = facts["render_mode"]
                # The mode human would open a window on the server.
                modes = [mode for mode in facts["metadata"].get("render_modes") or [] if mode != "human"]
                self.metadata = {**facts["metadata"], "render_modes": modes}
                kwargs = {"url": url, "env_id": env_id, "ca": ca, "timeout": timeout, **params}
                self.spec = EnvSpec(env_id, entry_point="hippodrome.gym:RemoteEnv", kwargs=kwargs, **facts["spec"])
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                client.unfit(error)
        except BaseException:
            self._closer()
            raise

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode. Return its first observation and info."""
        super().reset(seed=seed)
        observation, info = self._call("reset", seed=seed if seed is None else int(seed), options=options)
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one step. Raises CodecError if `action` does not have the shape and kind of the action space."""
        observation, reward, terminated, truncated, info = self._call(
            "step", action=values.read(self.action_space, action)
        )
        return observation, reward, terminated, truncated, info

    def step_many(self, actions: Any) -> Columns:
        """Take a step for each action, with one message. Return observations, rewards, terminated, truncated, infos.

        `actions` is a list of actions, or an array of them. The observations are one batch, in the form of Gymnasium's
        vector environments, and the infos a list. After an episode the next one begins, as in Gymnasium's vector
        environments. By default (`autoreset_mode="NextStep"`) the step after the end does not use its action: it resets
        the environment, and its reward is 0. With `"SameStep"`, the last step of an episode has the next episode's
        first observation, and `final_obs` and `final_info` in its info. With `"Disabled"`, no further step is taken, so
        there are fewer results than actions. `autoreset_mode` is an option of the constructor.
        """
        space = self.action_space
        if not (isinstance(actions, np.ndarray) and actions.dtype == space.dtype and actions.shape[1:] == space.shape):
            actions = [values.read(space, action) for action in actions]
        return tuple(self._call("step_many", actions=actions))

    def render(self) -> Any:
        """Return what the environment's `render` returns. Pictures come without loss."""
        return self._call("render")

    def close(self) -> None:
        """Close the environment and the connection. May be called again."""
        if hasattr(self, "_closer"):
            self._closer()

    def _call(self, method: str, **params: Any) -> Any:
        return self._client.call(method, instance_id=self._id, **params)
