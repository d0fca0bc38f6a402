"""How fast and how long an agent plays: its process measures it, and `hippodrome check` reports it."""

from __future__ import annotations

from dataclasses import dataclass

PLAY_STEPS = 5_000  # the most steps in each group


@dataclass
class Pace:
    """The seconds that an agent's steps have taken, each with its picture.

    The slowest step is kept apart, since it may have loaded something.
    """

    steps: int = 0
    seconds: float = 0.0
    slowest: float = 0.0

    @property
    def usual(self) -> float:
        """The mean seconds of a step, without the slowest one."""
        return (self.seconds - self.slowest) / (self.steps - 1) if self.steps > 1 else self.seconds

    def took(self, seconds: float) -> None:
        """Count one more step, which took so many seconds."""
        self.steps += 1
        self.seconds += seconds
        self.slowest = max(self.slowest, seconds)
