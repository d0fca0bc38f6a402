"""Waits for the process of a tried agent, and notices a call that takes long."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from subprocess import Popen, TimeoutExpired
from typing import Any

LONG = 5.0
"""Seconds after which a call is said to take long."""
_LOOK_SECONDS = 0.5


def wait(process: Popen[Any], seconds: float, report: Path, long: Callable[[], None]) -> int | None:
    """Return the exit status of the process; None if it still runs after `seconds`.

    `long` is called for each call that takes long.
    """
    until = time.monotonic() + seconds
    last_said: float | None = None
    while True:
        seconds_left = until - time.monotonic()
        with contextlib.suppress(TimeoutExpired):
            return process.wait(max(0.01, min(_LOOK_SECONDS, seconds_left)))
        if seconds_left <= _LOOK_SECONDS:
            return None
        began = _began(report)
        if began is not None and began != last_said and time.time() - began >= LONG:
            last_said = began
            long()


def _began(report: Path) -> float | None:
    """The time at which the last call began, since a line is added to the report before each; None without any."""
    try:
        return report.stat().st_mtime
    except OSError:
        return None
