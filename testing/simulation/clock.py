"""A clock on which synchronous code may wait: it runs in greenlets, and while one greenlet waits, others run."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import greenlet

from testing.clock import Clock
from testing.port_faults import Crash

T = TypeVar("T")


class GreenletClock(Clock):
    """A clock on which code may wait. `random` is the source of random numbers, from the seed."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.seed = seed
        self.random = random.Random(seed)
        self.resumed: Callable[[object], None] | None = None  # called with the owner of the greenlet that runs next
        self.ends: Callable[[object], float] | None = None  # gives the second at which an owner times out
        self._hub: greenlet.greenlet | None = None

    def spawn(self, act: Callable[[], object], delay: float = 0.0, owner: object = None) -> None:
        """Run `act` in a greenlet of its own after `delay` seconds. In it, `act` may `sleep`."""

        def begin() -> None:
            made = greenlet.greenlet(act)
            made.owner = owner
            self._resume(made)

        self.after(delay, begin)

    def sleep(self, seconds: float) -> None:
        """Let so many seconds pass, only in spawned code. Raises Crash at the second at which the owner times out."""
        me: Any = greenlet.getcurrent()
        assert self._hub is not None
        assert me is not self._hub, "only spawned code can wait"
        end = self.ends(getattr(me, "owner", None)) if self.ends else math.inf
        late = self.seconds + seconds > end
        self.after(min(seconds, end - self.seconds), lambda: self._resume(me))
        self._hub.switch()
        if late:
            raise Crash("timed out")

    def together(self, acts: Sequence[Callable[[], T]], at_once: int = 16) -> list[T]:
        """Run all acts, so many at the same time; return their results in order. Raises the first exception of an act."""
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
        """Make all calls that are due until this second, and then go to it."""
        self._hub = greenlet.getcurrent()
        while self.next() <= until:
            self.step()
        self.seconds = max(self.seconds, until)

    def _resume(self, waiting: greenlet.greenlet) -> None:
        if self.resumed:
            self.resumed(getattr(waiting, "owner", None))
        waiting.switch()
