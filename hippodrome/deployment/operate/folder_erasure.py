"""Erases one participant on this machine, from a data folder that `hippodrome run` or `hippodrome try` has filled.

`run` must not run meanwhile, nor a server that it has left: servers write recordings, and functions read records. It
keeps its own state beside the data folder, in `.hippodrome/`, and there too the data that `hippodrome run --fresh` has
moved aside.
"""

from __future__ import annotations

import contextlib
import fcntl
import getpass
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil

from hippodrome.console.problem import Problem
from hippodrome.console.run_state import EARLIER, STATE, mark_of, state_of
from hippodrome.control.model import ids
from hippodrome.control.model.project import MASTER_LIST, read_list
from hippodrome.deployment.core.server_records import warm_servers_of
from hippodrome.deployment.operate.data_folder import SCRATCH, DataFolder
from hippodrome.deployment.operate.eraser import Eraser
from hippodrome.protocol.keys import participant_folder, sessions_folder

_UNMISTAKABLE = 6  # characters from which an id cannot well be a part of other values


class FolderErasure:
    """Erases one participant of one project from a data folder. May be interrupted anywhere and called again."""

    def __init__(self, data: Path, project: str, user: str) -> None:
        self.project, self.place = project, str(data)
        self._folder, self._state = DataFolder(data), state_of(data)
        self.eraser = Eraser(self._folder, project, user)
        self.ended: dict[str, int] = {}  # no server runs
        self.playing = 0

    def look(self) -> dict[str, int]:
        """Return how much there is of the participant, by kind. Changes nothing."""
        return self.eraser.look().counts()

    def run(self, advance: Callable[[int], object] = lambda number: None) -> dict[str, int]:
        """Erase the participant, and return what is left. Raises `Problem` if `run` or a server of it runs."""
        with self._locked():
            self._must_be_over()
            self._erase_state()
            self.eraser.erase(advance)
            self._folder.remove_unfinished()
            return self.look()

    def _erase_state(self) -> None:
        """Erase the participant from what `run` keeps: unfinished documents and recordings, tasks and logs.

        Recordings of their sessions lie there if `run` was killed, or if the study keeps none (`s3upload`).
        """
        spool, sessions = DataFolder(self._state / "spool"), self.eraser.sessions()
        unfinished = Eraser(spool, self.project, self.eraser.user)
        for session in sessions:
            unfinished.leave(session)
        own = spool.root / participant_folder(self.project, self.eraser.user)
        for folder in (own, spool.root / SCRATCH, self._state / "scratch", self._folder.root / ".scratch"):
            if folder.exists():
                shutil.rmtree(folder)
        for owner in (self.eraser.user, *(session.id for session in sessions if not session.others)):
            for name in (ids.server_label(self.project, owner), *warm_servers_of(self.eraser.record(owner))):
                for file in (*self._state.glob(f"tasks/{name}[-.]*"), *self._state.glob(f"logs/{name}[-.]*")):
                    file.unlink()

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

    def _must_be_over(self) -> None:
        """Raise `Problem` if a killed `run` has left a server: it may still store what is about the participant."""
        mark = mark_of(self._state, "")
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                if any(word.startswith(mark) for word in process.cmdline()):
                    raise Problem(
                        "A server still runs here: `run` was killed. Nothing was touched.",
                        "Start `hippodrome run` once more and end it with Ctrl-C: it ends all servers and keeps what "
                        "they recorded.",
                    )


def erasures(data: Path, only: str | None, user: str) -> list[FolderErasure]:
    """Return an erasure for each project, or for the project `only`: in the data folder, and in the data that
    `hippodrome run --fresh` has moved aside. Raises `Problem` if there is no such folder or project."""
    present = {project for folder in _folders(data) for project in _projects(folder)}
    if not present:
        raise Problem(
            f"{data} is not a data folder: it holds no project.",
            "Name the folder in which `hippodrome run` keeps data, such as --from ../my-study/data.",
        )
    if only not in (None, *present):
        raise Problem(
            f"{data} holds nothing of a project {only}.",
            f"It holds: {', '.join(sorted(present))}. Without STUDY, the participant is erased in all of them.",
        )
    return [
        FolderErasure(folder, project, user)
        for folder in _folders(data)
        for project in _projects(folder)
        if only in (None, project)
    ]


def about(data: Path) -> dict[str, str]:
    """Return the facts about this place for a receipt."""
    return {"folder": str(data.resolve()), "by": getpass.getuser()}


def _folders(data: Path) -> list[Path]:
    if not data.is_dir():
        raise Problem(f"There is no folder {data}.", "Name the data folder of `hippodrome run`.")
    moved = data.resolve().parent / STATE / EARLIER
    return [data, *sorted(moved.glob(f"{data.resolve().name}-*/data"))]


def _projects(data: Path) -> list[str]:
    """Return the ids of all projects in a data folder: those that are registered or have data of participants."""
    present = {
        path.name
        for path in data.iterdir()
        if (path / "users").is_dir() or (data / sessions_folder(path.name)).is_dir()
    }
    with contextlib.suppress(OSError, ValueError):
        present.update(project.id for project in read_list((data / MASTER_LIST).read_bytes()).projects)
    return sorted(filter(ids.is_project_id, present))


def mentions(data: Path, user: str) -> list[Path]:
    """Return the files in data folders and in their state whose path or content still names the participant.

    What packed recordings hold is not looked at. A short id is only searched for where it must be an id.
    """
    bare = rf"(?<![\w-]){user}(?![\w-])"
    names = [bare if len(user) >= _UNMISTAKABLE else rf'users/{user}/|Id": ?"{user}"']
    found = []
    for folder in _folders(data):
        labels = [ids.server_label(project, user) for project in _projects(folder)]
        pattern = re.compile("|".join([*names, *labels]).encode())
        for root in (folder, state_of(folder)):
            for path in sorted(root.rglob("*")):
                packed = path.suffix == ".gz"
                where = os.fsencode(path.relative_to(root))
                if path.is_file() and (pattern.search(where) or (not packed and pattern.search(path.read_bytes()))):
                    found.append(path)
    return found
