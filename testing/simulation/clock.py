"""Virtual time. Plain synchronous code runs in greenlets; whoever waits lets the others run, as the clock says."""

from __future__ import annotations

import heapq
import itertools
import math
import random
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, TypeVar

import greenlet

T = TypeVar("T")


class Crash(BaseException):
    """The function is gone, between two of its lines. Nothing catches it."""


EPOCH = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)


class Clock:
    """Virtual seconds since the beginning, and what is due when. `random` is the only source of chance."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.random = random.Random(seed)
        self.seconds = 0.0
        self.resumed: Callable[[object], None] | None = None  # called with the owner of what runs next
        self.ends: Callable[[object], float] | None = None  # until which second an owner may run: its timeout
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._numbers = itertools.count()
        self._hub: greenlet.greenlet | None = None

    def now(self) -> datetime:
        """The virtual time as the platform tells it."""
        return EPOCH + timedelta(seconds=self.seconds)

    def after(self, seconds: float, act: Callable[[], object]) -> None:
        """Call `act` when that many seconds have passed. It must not wait; for what does there is `spawn`."""
        heapq.heappush(self._due, (self.seconds + max(seconds, 0.0), next(self._numbers), act))

    def spawn(self, act: Callable[[], object], delay: float = 0.0, owner: object = None) -> None:
        """Run `act` in a greenlet of its own, which may `sleep`."""

        def begin() -> None:
            made = greenlet.greenlet(act)
            made.owner = owner
            self._resume(made)

        self.after(delay, begin)

    def sleep(self, seconds: float) -> None:
        """Let that much time pass. Only within `spawn`. Raises `Crash` at the second at which the caller times out."""
        me: Any = greenlet.getcurrent()
        assert self._hub is not None
        assert me is not self._hub, "only what was spawned can wait"
        end = self.ends(getattr(me, "owner", None)) if self.ends else math.inf
        late = self.seconds + seconds > end
        self.after(min(seconds, end - self.seconds), lambda: self._resume(me))
        self._hub.switch()
        if late:
            raise Crash("timed out")

    def together(self, acts: Sequence[Callable[[], T]], at_once: int = 16) -> list[T]:
        """The results of all acts, of which that many run at the same time. What ends one of them ends all."""
        if len(acts) < 2:
            return [act() for act in acts]
        me: Any = greenlet.getcurrent()
        owner, results, left = getattr(me, "owner", None), dict[int, T](), iter(enumerate(acts))
        working, broken = min(at_once, len(acts)), list[BaseException]()

        def work() -> None:
            nonlocal working
            try:
                for number, act in left:
                    if broken:
                        break
                    results[number] = act()
            except BaseException as error:  # noqa: BLE001 - a crash ends the function, wherever it happens
                broken.append(error)
            working -= 1
            if not working:
                self.after(0, lambda: self._resume(me))

        for _ in range(working):
            self.spawn(work, owner=owner)
        assert self._hub is not None
        self._hub.switch()
        if broken:
            raise broken[0]
        return [results[number] for number in range(len(acts))]

    def run(self, until: float) -> None:
        """Let things happen until then, or until nothing is due any more."""
        self._hub = greenlet.getcurrent()
        while self._due and self._due[0][0] <= until:
            self.seconds, _, act = heapq.heappop(self._due)
            act()
        self.seconds = max(self.seconds, until)

    @property
    def idle(self) -> bool:
        """Whether nothing is due."""
        return not self._due

    def _resume(self, what: greenlet.greenlet) -> None:
        if self.resumed:
            self.resumed(getattr(what, "owner", None))
        what.switch()
