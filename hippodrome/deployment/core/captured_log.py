"""Collects the errors that `hippodrome` logs while a command runs its services, and keeps its log off the screen."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager


class Failures(logging.Handler):
    """A log handler that keeps errors as sentences: "a server is not stopped yet (ClientError, AccessDenied)"."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.lines: dict[str, None] = {}  # the sentences, each once

    def emit(self, record: logging.LogRecord) -> None:
        kinds = [str(kind) for kind in (getattr(record, "error", None) or [])[:1]]
        code = getattr(record, "code", None)
        details = ", ".join([*kinds, *([str(code)] if code else [])])
        self.lines[f"{record.getMessage()} ({details})" if details else record.getMessage()] = None


@contextmanager
def functions_log() -> Iterator[Failures]:
    """Collect, within the block, the errors that `hippodrome` logs, and print none of its log lines."""
    from hippodrome.control.log import logger  # noqa: PLC0415 - Powertools, which most commands do without

    handler = logger.registered_handler
    failures = Failures()
    level = handler.level
    handler.setLevel(logging.CRITICAL + 1)
    standard_logger = logging.getLogger(logger.service)
    standard_logger.addHandler(failures)
    try:
        yield failures
    finally:
        standard_logger.removeHandler(failures)
        handler.setLevel(level)
