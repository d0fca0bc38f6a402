"""Finds and ends the processes of servers.

A server has the mark `-X hippodrome={state folder}/tasks/{name}` in its command line, by which it is found again. A
process id alone proves nothing: the system assigns it again.
"""

from __future__ import annotations

import contextlib
import os
import signal
from pathlib import Path

import psutil


def mark_of(state: Path, name: str) -> str:
    """Return the mark by which a server's process is found: it stands in its command line."""
    return f"hippodrome={state.resolve() / 'tasks' / name}"


def marked(state: Path) -> dict[str, list[psutil.Process]]:
    """Return the processes that carry the mark of this state folder, by the server's name."""
    by_mark: dict[str, list[psutil.Process]] = {}
    ours = mark_of(state, "") + "/"
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            for word in process.cmdline():
                name = word.removeprefix(ours)
                if name != word and "/" not in name:
                    by_mark.setdefault(name, []).append(process)
    return by_mark


def end_everything(state: Path, seconds: float = 0) -> None:
    """End all servers of this state folder: SIGTERM if they get some `seconds` to store what they have; then SIGKILL.

    With a server ends all that it has started.
    """
    processes = [process for several in marked(state).values() for process in several]
    if seconds:
        for process in processes:
            with contextlib.suppress(psutil.Error):
                process.terminate()
        psutil.wait_procs(processes, seconds)
    for process in processes:
        kill_group(process.pid)  # each leads its group; a group outlives its leader
    psutil.wait_procs(processes, 5)


def kill_group(pid: int) -> None:
    """Kill the process group that the process with this id leads."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)
