"""Servers as processes of this machine, and their ECS events.

Each server is `python -m hippodrome.trial` in a process of its own. `task_process.py` follows one from its start to its
end; this module has the list of all. Servers end with the `run` that started them. If it is killed they play on, and
store what is played; the next `run` ends them, moves their recordings to the data, and reports them as lost
(`platform.py`), so that each game goes on where it was, on another server.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from hippodrome.control.ports import Address, Refused, RunningTask, TaskRequest
from hippodrome.local.backend.processes import end_everything
from hippodrome.local.backend.retry import Retry
from hippodrome.local.backend.task_process import HOST, Emit, Say, Shared, TaskProcess
from hippodrome.protocol import disk, environment

KILLED_SECONDS = 5.0  # in which a server must be gone after SIGKILL, when local mode ends
LEFT_SECONDS = 5.0  # in which a server that a killed `run` has left may store what it has
STOP_TIMEOUT = 30.0  # seconds from SIGTERM to SIGKILL, the default of ECS and of `STOP_SECONDS` (on AWS: 120)
KEPT_LOGS = 50  # the most logs of earlier servers that are kept

# -P: a project's random.py must not stand in for Python's
PYTHON_TRIAL = (sys.executable, "-P", "-m", "hippodrome.trial")


class ProcessTasks:
    """Implements `hippodrome.control.ports.Tasks`. `emit` takes an event."""

    def __init__(
        self,
        state: Path,
        data: Path,
        emit: Emit,
        *,
        command: Sequence[str] = PYTHON_TRIAL,
        stop_timeout: float = STOP_TIMEOUT,
        say: Say = print,
        retry: Retry | None = None,
        named_port: int | None = None,
    ) -> None:
        """`named_port`: the port at which browsers find all servers by their names (`hippodrome/local/web/names.py`).

        None: each server has its own port. Raises OSError if nothing can be written in `state`.
        """
        self._named_port = named_port
        self._shared = Shared(
            state=state.resolve(),
            data=data.resolve(),
            command=tuple(command),
            stop_timeout=stop_timeout,
            emit=emit,
            say=say,
            retry=retry or Retry(say),
        )
        for name in ("tasks", "logs", "spool"):
            disk.make_folder(self._shared.state / name)
        self._clusters: set[str] = set()
        self._lock = threading.Lock()
        self._servers: dict[str, TaskProcess] = {}  # by name: all servers, also those that have ended
        self._closing = False

    # The port

    def run(self, request: TaskRequest) -> str:
        if request.environment.get(environment.PROJECT_ID) not in self._shared.projects:
            # Another study has played with these data: its game must not be played with this one's agent.
            raise Refused("its study is not served here: `hippodrome run` in the study's own folder serves it")
        earlier, token = self._servers.get(request.name), request.environment.get(environment.TOKEN)
        if earlier and earlier.token != token:  # the record of that earlier server was deleted with the data
            self.forget([request.name])
        with self._lock, self._shared.retry.reporting():
            if self._closing:
                raise RuntimeError("local mode is ending: no server is started any more")
            if request.name not in self._servers:
                self._servers[request.name] = TaskProcess(request, self._shared)
            return self._servers[request.name].arn

    def stop(self, task: str, cluster: str, reason: str) -> None:
        for server in self._all():
            if server.arn == task:
                server.end(reason, self._shared.stop_timeout)

    def addresses(self, interfaces: Sequence[str]) -> dict[str, Address]:
        return {
            server.interface: Address(HOST, self._named_port or server.port)
            for server in self._all()
            if server.lives and server.port and server.interface in interfaces
        }

    def find(self, name: str, cluster: str) -> str | None:
        server = self._servers.get(name)
        return server.arn if server and server.lives and server.cluster == cluster else None

    def list(self) -> Iterator[RunningTask]:
        for server in self._all():
            if server.lives:
                interface = server.interface if server.port else None
                yield RunningTask(server.arn, server.cluster, server.name, interface, server.runs)

    def create_cluster(self, name: str) -> None:
        self._clusters.add(name)

    def delete_cluster(self, name: str) -> None:
        if any(task.cluster == name for task in self.list()):
            raise RuntimeError("the cluster still contains tasks")
        self._clusters.discard(name)

    def clusters(self) -> Iterator[str]:
        yield from sorted(self._clusters)

    # What local mode calls beside the port

    def add_project(
        self, project_id: str, folder: Path, *, has_model: bool = False, keeps_recordings: bool = True
    ) -> None:
        """Servers of this project run the code in this folder, from now on; those with a language model get its key."""
        self._shared.projects[project_id] = folder.resolve()
        (self._shared.with_model.add if has_model else self._shared.with_model.discard)(project_id)
        (self._shared.unrecorded.discard if keeps_recordings else self._shared.unrecorded.add)(project_id)

    def clear(self, others: Iterable[str] = ()) -> None:
        """End the servers that a killed `run` has left, and move their recordings to the data. Raises OSError.

        `others` are the ids of projects that are not served here and keep their recordings.
        """
        end_everything(self._shared.state, LEFT_SECONDS)
        for project_id in {*self._shared.projects, *others}:
            self._shared.rescue(project_id)
        for note in (self._shared.state / "tasks").iterdir():
            note.unlink()
        logs = [path for path in (self._shared.state / "logs").glob("*.log") if path.name != "functions.log"]
        for log in sorted(logs, key=lambda path: path.stat().st_mtime, reverse=True)[KEPT_LOGS:]:
            log.unlink(missing_ok=True)

    def close(self, seconds: float = 5.0) -> None:
        """End every server: SIGTERM now, and SIGKILL after `seconds`. Return when all are gone.

        If one is not gone KILLED_SECONDS after SIGKILL, return all the same.
        """
        with self._lock:
            self._closing = True
        _end([server for server in self._all() if not server.over], "local mode was ended", seconds)
        self._shared.closed.set()

    def forget(self, names: Sequence[str] | None = None) -> int:
        """End these servers (None: all) at once and remove their logs; return how many were running.

        For servers whose records were deleted: nothing else stops them, and new servers may get their names.
        """
        forgotten = [server for server in self._all() if names is None or server.name in names]
        playing = [server for server in forgotten if not server.over]
        for server in playing:
            server.silent = True
        _end(playing, "its record is gone", 0)
        for server in forgotten:
            with self._lock:
                self._servers.pop(server.name, None)
            self.log(server.name).unlink(missing_ok=True)
        return len(playing)

    def playing(self) -> Sequence[TaskProcess]:
        """Return the servers that have not ended. A warm server's `folder` is empty until it is assigned."""
        playing = [server for server in self._all() if not server.over]
        for server in playing:
            with contextlib.suppress(OSError):  # the next look sees it
                server.read_handover()
        return playing

    def port_of(self, label: str) -> int | None:
        """Return the port of the newest server that has this label in its DNS name; None if there is none.

        The label is the server's name, or its participant's id in lower case.
        """
        ports = [
            server.port
            for server in self._all()
            if server.lives and server.port and label in (server.name, server.folder.rpartition("/")[2].lower())
        ]
        return ports[-1] if ports else None

    def log(self, name: str) -> Path:
        """Return the log file of the server of this name."""
        return self._shared.log(name)

    def _all(self) -> Sequence[TaskProcess]:
        with self._lock:
            return [*self._servers.values()]


def _end(servers: Sequence[TaskProcess], reason: str, seconds: float) -> None:
    """End these servers, with SIGKILL after `seconds`, and wait until they are gone."""
    for server in servers:
        server.end(reason, seconds)
    until = time.monotonic() + seconds
    for server in servers:
        if not server.gone.wait(max(0.0, until - time.monotonic())):
            server.kill()
    until = time.monotonic() + KILLED_SECONDS
    for server in servers:
        server.gone.wait(max(0.0, until - time.monotonic()))
