"""What is told instead of a traceback: what happened, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum


class Exit(IntEnum):
    """What the exit codes mean. 2 is typer's own: the command was not written rightly."""

    DONE = 0
    FAILED = 1  # something is in the way; the text says what
    CHANGES = 3  # `plan` and `--dry-run`: there is something to do
    DECLINED = 4  # a question was answered with no; nothing was changed
    INTERRUPTED = 130  # Ctrl-C; the next run goes on from there


class Problem(Exception):
    """Something is in the way. `str()` says what, in a sentence; `advice` what to do; `details` are lines between."""

    def __init__(self, what: str, advice: str = "", details: Sequence[str] = (), exit_code: Exit = Exit.FAILED) -> None:
        super().__init__(what)
        self.advice = advice
        self.details = tuple(details)
        self.exit_code = exit_code
