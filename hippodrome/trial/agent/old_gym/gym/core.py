"""Gym's base classes with its old interface, and the adapter that gives this interface to Gymnasium's environments."""

from __future__ import annotations

import contextlib
from typing import Any

import gymnasium

from gym.utils import seeding


class Env:
    """The base class of an environment. `reset` returns the observation, `step` four values."""

    metadata: dict[str, Any] = {"render.modes": []}  # noqa: RUF012 - as Gym has it
    spec: Any = None

    @property
    def unwrapped(self) -> Any:
        """The innermost environment."""
        return self

    def seed(self, seed: int | None = None) -> list[int]:
        """Seed `np_random`. Return a list with the seed."""
        self.np_random, used = seeding.np_random(seed)
        return [used]

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode. If there is a `seed`, as in later versions of Gym, seed `np_random` first."""
        if seed is not None:
            self.seed(seed)

    def step(self, action: Any) -> Any:
        """Take a step. Return the observation, the reward, whether the episode is done, and the info."""
        raise NotImplementedError

    def render(self, mode: str = "human") -> Any:
        """Draw. With the mode rgb_array, return the picture."""
        raise NotImplementedError

    def close(self) -> None:
        """Release what the environment holds."""


class Wrapper(Env):
    """Wraps another environment, and has its attributes, too. `reset` and `step` return that environment's results."""

    def __init__(self, env: Any) -> None:
        self.env = env
        self.metadata, self.spec = getattr(env, "metadata", {}), getattr(env, "spec", None)

    def __getattr__(self, name: str) -> Any:
        if name == "env" or name.startswith("__"):  # before __init__, and for copy and pickle
            raise AttributeError(name)
        return getattr(self.env, name)

    @property
    def unwrapped(self) -> Any:
        """The innermost environment."""
        return self.env.unwrapped

    def seed(self, seed: int | None = None) -> Any:
        """Seed the environment."""
        return self.env.seed(seed)

    def reset(self, **kwargs: Any) -> Any:
        """Begin an episode."""
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> Any:
        """Take a step."""
        return self.env.step(action)

    def render(self, *args: Any, **kwargs: Any) -> Any:
        """Draw."""
        return self.env.render(*args, **kwargs)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


class ObservationWrapper(Wrapper):
    """Changes observations, by the method `observation`."""

    def reset(self, **kwargs: Any) -> Any:
        """Begin an episode."""
        return self.observation(self.env.reset(**kwargs))

    def step(self, action: Any) -> Any:
        """Take a step."""
        observation, *rest = self.env.step(action)
        return (self.observation(observation), *rest)

    def observation(self, observation: Any) -> Any:
        """Return the changed observation. Subclasses define it."""
        raise NotImplementedError


class RewardWrapper(Wrapper):
    """Changes rewards, by the method `reward`."""

    def step(self, action: Any) -> Any:
        """Take a step."""
        observation, reward, *rest = self.env.step(action)
        return (observation, self.reward(reward), *rest)

    def reward(self, reward: Any) -> Any:
        """Return the changed reward. Subclasses define it."""
        raise NotImplementedError


class ActionWrapper(Wrapper):
    """Changes actions, by the method `action`."""

    def step(self, action: Any) -> Any:
        """Take a step."""
        return self.env.step(self.action(action))

    def action(self, action: Any) -> Any:
        """Return the action that the environment takes instead. Subclasses define it."""
        raise NotImplementedError


class FromGymnasium(Env):
    """Gives Gymnasium's environment Gym's old interface. Its other attributes can be read and set here, too."""

    inner: gymnasium.Env[Any, Any]
    next_seed: int | None

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        self.__dict__.update(inner=env, next_seed=None, metadata=env.metadata, spec=env.spec)

    def __getattr__(self, name: str) -> Any:
        if name == "inner" or name.startswith("__"):
            raise AttributeError(name)
        return self.inner.get_wrapper_attr(name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self.__dict__ or not self.inner.set_wrapper_attr(name, value, force=False):
            self.__dict__[name] = value

    @property
    def unwrapped(self) -> Any:
        """The innermost environment, with the old interface: no time limit ends its episodes."""
        base = self.inner.unwrapped
        return self if base is self.inner else FromGymnasium(base)

    env = unwrapped

    def seed(self, seed: int | None = None) -> list[int]:
        """Let the next `reset` use this seed, or a random one if it is None. Return a list with the seed."""
        _, used = seeding.np_random(seed)
        self.next_seed = used
        return [used]

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode. Return the observation."""
        seed, self.next_seed = self.next_seed if seed is None else seed, None
        return self.inner.reset(seed=seed, options=options)[0]

    def step(self, action: Any) -> Any:
        """Take a step. Return the observation, the reward, whether the episode is done, and the info."""
        observation, reward, terminated, truncated, info = self.inner.step(action)
        if truncated:
            info = {**info, "TimeLimit.truncated": not terminated}
        return observation, reward, bool(terminated or truncated), info

    def render(self, mode: str = "human") -> Any:
        """Return the picture, in every mode: a server has no screen."""
        return self.inner.render()

    def close(self) -> None:
        """Close the environment."""
        with contextlib.suppress(AttributeError):  # Python may have cleared it already, at its exit
            self.inner.close()
