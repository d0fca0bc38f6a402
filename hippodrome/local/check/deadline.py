"""The end of the process of a tried agent (`agent_process.py`) whose time is over, and the line in which it was."""

from __future__ import annotations

import faulthandler
import math
import time
from typing import IO

from hippodrome.trial.agent import match


class Deadline:
    """Ends the process when the time is over, and writes to `stack` in which line each thread was."""

    def __init__(self, stack: IO[str], seconds: float, call_seconds: float) -> None:
        """`seconds` are for all calls together, `call_seconds` for each that a server limits, too."""
        self._stack, self._at = stack, time.monotonic() + seconds
        self._limits = {"match": match.SECONDS, **dict.fromkeys(("reset", "step", "render"), call_seconds)}
        self._end_after(seconds)

    def begin(self, call: str) -> float | None:
        """Let the time of a call begin, and return its seconds; None if it may take all the time that is left."""
        seconds_left = max(0.001, self._at - time.monotonic())  # faulthandler refuses 0
        limit = self._limits.get(call, math.inf)
        self._end_after(min(limit, seconds_left))
        return limit if limit < seconds_left else None

    def _end_after(self, seconds: float) -> None:
        faulthandler.dump_traceback_later(seconds, exit=True, file=self._stack)
