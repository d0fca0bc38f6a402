"""The functions' log: all of it goes to a file, and the terminal shows its warnings and errors, a line each."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TextIO

from hippodrome.control.log import logger
from hippodrome.local.activity.log import ActivityLog

_OS_ERRORS = {"OSError", *(kind.__name__ for kind in OSError.__subclasses__())} - {"ConnectionError", "TimeoutError"}
_SHOWN_BY_RECORD = ("server closed", "the project is full")  # `ActivityLog` shows these by the server's record


class TerminalHandler(logging.Handler):
    """Shows the warnings and errors of the functions' log in the terminal, a line each."""

    def __init__(self, activity_log: ActivityLog) -> None:
        super().__init__(logging.WARNING)
        self._activity_log = activity_log

    def emit(self, record: logging.LogRecord) -> None:
        types = getattr(record, "error", ())
        if any(name in _OS_ERRORS for name in types):
            return  # `Retry` says in a sentence what this machine refuses
        if record.getMessage() in _SHOWN_BY_RECORD:
            return
        self._activity_log.warn(log_line(record.getMessage(), vars(record)))


def log_line(message: str, fields: Mapping[str, object]) -> str:
    """Return a record of the functions' log as one line: its message, and those `fields` that say where and why."""
    details = [f"{key} {_plain(fields[key])}" for key in ("file", "line", "server", "error", "where") if key in fields]
    return f"{message} ({', '.join(details)})" if details else message


def _plain(value: object) -> str:
    return " < ".join(map(str, value)) if isinstance(value, list) else str(value)


@contextlib.contextmanager
def function_log(logs: Path, activity_log: ActivityLog) -> Iterator[None]:
    """Within the block, the functions log to a file in `logs`; the terminal shows their warnings and errors."""
    logs.mkdir(parents=True, exist_ok=True)
    handler = logger.registered_handler
    terminal = TerminalHandler(activity_log)
    with (logs / "functions.log").open("a") as file:
        log = _Log(file)
        assert isinstance(handler, logging.StreamHandler)
        before = handler.setStream(log)
        logging.getLogger(logger.name).addHandler(terminal)
        try:
            yield
        finally:
            logging.getLogger(logger.name).removeHandler(terminal)
            handler.setStream(before)


class _Log:
    """A log file. On a full disk, lines are lost and nothing is raised: the terminal says that the disk is full."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, text: str) -> None:
        with contextlib.suppress(OSError):
            self._file.write(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._file.flush()
