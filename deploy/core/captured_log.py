"""The control plane's log while a command runs it here: kept from the screen, and its errors put aside."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager


class Failures(logging.Handler):
    """What went wrong: sentences such as "a server is not stopped yet (ClientError, AccessDenied)", each once."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.lines: dict[str, None] = {}

    def emit(self, record: logging.LogRecord) -> None:
        kinds = [str(kind) for kind in (getattr(record, "error", None) or [])[:1]]
        code = getattr(record, "code", None)
        what = ", ".join([*kinds, *([str(code)] if code else [])])
        self.lines[f"{record.getMessage()} ({what})" if what else record.getMessage()] = None


@contextmanager
def functions_log() -> Iterator[Failures]:
    """Within the block, errors that `hippodrome` logs go to the `Failures`; stdout is for answers alone."""
    from hippodrome.log import logger  # noqa: PLC0415 - Powertools, which most commands do without

    handler = logger.registered_handler
    failures = Failures()
    level = handler.level
    handler.setLevel(logging.CRITICAL + 1)
    underneath = logging.getLogger(logger.service)
    underneath.addHandler(failures)
    try:
        yield failures
    finally:
        underneath.removeHandler(failures)
        handler.setLevel(level)
