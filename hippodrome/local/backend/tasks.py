"""Servers as processes of this machine, and their ECS events.

Each server is `python -m hippodrome.trial` in a process of its own. `task_process.py` follows one from its start to its
end; this module has the list of all. The next `hippodrome run` finds each server again by its file (`task_record.py`).
"""

from __future__ import annotations

import contextlib
import hashlib
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from hippodrome.control.ports import Address, RunningTask, TaskRequest
from hippodrome.local.backend import files
from hippodrome.local.backend.processes import is_shell, kill, marked
from hippodrome.local.backend.retry import Retry, reports_errors
from hippodrome.local.backend.task_process import Emit, Say, Shared, TaskProcess
from hippodrome.local.backend.task_record import HOST, TaskFolder, TaskRecord, claim_of
from hippodrome.protocol import disk

KILLED_SECONDS = 5.0  # in which a server must be gone after SIGKILL, when local mode ends
STOP_TIMEOUT = 30.0  # seconds from SIGTERM to SIGKILL, the default of ECS and of `STOP_SECONDS` (on AWS: 120)
KEPT_TASKS, KEPT_LOGS = 200, 50  # the most records and logs of stopped servers that are kept

PYTHON_TRIAL = (
    sys.executable,
    "-P",
    "-m",
    "hippodrome.trial",
)  # -P: a project's random.py must not stand in for Python's


