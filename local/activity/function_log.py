"""What the functions log: a line of the terminal for each warning and error, and all of it in a file."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TextIO

from hippodrome.log import logger
from local.activity.log import ActivityLog

_REFUSALS = {"OSError", *(kind.__name__ for kind in OSError.__subclasses__())} - {"ConnectionError", "TimeoutError"}
_TOLD = ("server closed", "the project is full")  # the server's record says the same, with its participant


class Complaints(logging.Handler):
    """Shows what the functions log as warnings and errors, in a line each; all of it is in their log."""

    def __init__(self, activity_log: ActivityLog) -> None:
        super().__init__(logging.WARNING)
        self._activity_log = activity_log

    def emit(self, record: logging.LogRecord) -> None:
        types = getattr(record, "error", ())
        if any(name in _REFUSALS for name in types):
            return  # it has been told in one sentence what this machine refuses
        if record.getMessage() in _TOLD:
            return
        self._activity_log.warn(complaint(record.getMessage(), vars(record)))


def complaint(message: str, fields: Mapping[str, object]) -> str:
    """What a function logged, in a line."""
    told = [f"{key} {_plain(fields[key])}" for key in ("file", "line", "server", "error", "where") if key in fields]
    return f"{message} ({', '.join(told)})" if told else message


def _plain(value: object) -> str:
    return " < ".join(map(str, value)) if isinstance(value, list) else str(value)


@contextlib.contextmanager
def function_log(logs: Path, activity_log: ActivityLog) -> Iterator[None]:
    """What the functions log goes to a file instead of the terminal, which gets their complaints in words."""
    logs.mkdir(parents=True, exist_ok=True)
    handler = logger.registered_handler
    complaints = Complaints(activity_log)
    with (logs / "functions.log").open("a") as file:
        log = _Log(file)
        assert isinstance(handler, logging.StreamHandler)
        before = handler.setStream(log)
        logging.getLogger(logger.name).addHandler(complaints)
        try:
            yield
        finally:
            logging.getLogger(logger.name).removeHandler(complaints)
            handler.setStream(before)


class _Log:
    """A log file that is left incomplete when the disk is full, which the terminal has said already."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, text: str) -> None:
        with contextlib.suppress(OSError):
            self._file.write(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._file.flush()
