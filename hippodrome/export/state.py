"""The state of an export folder, in a SQLite file: the files that earlier runs have fetched, and what they hold.

So an interrupted run can be continued, and memory does not grow with the study. The file holds ids and answers, so it
lies in the folder's `private/`.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import secrets
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from hippodrome.export.keys import ASSIGNED, ENDED
from hippodrome.protocol.answer import GAME

_TABLES = """
CREATE TABLE IF NOT EXISTS facts (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS participants (
  user TEXT PRIMARY KEY, number TEXT NOT NULL UNIQUE, folder TEXT NOT NULL UNIQUE COLLATE NOCASE,
  seen INTEGER NOT NULL DEFAULT 0, document TEXT);
CREATE TABLE IF NOT EXISTS files (
  key TEXT PRIMARY KEY, user TEXT NOT NULL, kind TEXT NOT NULL, version TEXT NOT NULL, size INTEGER NOT NULL,
  path TEXT, bytes INTEGER, sha256 TEXT, raw TEXT, raw_bytes INTEGER, raw_sha256 TEXT,
  frames INTEGER NOT NULL DEFAULT 0,  problems TEXT NOT NULL DEFAULT '[]', seen INTEGER NOT NULL DEFAULT 0);
CREATE INDEX IF NOT EXISTS files_of ON files (user);
CREATE TABLE IF NOT EXISTS answers (
  user TEXT NOT NULL, step TEXT NOT NULL, document TEXT NOT NULL, PRIMARY KEY (user, step)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS sessions (owner TEXT PRIMARY KEY, document TEXT NOT NULL) WITHOUT ROWID;
CREATE VIEW IF NOT EXISTS people AS
  SELECT p.user, p.number, p.folder, p.document, s.document AS membership, p.seen
  FROM participants p LEFT JOIN sessions s ON s.owner = p.user;
CREATE TABLE IF NOT EXISTS episodes (
  key TEXT NOT NULL, place INTEGER NOT NULL, document TEXT NOT NULL, PRIMARY KEY (key, place)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS tapes (key TEXT PRIMARY KEY, document TEXT NOT NULL) WITHOUT ROWID;
"""
_ANSWERS = "SELECT count(*) FROM answers WHERE instr(step, '.') = 0 AND step NOT IN (?, ?)"
"""Counts the answers: neither tries, whose names have a point, nor assignments and ends (`keys.py`)."""
_LETTERS = "abcdefghjkmnpqrstuvwxyz23456789"  # characters that are not mistaken for others


class ExportedFile(NamedTuple):
    """A file in the export folder: its path in the folder, its size in bytes, its SHA-256."""

    path: str
    bytes: int
    sha256: str


@dataclass
class SourceFile:
    """A file of the source, and the result of fetching it."""

    key: str
    kind: str
    version: str
    size: int  # bytes
    made: ExportedFile | None = None  # the converted recording
    raw: ExportedFile | None = None  # the unchanged copy
    frames: int = 0
    problems: list[str] = field(default_factory=list)
    document: Mapping[str, Any] | None = None  # the content, unless the file is a recording
    step: str = ""  # the step, if the file is an answer
    episodes: list[Mapping[str, Any]] = field(default_factory=list)


class KnownFile(NamedTuple):
    """A file of the source in the state: its version, and the paths of the converted file and of the raw one."""

    version: str
    path: str | None
    raw: str | None


class ExportedParticipant(NamedTuple):
    """A participant: the id, the number that replaces it, the name of the folder, and participant.json.

    `membership` is `session.json` of their folder, which names their session; {} if they have none. `failed_code` is
    the completion code that they saw because no server could run their game; "" if there is none.
    """

    user: str
    number: str
    folder: str
    document: Mapping[str, Any]
    membership: Mapping[str, Any] = {}
    failed_code: str = ""


_SESSION_KINDS = ("membership", "session")
"""The kinds of `session.json`: that in a participant's folder, and that in a session's. One table has both."""


class ExportState:
    """The state of an export folder. Use it in one thread only. Committed changes survive a crash."""

    def __init__(self, path: Path | None) -> None:
        """Open or create the state; with None it is an empty one in memory. Raises sqlite3.DatabaseError if the file
        is no state."""
        self._db = sqlite3.connect(path or ":memory:", isolation_level=None)
        self._db.execute("PRAGMA synchronous=NORMAL")
        self._db.executescript(_TABLES)

    @classmethod
    def read_only(cls, path: Path) -> ExportState:
        """Return a state that cannot be changed; an empty one if there is no such file.

        SQLite opens the file for writing all the same, because it must roll back the last transaction of a killed run.
        """
        if not path.exists():
            return cls(None)
        state = cls.__new__(cls)
        state._db = sqlite3.connect(path, isolation_level=None)
        state._db.execute("PRAGMA query_only=ON")
        return state

    def close(self) -> None:
        self._db.close()

    # -- facts

    def fact(self, name: str) -> str | None:
        found = self._db.execute("SELECT value FROM facts WHERE name=?", (name,)).fetchone()
        return str(found[0]) if found else None

    def set_fact(self, name: str, value: str) -> None:
        self._db.execute("INSERT OR REPLACE INTO facts VALUES (?, ?)", (name, value))

    # -- participants

    def participant(self, user: str) -> ExportedParticipant | None:
        row = self._db.execute(
            "SELECT user, number, folder, document, membership FROM people WHERE user=?", (user,)
        ).fetchone()
        return self._participant(row) if row else None

    def present(self, user: str) -> ExportedParticipant | None:
        """Return the participant if the last run has found files of them in the source, otherwise None."""
        seen = self._db.execute("SELECT 1 FROM participants WHERE user=? AND seen=?", (user, self.run)).fetchone()
        return self.participant(user) if seen else None

    def session(self, session: str) -> Mapping[str, Any]:
        """Return the document of a session; {} if it is not known."""
        row = self._db.execute("SELECT document FROM sessions WHERE owner=?", (session,)).fetchone()
        return json.loads(row[0]) if row else {}

    def has_sessions(self) -> bool:
        """Return whether the state has documents of sessions."""
        return self._db.execute("SELECT 1 FROM files WHERE kind IN ('session', 'membership')").fetchone() is not None

    def find_or_add(self, user: str, apart: bool, number: str = "") -> ExportedParticipant:
        """Return the participant. A new one gets `number`, or if that is "", a random number with `apart`, otherwise
        their id."""
        known = self.participant(user)
        if known:
            return known
        while True:
            number = number or ("p" + "".join(secrets.choice(_LETTERS) for _ in range(9)) if apart else user)
            folder = self._free_folder(number)
            try:
                self._db.execute(
                    "INSERT INTO participants (user, number, folder) VALUES (?, ?, ?)", (user, number, folder)
                )
            except sqlite3.IntegrityError:
                number = ""  # another participant has this number (a random one: with a probability of 4e-14)
                continue
            return ExportedParticipant(user, number, folder, {})

    def _free_folder(self, number: str) -> str:
        """A name for the participant's folder. Names that differ only by case are one folder on some systems."""
        name, count = number, 1
        while self._db.execute("SELECT 1 FROM participants WHERE folder=?", (name,)).fetchone():
            count += 1
            name = f"{number}~{count}"
        return name

    def participants(self) -> Iterator[ExportedParticipant]:
        """Yield the participants whose files the last run has found, in the order of their numbers."""
        query = "SELECT user, number, folder, document, membership FROM people WHERE seen=? ORDER BY number"
        for row in self._db.execute(query, (self.run,)):
            yield self._participant(row)

    def _participant(self, row: Any) -> ExportedParticipant:
        user, number, folder, document, membership = row
        return ExportedParticipant(
            user,
            number,
            folder,
            json.loads(document) if document else {},
            json.loads(membership) if membership else {},
            self._failed_code(user),
        )

    def _failed_code(self, user: str) -> str:
        query = "SELECT document FROM answers WHERE user=? AND document LIKE '%\"completionCode\"%' ORDER BY step"
        for (text,) in self._db.execute(query, (user,)):
            document = json.loads(text)
            fields = document.get("answers")
            code = fields.get("completionCode") if isinstance(fields, dict) and document.get("page") == GAME else None
            if isinstance(code, str):
                return code
        return ""

    # -- runs

    @functools.cached_property
    def run(self) -> int:
        """The number of the last run that began."""
        return int(self.fact("run") or 0)

    def begin_run(self) -> None:
        self.run += 1
        self.set_fact("run", str(self.run))

    def files_of(self, user: str) -> dict[str, KnownFile]:
        rows = self._db.execute("SELECT key, version, path, raw FROM files WHERE user=?", (user,))
        return {key: KnownFile(version, path, raw) for key, version, path, raw in rows}

    @contextlib.contextmanager
    def in_transactions(self) -> Iterator[Callable[[], None]]:
        """Write all changes in the block in transactions. Yields a function that commits one and begins the next.

        The last transaction is committed at the end of the block, even after an error. Each commit waits for the disk.
        """
        self._db.execute("BEGIN")

        def commit() -> None:
            self._db.execute("COMMIT")
            self._db.execute("BEGIN")

        try:
            yield commit
        finally:
            self._db.execute("COMMIT")

    def save(self, user: str, unchanged: Iterable[str], fetched: Iterable[SourceFile]) -> None:
        """Save the fetched files of a participant or session, and that the source still has the keys in `unchanged`."""
        run = self.run
        if user:
            self._db.execute("UPDATE participants SET seen=? WHERE user=?", (run, user))
        self._db.executemany("UPDATE files SET seen=? WHERE key=?", ((run, key) for key in unchanged))
        for file in fetched:
            self._save_file(user, file, run)

    def _save_file(self, user: str, file: SourceFile, run: int) -> None:
        none = (None, None, None)
        self._db.execute(
            "INSERT OR REPLACE INTO files VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?)",
            (
                file.key,
                user,
                file.kind,
                file.version,
                file.size,
                *(file.made or none),
                *(file.raw or none),
                file.frames,
                json.dumps(file.problems),
                run,
            ),
        )
        if file.kind == "participant":
            self._db.execute("UPDATE participants SET document=? WHERE user=?", (_json(file.document), user))
        if file.kind in _SESSION_KINDS:
            self._db.execute("DELETE FROM sessions WHERE owner=?", (user,))
            if file.document is not None:
                self._db.execute("INSERT INTO sessions VALUES (?, ?)", (user, _json(file.document)))
        if file.kind == "answer":
            if file.document is None:
                self._db.execute("DELETE FROM answers WHERE user=? AND step=?", (user, file.step))
            else:
                self._db.execute(
                    "INSERT OR REPLACE INTO answers VALUES (?, ?, ?)", (user, file.step, _json(file.document))
                )
        self._db.execute("DELETE FROM tapes WHERE key=?", (file.key,))
        if file.kind == "tape" and file.document is not None:
            self._db.execute("INSERT INTO tapes VALUES (?, ?)", (file.key, _json(file.document)))
        self._db.execute("DELETE FROM episodes WHERE key=?", (file.key,))
        self._db.executemany(
            "INSERT INTO episodes VALUES (?, ?, ?)",
            ((file.key, place, _json(episode)) for place, episode in enumerate(file.episodes)),
        )

    def unseen(self) -> list[tuple[str, str, str, str | None, str | None]]:
        """Return the files that the last run did not find in the source: key, user, kind, path, raw path."""
        return self._db.execute("SELECT key, user, kind, path, raw FROM files WHERE seen<>?", (self.run,)).fetchall()

    def forget(self, key: str, user: str, kind: str) -> None:
        """Remove a file that the source does not have any more from the state."""
        self._db.execute("DELETE FROM files WHERE key=?", (key,))
        self._db.execute("DELETE FROM episodes WHERE key=?", (key,))
        self._db.execute("DELETE FROM tapes WHERE key=?", (key,))
        if kind == "answer":
            step = key.rpartition("/")[2].removesuffix(".json")
            self._db.execute("DELETE FROM answers WHERE user=? AND step=?", (user, step))
        if kind == "participant":
            self._db.execute("UPDATE participants SET document=NULL WHERE user=?", (user,))
        if kind in _SESSION_KINDS:
            self._db.execute("DELETE FROM sessions WHERE owner=?", (user,))

    def forget_participants(self) -> None:
        """Remove the participants without files in the last run, with their numbers."""
        self._db.execute("DELETE FROM participants WHERE seen<>?", (self.run,))

    def file_count(self) -> int:
        """Return the number of files in the state."""
        return int(self._db.execute("SELECT count(*) FROM files").fetchone()[0])

    # -- reading all rows in order, one at a time

    def converted_files(self) -> Iterator[ExportedFile]:
        """Yield the converted recordings."""
        for row in self._db.execute("SELECT path, bytes, sha256 FROM files WHERE path IS NOT NULL ORDER BY path"):
            yield ExportedFile(*row)

    def raw_files(self) -> Iterator[ExportedFile]:
        """Yield the unchanged copies of the source's files."""
        for row in self._db.execute("SELECT raw, raw_bytes, raw_sha256 FROM files WHERE raw IS NOT NULL ORDER BY raw"):
            yield ExportedFile(*row)

    def answers(self) -> Iterator[tuple[ExportedParticipant, dict[str, Mapping[str, Any]]]]:
        """Yield the participants in the order of their numbers, each with the documents of their answers by step."""
        rows = self._db.execute(
            "SELECT p.user, p.number, p.folder, p.document, p.membership, a.step, a.document FROM people p"
            " LEFT JOIN answers a ON a.user = p.user WHERE p.seen=? ORDER BY p.number, a.step",
            (self.run,),
        )
        participant: ExportedParticipant | None = None
        found: dict[str, Mapping[str, Any]] = {}
        for row in rows:
            if participant is None or row[0] != participant.user:
                if participant is not None:
                    yield participant, found
                participant, found = self._participant(row[:5]), {}
            if row[5] is not None:
                found[row[5]] = json.loads(row[6])
        if participant is not None:
            yield participant, found

    def episodes(self) -> Iterator[tuple[ExportedParticipant | None, str, Mapping[str, Any]]]:
        """Yield the participant, the file and the facts of each episode, in the order of numbers and files.

        The episodes of sessions come first, with None for the participant. Their facts have `session`, and in `people`
        the participants' numbers by player.
        """
        rows = self._db.execute(
            "SELECT p.user, p.number, p.folder, p.document, p.membership, f.path, e.document FROM files f"
            " LEFT JOIN people p ON p.user = f.user JOIN episodes e ON e.key = f.key"
            " WHERE f.path IS NOT NULL ORDER BY p.number, f.path, e.place"
        )
        for row in rows:
            yield self._participant(row[:5]) if row[0] else None, row[5], json.loads(row[6])

    def tapes(self) -> Iterator[tuple[ExportedParticipant | None, Mapping[str, Any]]]:
        """Yield the participant and the document (`talk.document`) of each piece of a tape.

        Those of one game follow each other, in the order in which they were made. In a session the participant is None.
        """
        rows = self._db.execute(
            "SELECT p.user, p.number, p.folder, p.document, p.membership, t.document FROM tapes t"
            " JOIN files f ON f.key = t.key LEFT JOIN people p ON p.user = f.user"
            " ORDER BY p.number, f.user, json_extract(t.document, '$.step'), json_extract(t.document, '$.attempt'),"
            " length(t.key), t.key"
        )
        for row in rows:
            yield self._participant(row[:5]) if row[0] else None, json.loads(row[5])

    def problems(self) -> Iterator[tuple[ExportedParticipant | None, str, str]]:
        """Yield the participant (None for a file of no participant), the key and the problem of each bad file."""
        rows = self._db.execute(
            "SELECT p.user, p.number, p.folder, p.document, p.membership, f.key, f.problems FROM files f"
            " LEFT JOIN people p ON p.user = f.user WHERE f.problems<>'[]' ORDER BY p.number, f.key"
        )
        for row in rows:
            for problem in json.loads(row[6]):
                yield self._participant(row[:5]) if row[0] else None, row[5], problem

    def counts(self) -> dict[str, int]:
        """Return the counts for the manifest."""
        one = self._db.execute
        kinds = dict(one("SELECT kind, count(*) FROM files GROUP BY kind").fetchall())
        sessions = {"sessions": kinds["session"]} if "session" in kinds else {}
        return sessions | {
            "participants": one("SELECT count(*) FROM participants WHERE seen=?", (self.run,)).fetchone()[0],
            "answers": one(_ANSWERS, (ASSIGNED, ENDED)).fetchone()[0],
            "recordings": one("SELECT count(*) FROM files WHERE kind='recording' AND path IS NOT NULL").fetchone()[0],
            "episodes": one("SELECT count(*) FROM episodes").fetchone()[0],
            "frames": one("SELECT coalesce(sum(frames), 0) FROM files").fetchone()[0],
            "foreign": kinds.get("foreign", 0),
        }

    def recordings_fingerprint(self) -> str:
        """Return a hash that changes whenever a recording is added, changed or removed."""
        digest = hashlib.sha256()
        for file in self.converted_files():
            digest.update(f"{file.path}\0{file.sha256}\n".encode())
        return digest.hexdigest()


def _json(document: Mapping[str, Any] | None) -> str | None:
    return None if document is None else json.dumps(document, separators=(",", ":"))
