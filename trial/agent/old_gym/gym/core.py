"""Gym's base classes with its old interface, and the two adapters between it and Gymnasium's."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import gymnasium

from gym.utils import seeding

_OWN_ATTRIBUTE = "env"  # the one missing attribute that a wrapper does not look up in its environment


class Env(gymnasium.Env[Any, Any]):
    """The base class of an environment. `reset` returns the observation, `step` four values."""

    metadata: dict[str, Any] = {"render.modes": []}  # noqa: RUF012 - as Gym and Gymnasium have it
    reward_range = (-math.inf, math.inf)

    def seed(self, seed: Any = None) -> Any:
        """Seed `np_random`. Return a list with the seed."""
        self.np_random, used = seeding.np_random(seed)
        return [used]

    def reset(self, **kwargs: Any) -> Any:
        """Begin an episode. If there is a `seed`, as in later versions of Gym, seed `np_random` first."""
        if kwargs.get("seed") is not None:
            self.seed(kwargs["seed"])

    def step(self, action: Any) -> Any:
        """Take a step. Return the observation, the reward, whether the episode is done, and the info."""
        raise NotImplementedError

    def render(self, mode: str = "human") -> Any:
        """Draw. With the mode rgb_array, return the picture."""
        raise NotImplementedError

    def compute_reward(self, *arguments: Any) -> Any:
        """Return the reward for an achieved and a desired goal, if the environment is a GoalEnv."""
        raise NotImplementedError


GoalEnv = Env


class Wrapper(Env):
    """Wraps another environment, and has its attributes, too. `reset` and `step` return that environment's results."""

    def __init__(self, env: Any, new_step_api: bool = False) -> None:
        self.env = env
        self.metadata = getattr(env, "metadata", {})
        self.reward_range = getattr(env, "reward_range", Env.reward_range)
        self.spec = getattr(env, "spec", None)
        self.render_mode = getattr(env, "render_mode", None)

    def __getattr__(self, name: str) -> Any:
        if name == _OWN_ATTRIBUTE or name.startswith("__"):
            raise AttributeError(name)
        if isinstance(self.env, gymnasium.Env) and not isinstance(self.env, Env):
            return self.env.get_wrapper_attr(name)
        return getattr(self.env, name)

    @property
    def unwrapped(self) -> Any:
        """The innermost environment."""
        return self.env.unwrapped

    @property
    def np_random(self) -> Any:
        """The environment's generator of random numbers."""
        return self.env.np_random

    @np_random.setter
    def np_random(self, value: Any) -> None:
        self.env.np_random = value

    @classmethod
    def class_name(cls) -> str:
        """Return the name of the class."""
        return cls.__name__

    def seed(self, seed: Any = None) -> Any:
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

    def __str__(self) -> str:
        return f"<{type(self).__name__}{self.env}>"

    __repr__ = __str__


class ObservationWrapper(Wrapper):
    """Changes observations, by the method `observation`."""

    def reset(self, **kwargs: Any) -> Any:
        """Begin an episode."""
        result = self.env.reset(**kwargs)
        return (self.observation(result[0]), result[1]) if with_info(result) else self.observation(result)

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

    def reverse_action(self, action: Any) -> Any:
        """Return the action from which `action` made this one. Subclasses may define it."""
        raise NotImplementedError


def with_info(result: Any) -> bool:
    """Whether this result of `reset` is a pair of observation and info."""
    return isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)


class FromGymnasium(Env):
    """Gives Gymnasium's environment Gym's old interface. Its other attributes can be read and set here, too."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        own = self.__dict__
        own["inner"], own["base"], own["next_seed"] = env, env.unwrapped, None
        own["metadata"] = {**env.metadata, "render.modes": env.metadata.get("render_modes", [])}
        own["spec"], own["render_mode"] = env.spec, env.render_mode

    def __getattr__(self, name: str) -> Any:
        if name in ("inner", "base") or name.startswith("__"):
            raise AttributeError(name)
        return self.inner.get_wrapper_attr(name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self.__dict__ and hasattr(self.base, name):
            setattr(self.base, name, value)
        else:
            super().__setattr__(name, value)

    @property
    def unwrapped(self) -> Any:
        """The innermost environment that has the old interface."""
        return self.base.old.unwrapped if isinstance(self.base, ToGymnasium) else self

    @property
    def np_random(self) -> Any:
        """The environment's generator of random numbers."""
        return self.base.np_random

    @np_random.setter
    def np_random(self, value: Any) -> None:
        self.base.np_random = value

    def seed(self, seed: Any = None) -> Any:
        """Let the next `reset` use this seed, or a random one if it is None. Return a list with the seed."""
        _, used = seeding.np_random(seed)
        self.__dict__["next_seed"] = used % 2**31 if seed is None else used
        return [self.next_seed]

    def reset(self, **kwargs: Any) -> Any:
        """Begin an episode. Return the observation, or with `return_info` the observation and the info."""
        seed, self.__dict__["next_seed"] = self.next_seed, None
        if kwargs.get("seed") is not None:
            seed = int(kwargs["seed"])
        observation, info = self.inner.reset(seed=seed, options=kwargs.get("options"))
        return (observation, info) if kwargs.get("return_info") else observation

    def step(self, action: Any) -> Any:
        """Take a step. Return the observation, the reward, whether the episode is done, and the info."""
        observation, reward, terminated, truncated, info = self.inner.step(action)
        if truncated:
            info = {**info, "TimeLimit.truncated": not terminated}
        return observation, reward, bool(terminated or truncated), info

    def render(self, mode: str = "human", **kwargs: Any) -> Any:
        """Return the picture, also for the mode human: a server has no screen. Other modes are as in Gymnasium."""
        if mode in ("human", "rgb_array", self.base.render_mode):
            return self.inner.render()
        before = self.base.render_mode
        self.base.render_mode = mode
        try:
            return self.base.render()
        finally:
            self.base.render_mode = before

    def close(self) -> None:
        """Close the environment."""
        with contextlib.suppress(AttributeError):  # Python may have cleared it already, at its exit
            self.inner.close()

    def __str__(self) -> str:
        return str(self.inner)

    __repr__ = __str__


class ToGymnasium(gymnasium.Env[Any, Any]):
    """Gives an environment with Gym's old interface that of Gymnasium, for Gymnasium's wrappers."""

    def __init__(self, old: Any) -> None:
        self.old = old
        self.action_space, self.observation_space = old.action_space, old.observation_space
        self.metadata = {**getattr(old, "metadata", {}), "render_modes": ["rgb_array"]}
        self.render_mode, self.spec = "rgb_array", None

    def __getattr__(self, name: str) -> Any:
        if name == "old" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.old, name)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        if seed is not None:
            self.old.seed(seed)
        result = self.old.reset()
        return result if with_info(result) else (result, {})

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        result = self.old.step(action)
        if len(result) == 5:
            return result  # type: ignore[no-any-return]
        observation, reward, done, info = result
        truncated = bool(done and info.get("TimeLimit.truncated"))
        return observation, reward, bool(done and not truncated), truncated, info

    def render(self) -> Any:
        """Return the picture."""
        return self.old.render(mode="rgb_array")

    def close(self) -> None:
        """Close the environment."""
        self.old.close()
