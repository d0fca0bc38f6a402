"""Checks the data of `try` for what the bots sent and played, and reads the logs of functions and servers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from hippodrome.bots import verification
from hippodrome.bots.report import BotReport
from hippodrome.bots.verification import Verification, document
from hippodrome.control.model import ids
from hippodrome.local.activity.function_log import log_line
from hippodrome.local.activity.server_logs import last_error
from hippodrome.local.rehearsal.study_process import logs_of
from hippodrome.protocol.keys import membership_key


def verify(data: Path, project_id: str, reports: Sequence[BotReport], *, recorded: bool = True) -> Verification:
    """Compare the data folder with the bots' reports, and return what was found and what is missing.

    `recorded`: whether the project keeps recordings.
    """
    return verification.verify(
        data, project_id, reports, recorded=recorded, last_error=partial(_last_error, data, project_id)
    )


def _last_error(data: Path, project_id: str, user_id: str) -> str:
    """The last error in the log of the last server of a participant or their session; empty if there is none."""
    owner = document(data / membership_key(project_id, user_id)).get("session") or user_id
    label = ids.server_label(project_id, owner)
    attempt = document(data / "_servers" / f"{label}.json").get("attempt", 1)
    return last_error(logs_of(data) / f"{ids.server_name(label, attempt)}.log")


class FunctionLog:
    """The log of a study's functions. Only what is logged after this object is made counts."""

    def __init__(self, data: Path) -> None:
        self._log = logs_of(data) / "functions.log"
        self._size = self._log.stat().st_size if self._log.is_file() else 0

    def warnings(self) -> list[str]:
        """Return the new warnings and errors: a line for each time that one was logged."""
        warnings = []
        try:
            lines = self._log.read_bytes()[self._size :].splitlines()
        except OSError:
            return []
        for line in lines:
            try:
                record = json.loads(line)
            except ValueError:
                continue
            if record.get("level") in ("WARNING", "ERROR"):
                warnings.append(log_line(str(record.get("message")), record))
        return warnings
