"""Decides when a server must end because no participant is there, or at its deadline. Pure; the clock is passed in."""

from __future__ import annotations

import math


class Watchdog:
    """Counts the time without a participant, and says when the server must end. All times are seconds of one clock.

    `idle` is how long the server waits for a participant; `grace` is the least time for which it waits for one who was
    connected before; `deadline` is the time at which it ends in any case. The wait begins at `now`; if that is None, at
    the call of `wait`.
    """

    def __init__(self, *, now: float | None, idle: float, grace: float, deadline: float | None) -> None:
        self._idle = idle
        self._grace = grace
        self._deadline = math.inf if deadline is None else deadline
        self._alone_since = now
        self._visited = False

    def wait(self, now: float) -> None:
        """Begin to wait for a participant, who has not come yet or has left."""
        self._alone_since = now

    def came(self) -> None:
        """Note that a participant is connected."""
        self._alone_since = None
        self._visited = True

    def expires(self) -> float:
        """Return the time at which the server must end if nothing else happens; infinity if there is none."""
        if self._alone_since is None:
            return self._deadline
        return min(self._alone_since + max(self._idle, self._grace if self._visited else 0.0), self._deadline)

    def verdict(self, now: float) -> str | None:
        """Return why the server must end now, `deadline` or `idle`; None if it need not."""
        if now >= self._deadline:
            return "deadline"
        return "idle" if now >= self.expires() else None
