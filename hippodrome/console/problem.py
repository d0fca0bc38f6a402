"""Problems that a command reports without a traceback, and the exit codes of commands."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum


class Exit(IntEnum):
    """Exit codes."""

    DONE = 0
    FAILED = 1  # a Problem, which was printed
    MISUSE = 2  # the command line has a mistake, or does not say which of two things is meant
    CHANGES = 3  # `deploy --plan` and `--dry-run`: there are changes to make
    DECLINED = 4  # the answer to a question was no; nothing was changed
    INTERRUPTED = 130  # Ctrl-C; the next run continues


class Problem(Exception):
    """A command cannot do its work. `str()` is a sentence that says why; `advice` says what to do.

    `details` are lines that are printed between both; `commands` follow the advice, each on a line, to be copied.
    """

    def __init__(
        self,
        message: str,
        advice: str = "",
        details: Sequence[str] = (),
        exit_code: Exit = Exit.FAILED,
        commands: Sequence[str] = (),
    ) -> None:
        super().__init__(message)
        self.advice = advice
        self.details = tuple(details)
        self.exit_code = exit_code
        self.commands = tuple(commands)
