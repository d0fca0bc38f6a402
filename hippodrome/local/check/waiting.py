"""Waits for the process of a tried agent, and notices a call that takes long, or that the user interrupts."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from subprocess import Popen, TimeoutExpired
from typing import Any

TELLS = signal.SIGUSR2
"""The signal at which an agent's process writes down in which line each thread is."""
LONG = 5.0
"""Seconds after which a call is said to take long."""
_LOOK_SECONDS = 0.5
_STACK_SECONDS = 1.0


def wait(process: Popen[Any], seconds: float, report: Path, long: Callable[[], None]) -> int | None:
    """Return the exit status of the process; None if it still runs after `seconds`.

    `long` is called for each call that takes long. At a KeyboardInterrupt, which is raised again, the process first
    writes its stack beside the report.
    """
    until = time.monotonic() + seconds
    said: float | None = None
    try:
        while True:
            left = until - time.monotonic()
            with contextlib.suppress(TimeoutExpired):
                return process.wait(max(0.01, min(_LOOK_SECONDS, left)))
            if left <= _LOOK_SECONDS:
                return None
            began = _began(report)
            if began is not None and began != said and time.time() - began >= LONG:
                said = began
                long()
    except KeyboardInterrupt:
        if _began(report) is not None:
            _ask_for_stack(process, report.with_suffix(".stack"))
        raise


def call_seconds(report: Path) -> float:
    """Return the seconds since the last call began; 0 if none has begun."""
    began = _began(report)
    return 0.0 if began is None else time.time() - began


def _began(report: Path) -> float | None:
    """The time at which the last call began, since a line is added to the report before each; None without any."""
    try:
        return report.stat().st_mtime
    except OSError:
        return None


def _ask_for_stack(process: Popen[Any], stack: Path) -> None:
    """Let the process write its stack, and wait until all of it is there."""
    with contextlib.suppress(OSError):
        os.kill(process.pid, TELLS)
        until, size = time.monotonic() + _STACK_SECONDS, 0
        while time.monotonic() < until and not (size and size == stack.stat().st_size):
            size = stack.stat().st_size
            time.sleep(0.1)
