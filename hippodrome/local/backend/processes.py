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

from hippodrome.console.run_state import mark_of


def marked(state: Path) -> dict[str, list[psutil.Process]]:
    """Return the processes that carry the mark of this state folder, by the server's name."""
    by_mark: dict[str, list[psutil.Process]] = {}
    ours = mark_of(state, "")
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            for word in process.cmdline():
                name = word.removeprefix(ours)
                if name != word and "/" not in name and _group_of(process) is not None:
                    by_mark.setdefault(name, []).append(process)
    return by_mark


def _group_of(process: psutil.Process) -> int | None:
    """The id of the process's group if that is a whole session, as a server's is; None for a job of a shell.

    A shell's job may carry the mark, too: somebody searches for it.
    """
    with contextlib.suppress(ProcessLookupError, PermissionError):
        group = os.getpgid(process.pid)
        return group if group == os.getsid(process.pid) and group != os.getpgrp() else None
    return None


def end_everything(state: Path, seconds: float = 0) -> None:
    """End all servers of this state folder: SIGTERM if they get some `seconds` to store what they have; then SIGKILL.

    With a server ends all that it has started, also if the server itself has ended: a group outlives its leader.
    """
    servers = [process for several in marked(state).values() for process in several]
    groups: dict[int, list[psutil.Process]] = {group: [] for group in map(_group_of, servers) if group is not None}
    for process in psutil.process_iter():
        if (group := _group_of(process)) in groups:
            groups[group].append(process)
    if seconds:
        for process in servers:
            with contextlib.suppress(psutil.Error):
                process.terminate()
        psutil.wait_procs(servers, seconds)
    for group, members in groups.items():
        if any(process.is_running() for process in members):  # else the group's id may be another program's by now
            kill_group(group)
    psutil.wait_procs([process for members in groups.values() for process in members], 5)


def kill_group(pid: int) -> None:
    """Kill the process group that the process with this id leads."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)
