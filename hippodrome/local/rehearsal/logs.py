"""Checks the data of `try` for what the bots sent and played, and finds errors in the logs of functions and servers."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
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

_LINE = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\S* [A-Z]+ ")  # how a line of a server's log begins
_FAILED = re.compile(r" ERROR the agent (failed|cannot be started)$")
_AGAIN = " WARNING the agent failed again, in the same way"
_LONGEST = 40  # lines of a traceback


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


@dataclass
class AgentCrash:
    """An error of agent.py: its place and text (`agent.py:30: ValueError: …`), its traceback, and how often it
    happened.
    """

    text: str
    traceback: str
    count: int = 0

    def words(self) -> str:
        """Return the error and how often it happened, as one line."""
        times = "once" if self.count == 1 else f"{self.count} times"
        return f"agent.py failed {times}: {self.text}"


class StudyLogs:
    """The logs of a study's functions and servers. Only what is logged after this object is made counts."""

    def __init__(self, data: Path) -> None:
        self._folder = logs_of(data)
        self._sizes = {log: log.stat().st_size for log in self._folder.glob("*.log")}

    def warnings(self) -> list[str]:
        """Return the warnings and errors of the functions: a line for each time that one was logged."""
        warnings = []
        for line in "".join(self._new("functions.log")).splitlines():
            with contextlib.suppress(ValueError):
                record = json.loads(line)
                if record.get("level") in ("WARNING", "ERROR"):
                    warnings.append(log_line(str(record.get("message")), record))
        return warnings

    def crashes(self, names: Mapping[str, str]) -> list[AgentCrash]:
        """Return the errors of agent.py, each once, the most frequent first.

        `names` maps texts to those that replace them in the errors.
        """
        by_message: dict[str, AgentCrash] = {}
        for logged in self._new("s*.log"):
            text = logged
            for before, after in names.items():
                text = text.replace(before, after)
            for crash in _crashes_in(text.splitlines()):
                by_message.setdefault(crash.text, crash).count += 1
        return sorted(by_message.values(), key=lambda crash: -crash.count)

    def _new(self, pattern: str) -> Iterator[str]:
        """What is new in each of the logs with these names."""
        for log in sorted(self._folder.glob(pattern)):
            with contextlib.suppress(OSError):
                yield log.read_bytes()[self._sizes.get(log, 0) :].decode("utf-8", "replace")


def _crashes_in(lines: Iterable[str]) -> Iterator[AgentCrash]:
    """The errors in a server's log, one for each time that agent.py failed (`trial/agent/tracebacks.py`)."""
    last: AgentCrash | None = None
    traceback: list[str] | None = None  # the lines so far of the traceback that is being read
    for line in [*lines, "0000-00-00 00:00:00 INFO the end"]:
        if not _LINE.match(line):
            if traceback is not None:
                traceback.append(line)
            continue
        if traceback:
            last = AgentCrash(traceback[-1], "\n".join(traceback[-_LONGEST:]))
            yield last
        traceback = [] if _FAILED.search(line) else None
        if _AGAIN in line and last is not None:
            yield last
