"""Erases one participant from a data folder of this machine, which `hippodrome run` or `hippodrome try` has filled.

`run` must not run meanwhile: its servers write recordings, and its functions read records. It keeps its own state
beside the data folder, in `.hippodrome/`, and there too the data that `hippodrome run --fresh` has moved aside.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hippodrome.console.problem import Problem
from hippodrome.control.limits import rules as limits
from hippodrome.control.limits.rules import ParticipantSlots
from hippodrome.control.model import ids, server
from hippodrome.control.model.project import MASTER_LIST, read_list
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Server
from hippodrome.deployment.aws.object_version import Version
from hippodrome.deployment.core.server_records import keys_of_warm_servers, warm_servers_of
from hippodrome.deployment.operate.cells_eraser import CellsEraser
from hippodrome.deployment.operate.data_folder import DataFolder
from hippodrome.deployment.operate.lobby_eraser import LobbyEraser
from hippodrome.deployment.operate.session_eraser import FoundSession, SessionEraser
from hippodrome.export import keys
from hippodrome.protocol.keys import participant_folder, session_folder, sessions_folder

STATE = ".hippodrome"
"""Where `hippodrome run` keeps tasks, messages and unfinished recordings, beside the data folder."""
EARLIER = "earlier"
"""The folder in `STATE` to which `hippodrome run --fresh` moves data and their state."""
_UNMISTAKABLE = 6  # characters from which an id cannot well be a part of other values


@dataclass
class Erased:
    """The numbers of files that were deleted, and of recordings that were written anew."""

    files: int = 0
    rewritten: int = 0


class FolderEraser:
    """Erases one participant of one project from a data folder. May be interrupted anywhere and called again."""

    def __init__(self, data: Path, project: str, user: str) -> None:
        self.data = data
        self.project = project
        self._folder = DataFolder(data)
        self._state = _state_of(data)
        self._user = user
        self._label = ids.server_label(project, user)
        self._sessions = SessionEraser(self._folder, project, user)
        self._lobby = LobbyEraser(self._folder, project, user)
        self._cells = CellsEraser(self._folder, project, user)

    def look(self) -> tuple[list[Version], list[FoundSession]]:
        """Find the participant's own files, the lobby's files that name them, and their sessions."""
        return [*self._own(), *self._lobby.look(), *self._cells.look()], self._sessions.sessions()

    def run(self) -> Erased:
        """Erase the participant. Raises `Problem` if `run` runs, or left a server or an unfinished recording."""
        with self._locked():
            sessions = self._sessions.sessions()
            self._must_be_over(sessions)
            done = Erased()

            def note(versions: Sequence[Version]) -> None:
                done.files += len(versions)

            for session in sessions:
                if not session.others:
                    self._folder.delete(self._of_server(ids.server_label(self.project, session.id)), note)
                self._sessions.leave(session, note)
            self._lobby.erase(note)
            self._cells.erase(note)
            self._release_slot()
            self._delete_state(note)
            self._folder.delete(self._own(), note)
            self._folder.remove_unfinished()  # files that a killed run was writing
            done.rewritten = self._sessions.rewritten
            return done

    @property
    def unreadable(self) -> list[str]:
        """Return the documents that may name the participant and cannot be read."""
        return [*self._sessions.unreadable, *self._lobby.unreadable, *self._cells.unreadable]

    def _own(self) -> list[Version]:
        return [
            *self._of_server(self._label),
            *self._folder.versions(participant_folder(self.project, self._user)),
        ]

    def _of_server(self, label: str) -> list[Version]:
        """Return the documents of this record's warm servers, then the record itself, which leads to them."""
        key = server.key(label)
        try:
            record = from_json((self._folder.root / key).read_bytes(), Server)
        except (OSError, ValueError):
            record = None
        keys = (*keys_of_warm_servers(self.project, warm_servers_of(record)), key)
        return [version for key in keys for version in self._folder.versions_of(key)]

    def _release_slot(self) -> None:
        """Take the participant out of the project's documents of slots (`maxParticipants`)."""
        for version in list(self._folder.versions(limits.participant_slots_folder(self.project))):
            body = self._folder.read(version)
            try:
                held = from_json(body, ParticipantSlots)
            except ValueError:
                continue
            if self._label in held.labels:
                self._folder.replace(version.key, body, to_json(held.without(self._label)))

    def _delete_state(self, note: Callable[[Sequence[Version]], None]) -> None:
        """Delete what `hippodrome run` keeps of the participant alone: unfinished recordings, tasks and logs."""
        state, unfinished = DataFolder(self._state), f"spool/{participant_folder(self.project, self._user)}"
        for prefix in (unfinished, f"tasks/{self._label}", f"logs/{self._label}"):
            state.delete(state.versions(prefix), note)
        shutil.rmtree(self._state / unfinished, ignore_errors=True)  # folders without files

    # -- what must not run

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the lock of `hippodrome run`, if that has ever run. Raises `Problem` if it runs now."""
        lock = self._state.with_name(f"{self._state.name}.lock")
        if not lock.exists():
            yield
            return
        with lock.open("r+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise Problem(
                    f"The study runs now with the data in {self._folder.root}.",
                    "End `hippodrome run` with Ctrl-C, then run the same command again.",
                ) from None
            yield

    def _must_be_over(self, sessions: Sequence[FoundSession]) -> None:
        """Raise `Problem` if a killed `run` has left a running server, or recordings that it has not moved."""
        theirs = [session_folder(self.project, session.id) for session in sessions]
        folders = {participant_folder(self.project, self._user), *theirs}
        runs = any(_runs(path, folders) for path in sorted((self._state / "tasks").glob("*")))
        spool = DataFolder(self._state / "spool")
        unfinished = any(any(spool.versions(folder)) for folder in theirs)
        if runs or unfinished:
            raise Problem(
                "Their server still runs, or its recording is unfinished: `run` was killed. Nothing was touched.",
                "Start `hippodrome run` once more and end it with Ctrl-C: it ends all servers and keeps what they "
                "recorded.",
            )


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


def folders(data: Path) -> list[Path]:
    """Return the data folder, and the folders to which `hippodrome run --fresh` has moved its earlier data.

    Raises `Problem` if there is no such folder.
    """
    if not data.is_dir():
        raise Problem(f"There is no folder {data}.", "Name the data folder of `hippodrome run`.")
    moved = data.resolve().parent / STATE / EARLIER
    return [data, *sorted(moved.glob(f"{data.resolve().name}-*/data"))]


def projects(data: Path) -> list[str]:
    """Return the ids of all projects in a data folder: those that are registered or have data of participants."""
    present = {
        path.name
        for path in data.iterdir()
        if any((data / folder).is_dir() for folder in (keys.prefix(path.name), sessions_folder(path.name)))
    }
    with contextlib.suppress(OSError, ValueError):
        present.update(project.id for project in read_list((data / MASTER_LIST).read_bytes()).projects)
    return sorted(filter(ids.is_project_id, present))


def mentions(data: Path, user: str) -> list[Path]:
    """Return the files in a data folder and in its state whose path or content still names the participant.

    What packed recordings hold is not looked at. A short id is only searched for where it must be an id.
    """
    bare = rf"(?<![\w-]){user}(?![\w-])"
    names = [bare if len(user) >= _UNMISTAKABLE else rf'users/{user}/|Id": ?"{user}"']
    names += [ids.server_label(project, user) for project in projects(data)]
    pattern = re.compile("|".join(names).encode())
    return [
        path
        for root in (data, _state_of(data))
        for path in sorted(root.rglob("*"))
        if path.is_file()
        and (
            pattern.search(os.fsencode(path.relative_to(root)))
            or (path.suffix != ".gz" and pattern.search(path.read_bytes()))
        )
    ]


def _state_of(data: Path) -> Path:
    """Return the folder where `run` keeps the state of this data folder. `--fresh` moves both side by side."""
    root = data.resolve()
    moved = root.parent.parent.name == EARLIER and root.parent.parent.parent.name == STATE
    return root.parent / "state" if moved else root.parent / STATE / root.name
