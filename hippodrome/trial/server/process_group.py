"""Runs a process in a process group of its own, for commands that try a researcher's code."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator, Sequence
from subprocess import DEVNULL, Popen, TimeoutExpired
from typing import Any


def run(command: Sequence[str], seconds: float, **options: Any) -> int | None:
    """Run the command, and return its exit status; None if it had to be killed after `seconds`.

    All processes of its group end with it. `options` are those of `subprocess.Popen`. Raises OSError if it cannot be
    started.
    """
    with started(command, **options) as process:
        try:
            return process.wait(seconds)
        except TimeoutExpired:
            return None


@contextlib.contextmanager
def started(command: Sequence[str], **options: Any) -> Iterator[Popen[Any]]:
    """Start the command, as `run` does. All processes of its group end with the block."""
    process = Popen(  # noqa: S603 - our own commands
        command, stdin=DEVNULL, start_new_session=True, **options
    )
    try:
        yield process
    finally:
        with contextlib.suppress(OSError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
