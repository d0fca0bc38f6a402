"""When the server ends: when it is asked to, when no participant is connected for long, and at its deadline."""

from __future__ import annotations

import asyncio
import os
import sys
import threading
import time
from collections.abc import Callable

from trial.server.watchdog import Watchdog
from trial.settings import TrialSettings

_LOOK_AGAIN_SECONDS = 5.0
_LONGEST_TIMER = 86400.0  # the event loop refuses an infinite time


class Lifetime:
    """Ends the server once, with a reason. `saving` tells whether an idle server has still something to store."""

    def __init__(self, settings: TrialSettings, saving: Callable[[], bool]) -> None:
        self._loop = asyncio.get_running_loop()
        self._saving = saving
        self._ended: asyncio.Future[str] = self._loop.create_future()
        self._timer: asyncio.TimerHandle | None = None
        # The clock of the deadline is the wall's; everything else counts seconds of the loop's clock.
        deadline = None if settings.deadline is None else self._loop.time() + settings.deadline - time.time()
        self._watchdog = Watchdog(
            now=self._loop.time() if settings.assigned else None,
            idle=settings.idle_seconds,
            grace=settings.grace_seconds,
            deadline=deadline,
        )

    def end(self, reason: str) -> None:
        """End the server. The first reason counts."""
        if not self._ended.done():
            self._ended.set_result(reason)

    def end_in(self, seconds: float, reason: str) -> None:
        """End the server after `seconds`."""
        self._loop.call_later(seconds, self.end, reason)

    async def over(self) -> str:
        """Wait for the end; the reason."""
        reason = await self._ended
        if self._timer is not None:
            self._timer.cancel()
        return reason

    def expect_participant(self) -> None:
        """From now on the server waits for a participant."""
        self._watchdog.expected(self._loop.time())
        self.watch()

    def connected(self) -> None:
        """A participant is connected."""
        self._watchdog.came()
        self.watch()

    def disconnected(self) -> None:
        """No participant is connected any more."""
        self._watchdog.left(self._loop.time())
        self.watch()

    def watch(self) -> None:
        """Look at the watchdog, now and whenever it can have something to say."""
        now = self._loop.time()
        if self._timer is not None:
            self._timer.cancel()
        verdict = self._watchdog.verdict(now)
        if verdict == "deadline" or (verdict == "idle" and not self._saving()):
            self.end(verdict)
            return
        expires = self._watchdog.expires() if verdict is None else now + _LOOK_AGAIN_SECONDS
        if expires < float("inf"):
            self._timer = self._loop.call_at(min(expires + 0.01, now + _LONGEST_TIMER), self.watch)


def exit_hard_after(seconds: float) -> None:
    """End the process after `seconds`, whatever still runs then."""

    def end() -> None:
        print("trial: had to be ended", file=sys.stderr, flush=True)
        os._exit(1)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
