"""What participants' servers write: their answers, and the errors in their logs."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable
from pathlib import Path

from local.backend.task_record import TaskRecord
from local.check.remedies import remedy
from protocol import session
from protocol.keys import participant_folder
from protocol.session import BadSession, is_session_id

_ERROR = re.compile(r"(?:\S+:\d+: )?(?:\w+\.)*(?P<kind>\w+): (?P<text>.*)")


class WatchedServer:
    """A server that runs: which answers of its participant, or of its session's members, are there already.

    And how far its log has been read.
    """

    def __init__(self, task: TaskRecord, data: Path, log: Path, anew: bool) -> None:
        self._data = data
        self._log = log
        self._read = 0 if anew else _size(log)
        self._rest = b""
        self._errors = Errors(log)
        self.assign(task.folder)

    def assign(self, folder: str) -> None:
        """From now on it is the server of this participant or session: what is answered by now is not of its game."""
        self.folder = folder
        self.user_id = folder.rpartition("/")[2]
        self._folders: tuple[str, ...] = () if is_session_id(self.user_id) else (folder,)  # of those who play
        self._known = self._keys()
        self._said: set[str] = set()

    def answers(self) -> list[tuple[str, bytes]]:
        """Answers that were not there at the last look, with their keys."""
        if not self._folders:
            self._find_members()
            return []
        found = []
        for key in sorted(self._keys() - self._known):
            with contextlib.suppress(OSError):
                found.append((key, (self._data / key).read_bytes()))
                self._known.add(key)
        return found

    def complaints(self) -> list[str]:
        """What the server's log says of errors, each thing once: where it says so, and the error's own words."""
        try:
            with self._log.open("rb") as log:
                log.seek(self._read)
                new = log.read()
        except OSError:
            return []
        self._read += len(new)
        *lines, self._rest = (self._rest + new).split(b"\n")
        found = []
        for text in filter(None, (_anew(line) or self._errors.read(line) for line in lines)):
            if text not in self._said:
                self._said.add(text)
                found.append(text)
        return found

    def _keys(self) -> set[str]:
        """The answers that are there now."""
        with contextlib.suppress(OSError):
            return {f"{folder}/answers/{path.name}" for folder in self._folders for path in self._answers(folder)}
        return set()

    def _answers(self, folder: str) -> Iterable[Path]:
        return (self._data / folder / "answers").glob("[!.]*.json")

    def _find_members(self) -> None:
        """Look whether the session is formed. Answers that are there by then are not those of its game."""
        with contextlib.suppress(OSError, BadSession):
            found = session.parse((self._data / self.folder / "session.json").read_bytes())
            project, ids = self.folder.partition("/")[0], [member.user_id for member in found.members if member.user_id]
            self._folders = tuple(participant_folder(project, each).rstrip("/") for each in ids)
            self._known = self._keys()


class Errors:
    """Finds the errors in a server's log, which is read a line at a time."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._in_traceback = False

    def read(self, raw: bytes) -> str:
        """What this line says of an error: that there is one, or its own words, indented; otherwise nothing."""
        line = raw.decode("utf-8", "replace").rstrip()
        if " ERROR " in line[:40]:
            self._in_traceback = False
            return f"{line.partition(' ERROR ')[2]} (see {self._log})"
        if line.startswith("Traceback "):
            self._in_traceback = True
        elif self._in_traceback and line and not line.startswith(" "):
            self._in_traceback = False
            return f"  {line}{_advice(line)}"
        return ""


def _advice(line: str) -> str:
    """What `make check` says about an error of this kind, from the last line of its traceback."""
    found = _ERROR.match(line)
    return remedy(found["kind"], found["text"]) if found else ""


def _anew(raw: bytes) -> str:
    """What to say if the trial could not play a lost server's game again up to where it was; otherwise nothing."""
    if b" WARNING the episode cannot go on where it was" not in raw:
        return ""
    left = "something in agent.py is left to chance" if b"(Diverged)" in raw else "agent.py failed at that"
    return f"the lost server's game could not be played again, and begins anew: {left} (docs/agent.md)"


def last_error(log: Path) -> str:
    """The words of the last error in a server's log; empty if there is none."""
    errors = Errors(log)
    try:
        with log.open("rb") as lines:
            found = [text for text in map(errors.read, lines) if text]
    except OSError:
        return ""
    return found[-1].strip() if found else ""


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
