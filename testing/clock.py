"""The clock of all simulations: it goes from one call that is due to the next, and no real time passes."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

EPOCH = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)


class Clock:
    """Keeps the seconds since the beginning, and makes calls that are due; equally due calls in the order of `after`."""

    def __init__(self, began: datetime = EPOCH) -> None:
        self.seconds = 0.0
        self._began = began
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._numbers = itertools.count()

    def now(self) -> datetime:
        """Return the date and time, as a platform's `now` does."""
        return self._began + timedelta(seconds=self.seconds)

    def after(self, seconds: float, act: Callable[[], object]) -> None:
        """Call `act` when that many seconds have passed."""
        heapq.heappush(self._due, (self.seconds + max(seconds, 0.0), next(self._numbers), act))

    def next(self) -> float:
        """Return the second of the next call that is due; infinity if none is."""
        return self._due[0][0] if self._due else math.inf

    def step(self) -> None:
        """Go to the next call that is due, and make it."""
        self.seconds, _, act = heapq.heappop(self._due)
        act()

    def forget(self) -> None:
        """Drop all calls that were to be made."""
        self._due.clear()

    @property
    def idle(self) -> bool:
        """Whether no call is due."""
        return not self._due
