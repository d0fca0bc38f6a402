"""Forks the servers of a study on one machine, where `local/backend/processes.py` starts them: their imports are already done.

`python -m testing.forked_servers` is `python -m local` with such servers. A forked process takes the place of the shell that
waits for a server, and forks again for the server. The system shows the command lines and variables of both as if they had
been started.
"""

from __future__ import annotations

import ctypes
import os
import resource
import runpy
import select
import signal
import sys
import threading
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from local.backend import processes, task_process
from local.backend.tasks import PYTHON_TRIAL
from testing import preloaded

_LARGE = 100_000  # bytes of a variable: the system refuses more than 128 KiB, and only where a process is started


class ForkedShell:
    """The process that waits for a server, with the methods of `subprocess.Popen` that `task_process.py` uses.

    Several threads may call them at the same time.
    """

    def __init__(self, forked: preloaded.Forked) -> None:
        self.pid = forked.pid
        self._forked = forked
        self._lock = threading.Lock()

    @property
    def returncode(self) -> int | None:
        """The exit code, once a call has seen the end of the process."""
        return self._forked.returncode

    def poll(self) -> int | None:
        """Return the exit code; None while the process runs."""
        with self._lock:
            return self._forked.poll()

    def wait(self) -> int:
        """Wait until the process has ended, and return its exit code."""
        if self.poll() is None:
            try:
                ended = os.pidfd_open(self.pid)
            except ProcessLookupError:
                pass
            else:
                looks = select.poll()
                looks.register(ended, select.POLLIN)
                looks.poll()
                os.close(ended)
        with self._lock:
            return self._forked.wait()


def spawn(
    command: Sequence[str], notes: Path, log: Path, *, mark: str, folder: Path, environment: Mapping[str, str]
) -> Any:
    """Call `processes.spawn`, except for a trial server that can be started: that one is forked."""
    large = any(len(value) > _LARGE for value in environment.values())
    if tuple(command) != PYTHON_TRIAL or not folder.is_dir() or large or not hasattr(os, "pidfd_open"):
        return processes.spawn(command, notes, log, mark=mark, folder=folder, environment=environment)
    (umask,) = (line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line[:6] == "Umask:")
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    named, names = os.pipe()
    with log.open("wb") as output, open(named, "rb") as told, open(names, "wb") as tells:
        forked = preloaded.start(
            "testing.forked_servers",
            ["--server", str(notes), mark, umask, str(files)],
            cwd=folder,
            env={**environment, "PYTHONPATH": str(preloaded.ROOT)},
            stdout=output,
            stderr=tells,
            start_new_session=True,
            safe_path=True,
        )
        tells.close()
        told.read()  # now its command line has the mark
    assert isinstance(forked, preloaded.Forked)
    return ForkedShell(forked)


def _wait_for_server(notes: str, mark: str, umask: str, files: str) -> int:
    """Do what `processes.SHELL` does. In the server's process, end with its exit code."""
    os.umask(int(umask, 8))
    resource.setrlimit(resource.RLIMIT_NOFILE, (int(files), resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    command = [PYTHON_TRIAL[0], "-X", mark, *PYTHON_TRIAL[1:]]
    _show(
        ["/bin/sh", "-c", processes.SHELL, notes, *command], (f"{name}={value}" for name, value in os.environ.items())
    )
    server = os.fork()
    if not server:
        for ignored in (signal.SIGINT, signal.SIGQUIT):  # as in each command that a shell starts with `&`
            signal.signal(ignored, signal.SIG_IGN)
        _show(command)
        os.dup2(1, 2)
        sys.argv = ["trial"]
        runpy.run_module("trial", run_name="__main__", alter_sys=True)
        return 0
    os.dup2(1, 2)
    Path(f"{notes}.pid").write_text(f"{server}\n")
    code = os.waitstatus_to_exitcode(os.waitpid(server, 0)[1])
    code = code if code >= 0 else 128 - code
    Path(f"{notes}.exit").write_text(f"{code}\n")
    return code


def _show(command: Iterable[str], variables: Iterable[str] = ()) -> None:
    """Let the system show this command line, and these variables, for this process: as many as there is room for."""
    places = Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[45:49]
    arguments, arguments_end, environ, environ_end = map(int, places)
    _put(arguments, arguments_end, command)
    if variables:
        _put(environ, environ_end, sorted(variables, key=len))


def _put(start: int, end: int, words: Iterable[str]) -> None:
    room = end - start
    text = b"".join(os.fsencode(word) + b"\0" for word in words)
    if len(text) > room:
        text = text[: text.rindex(b"\0", 0, room) + 1]
    ctypes.memmove(start, text.ljust(room - 1, b" ") + b"\0" if len(text) < room else text, room)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--server"]:
        sys.exit(_wait_for_server(*sys.argv[2:]))
    setattr(task_process, "spawn", spawn)  # noqa: B010 - as in held_rehearsal.py
    runpy.run_module("local", run_name="__main__", alter_sys=True)
