"""Gym's wrapper TimeLimit, which ends an episode after a number of steps."""

from __future__ import annotations

from typing import Any

from gym.core import Wrapper


class TimeLimit(Wrapper):
    """Ends an episode after `max_episode_steps`.

    With four values, `TimeLimit.truncated` in the info then says whether the wrapper ended the episode; with five
    values, `truncated` is True.
    """

    def __init__(self, env: Any, max_episode_steps: int | None = None, new_step_api: bool = False) -> None:
        super().__init__(env)
        self._max_episode_steps = env.spec.max_episode_steps if max_episode_steps is None else max_episode_steps
        self._elapsed_steps = 0

    def reset(self, **kwargs: Any) -> Any:
        """Begin an episode."""
        self._elapsed_steps = 0
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> Any:
        """Take a step."""
        result = self.env.step(action)
        self._elapsed_steps += 1
        if self._max_episode_steps is None or self._elapsed_steps < self._max_episode_steps:
            return result
        if len(result) == 5:
            observation, reward, terminated, _, info = result
            return observation, reward, terminated, True, info
        observation, reward, done, info = result
        return observation, reward, True, {**info, "TimeLimit.truncated": not done}
