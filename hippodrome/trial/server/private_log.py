"""Keeps participants' ids out of the log, even if the researcher's code logs them or names them in an error."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

from hippodrome.trial.agent.tracebacks import without


class IdFilter(logging.Filter):
    """Removes participants' ids from the logger's lines and tracebacks. `ids` returns the ids of those who play now."""

    def __init__(self, ids: Callable[[], Iterable[str]]) -> None:
        super().__init__()
        self._ids = ids

    def filter(self, record: logging.LogRecord) -> bool:
        record.msg, record.args = without(self._ids(), record.getMessage()), None
        if record.exc_info:  # handlers write `exc_text` if it is there, and make none of their own
            record.exc_text = without(self._ids(), logging.Formatter().formatException(record.exc_info))
        return True
