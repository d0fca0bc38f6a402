"""The built-in game `talk`: participants only talk. Its steps count the time, one a second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


class TalkGame:
    """An environment in which nothing happens: one action, a picture of one pixel. With `players`, it has several."""

    def __init__(self, players: Sequence[str] = ()) -> None:
        self.possible_agents = list(players) if len(players) > 1 else []

    def get_action_meanings(self) -> list[str]:
        """Return the name of its action."""
        return ["noop"]

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, Any]:
        """Begin an episode."""
        return self._each(0), self._each({})

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """Let a second pass."""
        return self._each(0), self._each(0.0), self._each(False), self._each(False), self._each({})

    def render(self) -> Any:
        """Return a picture of one pixel."""
        return np.zeros((1, 1, 3), np.uint8)

    def close(self) -> None:
        """Do nothing."""

    def _each(self, value: Any) -> Any:
        return dict.fromkeys(self.possible_agents, value) if self.possible_agents else value
