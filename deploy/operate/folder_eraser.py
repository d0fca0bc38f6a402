"""Erases one participant from a data folder of this machine, which `make run` or `make try` has filled.

`make run` must not run meanwhile: its servers write recordings, and its functions read records. It keeps its own state
beside the data folder, in `.hippodrome/`.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from console.problem import Problem
from deploy.aws.versions import Version
from deploy.core.server_records import keys_of_warm_servers, warm_servers_of
from deploy.operate.data_folder import DataFolder
from deploy.operate.lobby_eraser import LobbyEraser
from deploy.operate.session_eraser import FoundSession, SessionEraser
from hippodrome.limits import rules as limits
from hippodrome.limits.rules import ParticipantSlots
from hippodrome.model import ids, server
from hippodrome.model.records import from_json, to_json
from hippodrome.model.server import Server
from protocol.keys import participant_folder, session_folder

STATE = ".hippodrome"
"""Where `make run` keeps tasks, messages and unfinished recordings, beside the data folder."""


@dataclass
class Erased:
    """The numbers of files that were deleted, and of recordings that were written anew."""

    files: int = 0
    rewritten: int = 0
    mentioned: Sequence[str] = ()  # files of `.hippodrome/` that still name the participant


class FolderEraser:
    """Erases one participant of one project from a data folder. May be interrupted anywhere and called again."""

    def __init__(self, data: Path, project: str, user: str) -> None:
        self._folder = DataFolder(data)
        self._state = data.resolve().parent / STATE
        self._project = project
        self._user = user
        self._label = ids.server_label(project, user)
        self._sessions = SessionEraser(self._folder, project, user)
        self._lobby = LobbyEraser(self._folder, project, user)

    def look(self) -> tuple[list[Version], list[FoundSession]]:
        """Find the participant's own files, the lobby's files that name them, and their sessions."""
        return [*self._own(), *self._lobby.look()], self._sessions.sessions()

    def run(self) -> Erased:
        """Erase the participant. Raises `Problem` if `make run` runs, or left a server or an unfinished recording."""
        with self._locked():
            sessions = self._sessions.sessions()
            self._must_be_over(sessions)
            done = Erased()

            def note(versions: Sequence[Version]) -> None:
                done.files += len(versions)

            for found in sessions:
                if not found.others:
                    self._folder.delete(self._of_server(ids.server_label(self._project, found.id)), note)
                self._sessions.leave(found, note)
            self._lobby.erase(note)
            self._release_slot()
            self._folder.delete(self._own(), note)
            self._folder.remove_unfinished()  # files that a killed run was writing
            spool = DataFolder(self._state / self._folder.root.name / "spool")
            spool.delete(spool.versions(participant_folder(self._project, self._user)), note)
            done.rewritten, done.mentioned = self._sessions.rewritten, self._mentioned()
            return done

    @property
    def unreadable(self) -> list[str]:
        """Return the documents that may name the participant and cannot be read."""
        return [*self._sessions.unreadable, *self._lobby.unreadable]

    def _own(self) -> list[Version]:
        return [
            *self._of_server(self._label),
            *self._folder.versions(participant_folder(self._project, self._user)),
        ]

    def _of_server(self, label: str) -> list[Version]:
        """Return the documents of this record's warm servers, then the record itself, which leads to them."""
        key = server.key(label)
        try:
            record = from_json((self._folder.root / key).read_bytes(), Server)
        except (OSError, ValueError, RecursionError):
            record = None
        keys = (*keys_of_warm_servers(self._project, warm_servers_of(record)), key)
        return [version for each in keys for version in self._folder.versions_of(each)]

    def _release_slot(self) -> None:
        """Take the participant out of the project's documents of slots (`maxParticipants`)."""
        for version in list(self._folder.versions(limits.participant_slots_folder(self._project))):
            body = self._folder.read(version)
            try:
                held = from_json(body, ParticipantSlots)
            except (ValueError, RecursionError):
                continue
            if self._label in held.labels:
                self._folder.replace(version.key, body, to_json(held.without(self._label)))

    # -- what must not run

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the lock of `make run`, if that has ever run. Raises `Problem` if it runs now."""
        lock = self._state / f"{self._folder.root.name}.lock"
        if not lock.exists():
            yield
            return
        with lock.open("r+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise Problem(
                    f"The study runs now with the data in {self._folder.root}.",
                    "End `make run` with Ctrl-C, then run the same command again.",
                ) from None
            yield

    def _must_be_over(self, sessions: Sequence[FoundSession]) -> None:
        """Raise `Problem` if a killed `make run` has left a running server, or recordings that it has not moved."""
        state = self._state / self._folder.root.name
        theirs = [session_folder(self._project, found.id) for found in sessions]
        folders = {participant_folder(self._project, self._user), *theirs}
        runs = any(_runs(path, folders) for path in sorted((state / "tasks").glob("*")))
        spool = DataFolder(state / "spool")
        unfinished = any(any(spool.versions(folder)) for folder in theirs)
        if runs or unfinished:
            raise Problem(
                "Their server still runs, or its recording is unfinished: `make run` was killed. Nothing was touched.",
                "Start `make run` once more and end it with Ctrl-C: it ends all servers and keeps what they recorded.",
            )

    def _mentioned(self) -> list[str]:
        """Return the files of `.hippodrome/` that name the participant: messages and tasks."""
        state = self._state / self._folder.root.name
        names = [self._label.encode(), f'"{self._user}"'.encode(), f"/users/{self._user}".encode()]
        return [
            path.relative_to(self._state).as_posix()
            for path in (state.rglob("*") if state.is_dir() else ())
            if path.is_file() and any(name in path.read_bytes() for name in names)
        ]


def _runs(path: Path, folders: set[str]) -> bool:
    """Whether this file describes a task for one of these folders whose process is alive."""
    try:
        task: dict[str, Any] = json.loads(path.read_bytes())
        if f"{task.get('folder', '').rstrip('/')}/" not in folders or task.get("stopped"):
            return False
        os.kill(int(task["pid"]), 0)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return False
    return True


def erase(
    data: Path, project: str, user: str, *, dry_run: bool, confirm: Callable[[int, int], None]
) -> tuple[Erased | None, list[str], int]:
    """Erase the participant, unless `dry_run`, nothing is found or `confirm` raises.

    `confirm` gets how many files and how many sessions were found. Return what was done (None: nothing), the keys of
    documents that cannot be read, and how many files and sessions were found. Raises `Problem` if there is no such
    folder, and as `FolderEraser.run` does.
    """
    if not data.is_dir():
        raise Problem(f"There is no folder {data}.", "Name the data folder of `make run`.")
    eraser = FolderEraser(data, project, user)
    own, sessions = eraser.look()
    found = len(own) + len(sessions)
    if dry_run or not found:
        return None, eraser.unreadable, found
    confirm(len(own), len(sessions))
    return eraser.run(), eraser.unreadable, found
