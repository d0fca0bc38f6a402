"""Keeps participants' ids out of the log, also if the researcher's code knows them and says them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

from trial.agent.tracebacks import without


class WithoutIds(logging.Filter):
    """A filter for the logger `trial`. `ids` returns those of all participants who play; none while none is known."""

    def __init__(self, ids: Callable[[], Iterable[str]]) -> None:
        super().__init__()
        self._ids = ids

    def filter(self, record: logging.LogRecord) -> bool:
        record.msg, record.args = without(self._ids(), record.getMessage()), None
        return True
