"""What bots sent and played, looked for in the data of `make try`, and what its functions and servers said."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from bots import verification
from bots.report import BotReport
from bots.verification import Verification, document
from hippodrome.model import ids
from local.activity.function_log import complaint
from local.activity.server_logs import last_error
from local.rehearsal.study_process import logs_of
from protocol.keys import membership_key


def verify(data: Path, project_id: str, reports: Sequence[BotReport], *, recorded: bool = True) -> Verification:
    """Compare what is in the data folder with what the bots say. `recorded`: the project keeps recordings."""
    return verification.verify(
        data, project_id, reports, recorded=recorded, last_error=partial(_last_error, data, project_id)
    )


def _last_error(data: Path, project_id: str, user_id: str) -> str:
    """What the log of the participant's last server, or of their session's, says of its last error."""
    owner = document(data / membership_key(project_id, user_id)).get("session") or user_id
    label = ids.server_label(project_id, owner)
    attempt = document(data / "_servers" / f"{label}.json").get("attempt", 1)
    return last_error(logs_of(data) / f"{ids.server_name(label, attempt)}.log")


class FunctionLog:
    """What the functions of a study complain of from now on: pages that are broken, and the like."""

    def __init__(self, data: Path) -> None:
        self._log = logs_of(data) / "functions.log"
        self._begin = self._log.stat().st_size if self._log.is_file() else 0

    def complaints(self) -> list[str]:
        """Each in a line, as often as it was said."""
        found = []
        try:
            lines = self._log.read_bytes()[self._begin :].splitlines()
        except OSError:
            return []
        for line in lines:
            try:
                record = json.loads(line)
            except ValueError:
                continue
            if record.get("level") in ("WARNING", "ERROR"):
                found.append(complaint(str(record.get("message")), record))
        return found
