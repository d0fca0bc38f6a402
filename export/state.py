"""What a folder of data holds already, in a SQLite file: a run goes on where another was cut off, in little memory.

It holds ids and answers: it lies in the folder's `private/`.
"""

from __future__ import annotations

import contextlib
import functools
import json
import secrets
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

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
"""
_LETTERS = "abcdefghjkmnpqrstuvwxyz23456789"  # those that are not mistaken for others
_RESERVED = {"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(1, 10))}


class Kept(NamedTuple):
    """A file of ours: its path in the folder, its size in bytes, its SHA-256."""

    path: str
    bytes: int
    sha256: str


@dataclass
class File:
    """What became of one file of the source."""

    key: str
    kind: str
    version: str
    size: int
    made: Kept | None = None
    raw: Kept | None = None
    frames: int = 0
    problems: list[str] = field(default_factory=list)
    document: Mapping[str, Any] | None = None  # of an answer or a participant
    step: str = ""
    episodes: list[Mapping[str, Any]] = field(default_factory=list)


class Known(NamedTuple):
    """What the state says of a file."""

    version: str
    path: str | None
    raw: str | None


class ExportedParticipant(NamedTuple):
    """A participant: the id, the number that stands for it, the folder's name, and participant.json.

    `membership` says in which session they play (`session.json` of their folder); empty if in none.
    """

    user: str
    number: str
    folder: str
    document: Mapping[str, Any]
    membership: Mapping[str, Any] = {}


_OF_SESSIONS = ("membership", "session")
"""Kinds of `session.json`: that of a participant's folder, and that of the session's. Both are kept in one table."""


class ExportState:
    """One connection; use it in one thread. Nothing is lost that was committed."""

    def __init__(self, path: Path | None) -> None:
        """Open or make it; None is an empty one in memory. Raises sqlite3.DatabaseError for another file."""
        self._db = sqlite3.connect(path or ":memory:", isolation_level=None)
        self._db.execute("PRAGMA synchronous=NORMAL")
        self._db.executescript(_TABLES)

    @classmethod
    def read_only(cls, path: Path) -> ExportState:
        """For a look: nothing can be written. An empty one if there is no such file.

        Opened like any other all the same: what a killed run left half-written must be taken back first.
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
        return _participant(row) if row else None

    def present(self, user: str) -> ExportedParticipant | None:
        """The participant, if the source still has something of them."""
        seen = self._db.execute("SELECT 1 FROM participants WHERE user=? AND seen=?", (user, self.run)).fetchone()
        return self.participant(user) if seen else None

    def session(self, session: str) -> Mapping[str, Any]:
        """The document of a session; empty if it is not known."""
        row = self._db.execute("SELECT document FROM sessions WHERE owner=?", (session,)).fetchone()
        return json.loads(row[0]) if row else {}

    def has_sessions(self) -> bool:
        """Whether anything of sessions is known here."""
        return self._db.execute("SELECT 1 FROM files WHERE kind IN ('session', 'membership')").fetchone() is not None

    def find_or_add(self, user: str, apart: bool, number: str = "") -> ExportedParticipant:
        """The participant. A new one gets this number; else a random one if ids are kept `apart`, or their id."""
        known = self.participant(user)
        if known:
            return known
        while True:
            number = number or ("p" + "".join(secrets.choice(_LETTERS) for _ in range(9)) if apart else user)
            try:
                self._db.execute(
                    "INSERT INTO participants (user, number, folder) VALUES (?, ?, ?)",
                    (user, number, self._free_folder(number)),
                )
            except sqlite3.IntegrityError:
                number = ""  # the same number twice: one in 20 million million
                continue
            return ExportedParticipant(user, number, self._folder_of(user), {})

    def _folder_of(self, user: str) -> str:
        return str(self._db.execute("SELECT folder FROM participants WHERE user=?", (user,)).fetchone()[0])

    def _free_folder(self, number: str) -> str:
        """Ann and ann are two people, but one folder on some machines; and some names mean devices on others."""
        base = f"{number}~" if number.lower() in _RESERVED else number
        name, count = base, 1
        while self._db.execute("SELECT 1 FROM participants WHERE folder=?", (name,)).fetchone():
            count += 1
            name = f"{base}~{count}"
        return name

    def participants(self) -> Iterator[ExportedParticipant]:
        """Everybody who was seen in the last run, in the order of their numbers."""
        query = "SELECT user, number, folder, document, membership FROM people WHERE seen=? ORDER BY number"
        for row in self._db.execute(query, (self.run,)):
            yield _participant(row)

    # -- runs

    @functools.cached_property
    def run(self) -> int:
        """The number of the last run that began."""
        return int(self.fact("run") or 0)

    def begin_run(self) -> None:
        self.run += 1
        self.set_fact("run", str(self.run))

    def files_of(self, user: str) -> dict[str, Known]:
        rows = self._db.execute("SELECT key, version, path, raw FROM files WHERE user=?", (user,))
        return {key: Known(version, path, raw) for key, version, path, raw in rows}

    @contextlib.contextmanager
    def in_transactions(self) -> Iterator[Callable[[], None]]:
        """Write what follows in transactions. Call what this yields to commit one: the disk takes its time for each.

        The last one is committed when the block is left, even by an error.
        """
        self._db.execute("BEGIN")

        def commit() -> None:
            self._db.execute("COMMIT")
            self._db.execute("BEGIN")

        try:
            yield commit
        finally:
            self._db.execute("COMMIT")

    def keep(self, user: str, seen: Iterable[str], made: Iterable[File]) -> None:
        """Write down what one participant's files have become, and that they and those in `seen` are still there."""
        run = self.run
        if user:
            self._db.execute("UPDATE participants SET seen=? WHERE user=?", (run, user))
        self._db.executemany("UPDATE files SET seen=? WHERE key=?", ((run, key) for key in seen))
        for file in made:
            self._keep_file(user, file, run)

    def _keep_file(self, user: str, file: File, run: int) -> None:
        made, raw = file.made or Kept("", 0, ""), file.raw or Kept("", 0, "")
        self._db.execute(
            "INSERT OR REPLACE INTO files VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?)",
            (
                file.key,
                user,
                file.kind,
                file.version,
                file.size,
                *(made if file.made else (None, None, None)),
                *(raw if file.raw else (None, None, None)),
                file.frames,
                json.dumps(file.problems),
                run,
            ),
        )
        if file.kind == "participant":
            self._db.execute("UPDATE participants SET document=? WHERE user=?", (_json(file.document), user))
        if file.kind in _OF_SESSIONS:
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
        self._db.execute("DELETE FROM episodes WHERE key=?", (file.key,))
        self._db.executemany(
            "INSERT INTO episodes VALUES (?, ?, ?)",
            ((file.key, place, _json(episode)) for place, episode in enumerate(file.episodes)),
        )

    def unseen(self) -> Iterator[tuple[str, str, str, str, str | None, str | None]]:
        """Files that the last run did not find in the source: key, user, kind, step, path, raw path."""
        rows = self._db.execute("SELECT key, user, kind, path, raw FROM files WHERE seen<>?", (self.run,)).fetchall()
        for key, user, kind, path, raw in rows:
            yield key, user, kind, key.rpartition("/")[2].removesuffix(".json"), path, raw

    def forget(self, key: str, user: str, kind: str, step: str) -> None:
        """The file is gone from the source, and from here."""
        self._db.execute("DELETE FROM files WHERE key=?", (key,))
        self._db.execute("DELETE FROM episodes WHERE key=?", (key,))
        if kind == "answer":
            self._db.execute("DELETE FROM answers WHERE user=? AND step=?", (user, step))
        if kind == "participant":
            self._db.execute("UPDATE participants SET document=NULL WHERE user=?", (user,))
        if kind in _OF_SESSIONS:
            self._db.execute("DELETE FROM sessions WHERE owner=?", (user,))

    def forget_participants(self) -> int:
        """Those who were not seen in the last run: their numbers too. How many there were."""
        return self._db.execute("DELETE FROM participants WHERE seen<>?", (self.run,)).rowcount

    def file_count(self) -> int:
        """How many files of the source are known here."""
        return int(self._db.execute("SELECT count(*) FROM files").fetchone()[0])

    # -- reading it all, in order, a row at a time

    def kept(self) -> Iterator[Kept]:
        """Everything made from a file of the source, with the hash it had."""
        for row in self._db.execute("SELECT path, bytes, sha256 FROM files WHERE path IS NOT NULL ORDER BY path"):
            yield Kept(*row)

    def kept_raw(self) -> Iterator[Kept]:
        for row in self._db.execute("SELECT raw, raw_bytes, raw_sha256 FROM files WHERE raw IS NOT NULL ORDER BY raw"):
            yield Kept(*row)

    def answers(self) -> Iterator[tuple[ExportedParticipant, dict[str, Mapping[str, Any]]]]:
        """Everybody in the order of their numbers, each with the documents of their answers by step."""
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
                participant, found = _participant(row[:5]), {}
            if row[5] is not None:
                found[row[5]] = json.loads(row[6])
        if participant is not None:
            yield participant, found

    def episodes(self) -> Iterator[tuple[ExportedParticipant | None, str, Mapping[str, Any]]]:
        """Every episode with its participant and its file, in the order of numbers and files; first those of sessions.

        A session's episode has no participant here; it says `session` and, by player, the `people`'s numbers.
        """
        rows = self._db.execute(
            "SELECT p.user, p.number, p.folder, p.document, p.membership, f.path, e.document FROM files f"
            " LEFT JOIN people p ON p.user = f.user JOIN episodes e ON e.key = f.key"
            " WHERE f.path IS NOT NULL ORDER BY p.number, f.path, e.place"
        )
        for row in rows:
            yield _participant(row[:5]) if row[0] else None, row[5], json.loads(row[6])

    def problems(self) -> Iterator[tuple[ExportedParticipant | None, str, str]]:
        """Who, which file, what is wrong with it."""
        rows = self._db.execute(
            "SELECT p.user, p.number, p.folder, p.document, p.membership, f.key, f.problems FROM files f"
            " LEFT JOIN people p ON p.user = f.user WHERE f.problems<>'[]' ORDER BY p.number, f.key"
        )
        for row in rows:
            for problem in json.loads(row[6]):
                yield _participant(row[:5]) if row[0] else None, row[5], problem

    def counts(self) -> dict[str, int]:
        one = self._db.execute
        kinds = dict(one("SELECT kind, count(*) FROM files GROUP BY kind").fetchall())
        sessions = {"sessions": kinds["session"]} if "session" in kinds else {}
        return sessions | {
            "participants": one("SELECT count(*) FROM participants WHERE seen=?", (self.run,)).fetchone()[0],
            "answers": one("SELECT count(*) FROM answers").fetchone()[0],
            "recordings": one("SELECT count(*) FROM files WHERE kind='recording' AND path IS NOT NULL").fetchone()[0],
            "episodes": one("SELECT count(*) FROM episodes").fetchone()[0],
            "frames": one("SELECT coalesce(sum(frames), 0) FROM files").fetchone()[0],
            "foreign": kinds.get("foreign", 0),
        }

    def recordings_fingerprint(self) -> str:
        """Another one whenever a recording is added, changed or gone."""
        import hashlib  # noqa: PLC0415 - only for this

        digest = hashlib.sha256()
        for kept in self.kept():
            digest.update(f"{kept.path}\0{kept.sha256}\n".encode())
        return digest.hexdigest()


def _participant(row: Any) -> ExportedParticipant:
    return ExportedParticipant(
        row[0], row[1], row[2], json.loads(row[3]) if row[3] else {}, json.loads(row[4]) if row[4] else {}
    )


def _json(document: Mapping[str, Any] | None) -> str | None:
    return None if document is None else json.dumps(document, separators=(",", ":"))
