"""Gym's wrapper TimeLimit."""

from __future__ import annotations

from typing import Any

from gym.core import Wrapper


class TimeLimit(Wrapper):
    """Ends an episode after `max_episode_steps`. `TimeLimit.truncated` in the info says whether that ended it."""

    def __init__(self, env: Any, max_episode_steps: int | None = None) -> None:
        super().__init__(env)
        self._max_episode_steps = env.spec.max_episode_steps if max_episode_steps is None else max_episode_steps
        self._elapsed_steps = 0

    def reset(self, **kwargs: Any) -> Any:
        """Begin an episode."""
        self._elapsed_steps = 0
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> Any:
        """Take a step."""
        observation, reward, done, info = self.env.step(action)
        self._elapsed_steps += 1
        if self._elapsed_steps >= self._max_episode_steps:
            return observation, reward, True, {**info, "TimeLimit.truncated": not done}
        return observation, reward, done, info
