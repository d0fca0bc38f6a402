"""The processes of servers: a shell starts each of them, waits for it, and writes its exit status to a file.

Shell and server carry the mark `-X hippodrome={state folder}/tasks/{name}` in their command lines, by which they are
found again. A process id alone proves nothing: the system assigns it again.
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

import psutil

from hippodrome.control.ports import Refused

SHELL = '"$@" & echo $! > "$0.pid"; wait $!; status=$?; echo $status > "$0.exit"; exit $status'
"""Runs the command of its arguments; writes its process id to the file `{$0}.pid`, its exit status to `{$0}.exit`."""

# Errors of a command that can never be run, however often it is tried.
_REFUSED = (errno.ENOENT, errno.ENOTDIR, errno.EACCES, errno.EPERM, errno.ENOEXEC, errno.E2BIG, errno.EINVAL)


def spawn(
    command: Sequence[str], notes: Path, log: Path, *, mark: str, folder: Path, environment: Mapping[str, str]
) -> subprocess.Popen[bytes]:
    """Start the shell with the command, in a session of its own. It writes the files `notes` + ".pid" and ".exit".

    Raises `Refused` if the command can never be run, and OSError if it may be later.
    """
    marked = [command[0], "-X", mark, *command[1:]]
    with log.open("wb") as output:
        try:
            return subprocess.Popen(  # noqa: S603 - our own command
                ["/bin/sh", "-c", SHELL, str(notes), *marked],
                env=dict(environment),
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        except OSError as error:
            if error.errno in _REFUSED:
                raise Refused(f"{command[0]}: {error.strerror}") from error
            raise


def mark_of(state: Path, name: str) -> str:
    """Return the mark by which a server's processes are found: it stands in their command lines."""
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


def end_everything(state: Path) -> None:
    """Kill all servers of this state folder."""
    for processes in marked(state).values():
        kill(processes)


def process_of(pid: int | None, mark: str) -> psutil.Process | None:
    """Return the process with this id if it carries the mark; otherwise None."""
    if pid is None:
        return None
    try:
        process = psutil.Process(pid)
        return process if mark in process.cmdline() else None
    except psutil.Error:
        return None


def child_of(shell: int | None, mark: str) -> psutil.Process | None:
    """Return the server that this shell has started; None if there is none.

    It finds the server by the mark, in case its process id could not be written down.
    """
    try:
        children = psutil.Process(shell).children() if shell else []
    except psutil.Error:
        return None
    candidates = (process_of(child.pid, mark) for child in children)
    return next((process for process in candidates if process and not is_shell(process)), None)


def is_shell(process: psutil.Process) -> bool:
    """Return whether the process is the shell that waits for a server, and not the server itself."""
    try:
        return SHELL in process.cmdline()
    except psutil.Error:
        return False


def kill(processes: Sequence[psutil.Process]) -> None:
    """Kill the process groups of these processes: a server's group holds its shell and all that it has started."""
    for process in processes:
        with contextlib.suppress(psutil.Error, OSError):
            kill_group(os.getpgid(process.pid) if process.is_running() else None)


def kill_group(pid: int | None) -> None:
    """Kill the process group that the process with this id leads. None: do nothing."""
    if pid:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(pid, signal.SIGKILL)
