"""Keeps a participant's id out of the log, whichever part of the server says it: the researcher's code knows the id."""

from __future__ import annotations

import logging
from collections.abc import Callable

from trial.agent.tracebacks import without


class WithoutId(logging.Filter):
    """A filter for the logger `trial`. `user_id` returns the id; an empty one while no participant is known."""

    def __init__(self, user_id: Callable[[], str]) -> None:
        super().__init__()
        self._user_id = user_id

    def filter(self, record: logging.LogRecord) -> bool:
        record.msg, record.args = without(self._user_id(), record.getMessage()), None
        return True