@reports_errors
class ProcessTasks:
    """Implements `hippodrome.control.ports.Tasks`. `emit` takes an event and returns when it is stored."""

    def __init__(
        self,
        state: Path,
        data: Path,
        project_folder: Path,
        emit: Emit,
        *,
        command: Sequence[str] = PYTHON_TRIAL,
        stop_timeout: float = STOP_TIMEOUT,
        say: Say = print,
        retry: Retry | None = None,
        named_port: int | None = None,
    ) -> None:
        """`named_port`: the port at which browsers find all servers by their names (`hippodrome/local/web/names.py`).

        None: each server has its own port. Raises OSError if the files of servers cannot be read or written in `state`.
        """
        self.retry = retry or Retry(say)
        self._state = state.resolve()
        self._named_port = named_port
        self._files = TaskFolder(self._state / "tasks")
        self._clusters = self._state / "clusters"
        self._shared = Shared(
            state=self._state,
            logs=state / "logs",
            spool=self._state / "spool",
            files=self._files,
            data=data.resolve(),
            project=project_folder.resolve(),
            command=tuple(command),
            stop_timeout=stop_timeout,
            emit=emit,
            say=say,
            retry=self.retry,
        )
        for folder in (self._files.path, self._shared.logs, self._shared.spool, self._clusters):
            disk.make_folder(folder)
        self._lock = self._shared.lock
        self._servers: dict[str, TaskProcess] = {}  # by name: all servers, also those that have stopped
        self._closing = False
        self._load()

    # The port

    def run(self, request: TaskRequest) -> str:
        claim = claim_of(request)
        task_server = self._servers.get(request.name)
        if task_server and task_server.task.claim not in (
            "",
            claim,
        ):  # the record of that earlier server was deleted with the data
            self.forget([request.name])
        with self._lock:
            if self._closing:
                raise RuntimeError("local mode is ending: no server is started any more")
            task_server = self._servers.get(request.name)
            if task_server:
                return task_server.task.arn
            id_ = hashlib.sha256(f"{self._state}\0{request.name}\0{time.time_ns()}".encode()).hexdigest()[:32]
            task = TaskRecord.of(request, id_)
            server = TaskProcess(task, self._shared)
            server.begin(request)
            self._servers[request.name] = server
            server.begun.set()
        return task.arn

    def stop(self, task: str, cluster: str, reason: str) -> None:
        server = next((candidate for candidate in self._all() if candidate.task.arn == task), None)
        if server:
            server.end(reason, time.monotonic() + self._shared.stop_timeout)

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        wanted_ids = set(interfaces)
        return {
            task.interface: Address(HOST, self._named_port or task.port)
            for task in (server.task for server in self._all() if server.lives)
            if task.interface in wanted_ids and task.port
        }

    def port_of(self, label: str) -> int | None:
        """Return the port of the newest server that has this label in its DNS name; None if there is none.

        The label is the server's name, or its participant's id in lower case.
        """
        listening = [server.task for server in self._all() if server.lives and server.task.port]
        servers_named = [
            task for task in listening if label in (task.name, task.folder.rstrip("/").rpartition("/")[2].lower())
        ]
        return max(servers_named, key=lambda task: task.created).port if servers_named else None

    def find(self, name: str, cluster: str) -> str | None:
        server = self._servers.get(name)
        return server.task.arn if server and server.lives and server.task.cluster == cluster else None

    def list(self) -> Iterator[RunningTask]:
        for task in (server.task for server in self._all() if server.lives):
            runs = task.status == "RUNNING"
            yield RunningTask(task.arn, task.cluster, task.name, task.interface if task.port else None, runs)

    def create_cluster(self, name: str) -> None:
        (self._clusters / name).touch()
        disk.sync_folder(self._clusters)

    def delete_cluster(self, name: str) -> None:
        if any(task.cluster == name for task in self.list()):
            raise RuntimeError("the cluster still contains tasks")
        (self._clusters / name).unlink(missing_ok=True)

    def clusters(self) -> Iterator[str]:
        yield from files.names(self._clusters)

    # What local mode calls beside the port

    def add_project(self, project_id: str, folder: Path, *, has_model: bool = False) -> None:
        """Servers of this project run the code in this folder, from now on; those with a language model get its key."""
        self._shared.projects[project_id] = folder.resolve()
        (self._shared.with_model.add if has_model else self._shared.with_model.discard)(project_id)

    def start(self) -> None:
        """Take over the servers of an earlier process: follow each that runs, and send the last events of the others.

        Raises OSError; it may then be called again.
        """
        found = marked(self._state)
        for server in self._all():
            if server.begun.is_set():  # an earlier call has taken it up
                found.pop(server.task.name, None)
                continue
            if server.task.status == "STOPPED":
                if server.unfinished:
                    server.take_up()
                continue
            processes = found.pop(server.task.name, [])
            shell = next((p for p in processes if is_shell(p)), None)
            never_began = server.task.pid is None and not processes and not self._files.note(server.task.name, "exit")
            if never_began:
                # The record was written, but no process began. The message that requested it is delivered again.
                self._forget(server)
                continue
            if not shell:
                kill(processes)
            elif shell.pid != server.task.pid:
                server.task, server.unsaved = replace(server.task, pid=shell.pid), True
            server.take_up()
        for leaked in found.values():
            kill(leaked)
        with contextlib.suppress(OSError):
            self._prune()

    def close(self, seconds: float = 5.0) -> None:
        """End every server: SIGTERM now, and SIGKILL after `seconds`. Return when all are gone.

        If one is not gone KILLED_SECONDS after SIGKILL, return all the same.
        """
        with self._lock:
            self._closing = True
            running = [server for server in self._all() if server.task.status != "STOPPED"]
        until = time.monotonic() + seconds
        for server in running:
            server.end("local mode was ended", until, even_unsaved=True)
        for server in running:
            server.gone.wait(max(0.0, until - time.monotonic()))
        for server in running:
            if not server.gone.is_set():
                server.kill_at_once()
        until = time.monotonic() + KILLED_SECONDS
        for server in running:
            server.gone.wait(max(0.0, until - time.monotonic()))
        self._shared.closed.set()

    def forget(self, names: Sequence[str] | None = None) -> int:
        """End these servers (None: all) at once and remove their files; return how many were running.

        For servers whose records were deleted: nothing else stops them, and new servers may get their names.
        """
        forgotten = [server for server in self._all() if names is None or server.task.name in names]
        playing = [server for server in forgotten if server.task.status != "STOPPED"]
        for server in playing:
            server.silent = True
            server.end("its record is gone", time.monotonic(), even_unsaved=True)
        for server in playing:
            server.gone.wait(5)
        for server in forgotten:
            self._forget(server)
            self.log(server.task.name).unlink(missing_ok=True)
        return len(playing)

    def playing(self) -> Sequence[TaskRecord]:
        """Return the servers that have not stopped. A warm server's `folder` is empty until it is assigned."""
        playing = [server for server in self._all() if server.task.status != "STOPPED"]
        for server in playing:
            with contextlib.suppress(OSError):  # the next look sees it
                server.read_handover()
        return [server.task for server in playing]

    def log(self, name: str) -> Path:
        """Return the log file of the server of this name."""
        return self._shared.log(name)

    def _all(self) -> Sequence[TaskProcess]:
        with self._lock:
            return [*self._servers.values()]

    def _forget(self, server: TaskProcess) -> None:
        with self._lock:
            if self._servers.get(server.task.name) is server:
                del self._servers[server.task.name]
            server.forget()

    def _load(self) -> None:
        """Read the records that an earlier process left. Raises OSError."""
        for task in self._files.load():
            server = self._servers[task.name] = TaskProcess(task, self._shared)
            if task.status == "STOPPED":
                server.gone.set()

    def _prune(self) -> None:
        """Remove the records and logs of stopped servers, except for the newest. Raises OSError."""
        stopped = [server for server in self._all() if server.task.status == "STOPPED"]
        stopped.sort(key=lambda server: server.task.stopped or "", reverse=True)
        for server in stopped[KEPT_LOGS:]:
            self.log(server.task.name).unlink(missing_ok=True)
        for server in stopped[KEPT_TASKS:]:
            if not server.unfinished:
                self._forget(server)
