"""What running servers write: answers, and errors in their logs."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

from hippodrome.local.check.remedies import remedy
from hippodrome.protocol import session
from hippodrome.protocol.keys import participant_folder
from hippodrome.protocol.session import BadSession, is_session_id

_ERROR = re.compile(r"(?:\S+:\d+: )?(?:\w+\.)*(?P<kind>\w+): (?P<text>.*)")


class WatchedServer:
    """A running server: finds new answers of its participant or its session's members, and new errors in its log.

    With `whole_log`, errors that are in the log already are found, too.
    """

    def __init__(self, folder: str, data: Path, log: Path, whole_log: bool) -> None:
        self._data = data
        self._log = log
        self._read = 0 if whole_log else _size(log)
        self._rest = b""  # the beginning of a line that is not written to its end
        self._reader = ErrorReader(log)
        self.assign(folder)

    def assign(self, folder: str) -> None:
        """Set the folder of the participant or session that the server now belongs to.

        Answers that are there already are not of this server's game, and are not returned by `answers`.
        """
        self.folder = folder
        self.user_id = folder.rpartition("/")[2]
        self._folders: tuple[str, ...] = () if is_session_id(self.user_id) else (folder,)  # participants' folders
        self._known = self._keys()
        self._returned: set[str] = set()

    def answers(self) -> list[tuple[str, bytes]]:
        """Return the answers that are new since the last call: the key and the content of each."""
        if not self._folders:
            self._find_members()
            return []
        answers = []
        for key in sorted(self._keys() - self._known):
            with contextlib.suppress(OSError):
                answers.append((key, (self._data / key).read_bytes()))
                self._known.add(key)
        return answers

    def errors(self) -> list[str]:
        """Return the errors that are new in the server's log, each text once.

        An error is a logged line, or an exception in its own words.
        """
        try:
            with self._log.open("rb") as log:
                log.seek(self._read)
                new = log.read()
        except OSError:
            return []
        self._read += len(new)
        *lines, self._rest = (self._rest + new).split(b"\n")
        errors = []
        for text in filter(None, (_begins_anew(line) or self._reader.read(line) for line in lines)):
            if text not in self._returned:
                self._returned.add(text)
                errors.append(text)
        return errors

    def _keys(self) -> set[str]:
        """The keys of the answers that exist now."""
        with contextlib.suppress(OSError):
            return {
                path.relative_to(self._data).as_posix()
                for folder in self._folders
                for path in (self._data / folder / "answers").glob("[!.]*.json")
            }
        return set()

    def _find_members(self) -> None:
        """Look whether the session has been formed. Answers of its members that exist by then are not of its game."""
        with contextlib.suppress(OSError, BadSession):
            session_read = session.parse((self._data / self.folder / "session.json").read_bytes())
            project, ids = (
                self.folder.partition("/")[0],
                [member.user_id for member in session_read.members if member.user_id],
            )
            self._folders = tuple(participant_folder(project, user_id).rstrip("/") for user_id in ids)
            self._known = self._keys()


class ErrorReader:
    """Finds the errors in a server's log, which is read a line at a time."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._in_traceback = False

    def read(self, raw: bytes) -> str:
        """Return the text to show for the next line of the log; "" if there is nothing to show.

        It is a logged error, or the exception at the end of a traceback, indented.
        """
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
    """The advice of `hippodrome check` for an error, by the last line of its traceback."""
    match = _ERROR.match(line)
    return remedy(match["kind"], match["text"]) if match else ""


def _begins_anew(raw: bytes) -> str:
    """What to show if the line says that a lost server's game could not be resumed where it was; otherwise ""."""
    if b" WARNING the episode cannot go on where it was" not in raw:
        return ""
    cause = "something in agent.py is left to chance" if b"(Diverged)" in raw else "agent.py failed at that"
    return f"the lost server's game could not be played again, and begins anew: {cause} (docs/agent.md)"


def last_error(log: Path) -> str:
    """Return the text of the last error in a server's log; "" if there is none."""
    reader = ErrorReader(log)
    try:
        with log.open("rb") as lines:
            errors = [text for text in map(reader.read, lines) if text]
    except OSError:
        return ""
    return errors[-1].strip() if errors else ""


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
