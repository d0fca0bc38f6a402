"""How fast an agent plays: what its process reports, and `make check` reads."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Pace:
    """How long steps have taken, each with its picture; the slowest one apart, which may have had something to load."""

    steps: int = 0
    seconds: float = 0.0
    slowest: float = 0.0

    @property
    def usual(self) -> float:
        """Seconds of a step on average, without the slowest one."""
        return (self.seconds - self.slowest) / (self.steps - 1) if self.steps > 1 else self.seconds

    def took(self, seconds: float) -> None:
        """Count one more step, which took so many seconds."""
        self.steps += 1
        self.seconds += seconds
        self.slowest = max(self.slowest, seconds)
