"""The built-in game `talk`: participants only talk. Its steps count the time, one a second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


class TalkGame:
    """An environment with one action and a picture of one pixel. With `players`, it has several."""

    def __init__(self, players: Sequence[str] = ()) -> None:
        self.possible_agents = list(players) if len(players) > 1 else []
        self._end: tuple[Any, bool] | None = None

    def end(self, reward: float | Mapping[str, float] = 0.0, *, success: bool = False) -> None:
        """End the episode within a second, such as when people have agreed. For any thread.

        `reward` is added to the score: a number, or with several players one for each by name. `success` counts for
        `trial.until`.
        """
        self._end = reward, bool(success)

    def get_action_meanings(self) -> list[str]:
        """Return the name of its action."""
        return ["noop"]

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, Any]:
        """Begin an episode."""
        self._end = None
        return self._for_each(0), self._for_each({})

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """Let a second pass."""
        reward, success = self._end or (0.0, False)
        over = self._end is not None
        if isinstance(reward, Mapping) and self.possible_agents:
            rewards: Any = {player: float(reward.get(player, 0.0)) for player in self.possible_agents}
        elif isinstance(reward, Mapping):
            rewards = float(sum(reward.values()))
        else:
            rewards = self._for_each(float(reward))
        info = {"success": True} if success else {}
        return self._for_each(0), rewards, self._for_each(over), self._for_each(False), self._for_each(info)

    def render(self) -> Any:
        """Return a picture of one pixel."""
        return np.zeros((1, 1, 3), np.uint8)

    def close(self) -> None:
        """Do nothing."""

    def _for_each(self, value: Any) -> Any:
        return dict.fromkeys(self.possible_agents, value) if self.possible_agents else value
