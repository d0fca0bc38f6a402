"""One clock for everything that is simulated: seconds pass only from one thing that is due to the next."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

EPOCH = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)


class Clock:
    """Seconds since the beginning, and what is due when. What is due at the same second happens in the order of the calls."""

    def __init__(self, began: datetime = EPOCH) -> None:
        self.seconds = 0.0
        self._began = began
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._numbers = itertools.count()

    def now(self) -> datetime:
        """The time as the platform tells it."""
        return self._began + timedelta(seconds=self.seconds)

    def seconds_at(self, moment: datetime) -> float:
        return (moment - self._began).total_seconds()

    def after(self, seconds: float, act: Callable[[], object]) -> None:
        """Call `act` when that many seconds have passed."""
        heapq.heappush(self._due, (self.seconds + max(seconds, 0.0), next(self._numbers), act))

    def next(self) -> float:
        """The second of the next thing that is due; infinite if nothing is."""
        return self._due[0][0] if self._due else math.inf

    def step(self) -> None:
        """Go to the next thing that is due and do it."""
        self.seconds, _, act = heapq.heappop(self._due)
        act()

    def forget(self) -> None:
        """Nothing is due any more."""
        self._due.clear()

    @property
    def idle(self) -> bool:
        """Whether nothing is due."""
        return not self._due
