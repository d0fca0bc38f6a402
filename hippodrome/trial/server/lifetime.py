"""Ends the server: when it is asked to, when no participant has been connected for long, and at its deadline."""

from __future__ import annotations

import asyncio
import math
import os
import sys
import threading
import time
from collections.abc import Callable

from hippodrome.trial.settings import TrialSettings

_LOOK_AGAIN_SECONDS = 5.0  # the pause before the next look at an idle server that still stores something


class Watchdog:
    """Counts the time without a participant, and says when the server must end. Pure; the clock is passed in.

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


class Lifetime:
    """Decides when the server ends, and why. `saving` returns whether the server still has something to store."""

    def __init__(self, settings: TrialSettings, saving: Callable[[], bool]) -> None:
        self._loop = asyncio.get_running_loop()
        self._saving = saving
        self._ended: asyncio.Future[str] = self._loop.create_future()
        self._timer: asyncio.TimerHandle | None = None
        # The deadline is a time of the system's clock. The watchdog's times are those of the loop's monotonic clock.
        deadline = None if settings.deadline is None else self._loop.time() + settings.deadline - time.time()
        self._watchdog = Watchdog(
            now=self._loop.time() if settings.assigned else None,
            idle=settings.idle_seconds,
            grace=settings.grace_seconds,
            deadline=deadline,
        )

    def end(self, reason: str) -> None:
        """End the server. If it is called several times, the first reason counts."""
        if not self._ended.done():
            self._ended.set_result(reason)

    def end_in(self, seconds: float, reason: str) -> None:
        """End the server after `seconds`."""
        self._loop.call_later(seconds, self.end, reason)

    async def over(self) -> str:
        """Wait until the server is to end, and return the reason."""
        reason = await self._ended
        if self._timer is not None:
            self._timer.cancel()
        return reason

    def wait_for_participant(self) -> None:
        """Begin to wait for a participant, who has not come yet or has left."""
        self._watchdog.wait(self._loop.time())
        self.watch()

    def connected(self) -> None:
        """Note that a participant is connected."""
        self._watchdog.came()
        self.watch()

    def watch(self) -> None:
        """End the server if the watchdog says so; else call this again when its verdict may change."""
        now = self._loop.time()
        if self._timer is not None:
            self._timer.cancel()
        verdict = self._watchdog.verdict(now)
        if verdict == "deadline" or (verdict == "idle" and not self._saving()):
            self.end(verdict)
            return
        expires = self._watchdog.expires() if verdict is None else now + _LOOK_AGAIN_SECONDS
        if expires < math.inf:
            self._timer = self._loop.call_at(expires + 0.01, self.watch)


def exit_hard_after(seconds: float) -> None:
    """End the process after `seconds`, even if threads still run."""

    def end() -> None:
        print("trial: the process is ended although threads still run", file=sys.stderr, flush=True)
        os._exit(1)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
