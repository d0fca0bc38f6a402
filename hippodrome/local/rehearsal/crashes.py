"""Finds errors of agent.py in the servers' logs of a rehearsal (`hippodrome/trial/agent/tracebacks.py` writes them)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from hippodrome.local.rehearsal.study_process import logs_of

_LINE = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\S* [A-Z]+ ")  # how a line of the log begins
_FAILED = re.compile(r" ERROR the agent (failed|cannot be started)$")
_AGAIN = " WARNING the agent failed again, in the same way"
_LONGEST = 40  # lines of a traceback


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


class ServerLogs:
    """The servers' logs of a study. Only what is logged after this object is made counts."""

    def __init__(self, data: Path) -> None:
        self._folder = logs_of(data)
        self._sizes = {log: log.stat().st_size for log in self._logs()}

    def crashes(self, names: Mapping[str, str]) -> list[AgentCrash]:
        """Return the errors of agent.py, each once, the most frequent first.

        `names` maps texts to those that replace them in the errors.
        """
        by_message: dict[str, AgentCrash] = {}
        for log in self._logs():
            try:
                new = log.read_bytes()[self._sizes.get(log, 0) :].decode("utf-8", "replace")
            except OSError:
                continue
            for before, after in names.items():
                new = new.replace(before, after)
            for crash in read(new.splitlines()):
                by_message.setdefault(crash.text, crash).count += 1
        return sorted(by_message.values(), key=lambda crash: -crash.count)

    def _logs(self) -> list[Path]:
        return sorted(log for log in self._folder.glob("*.log") if log.name != "functions.log")


def read(lines: Iterable[str]) -> Iterator[AgentCrash]:
    """Yield the errors in a server's log, one for each time that agent.py failed."""
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
