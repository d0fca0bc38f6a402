"""Servers as processes of this machine, and their ECS events.

Each server is `python -m trial` in a process of its own. `task_process.py` follows one from its start to its end; here
are all of them. The next `make run` finds each again by its file on the disk (`task_record.py`).
"""

from __future__ import annotations

import contextlib
import hashlib
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from hippodrome.ports import Address, RunningTask, TaskRequest
from local.backend import files
from local.backend.processes import is_shell, kill, marked
from local.backend.retry import Retry, reports_errors
from local.backend.task_process import Emit, Say, Shared, TaskProcess
from local.backend.task_record import HOST, TaskFolder, TaskRecord, claim_of
from protocol import disk

STOP_TIMEOUT = 30.0  # seconds from SIGTERM to SIGKILL, the default of ECS and of `STOP_SECONDS` (on AWS: 120)
KEPT_TASKS, KEPT_LOGS = 200, 50  # the most that are kept of servers that are gone

PYTHON_TRIAL = (sys.executable, "-P", "-m", "trial")  # -P: a project's random.py must not stand in for Python's


@reports_errors
class ProcessTasks:
    """Implements `hippodrome.ports.Tasks`. `emit` takes an event and returns when it is stored."""

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
        """`named_port`: the one port at which browsers find all servers by their names (`local/web/names.py`).

        Raises OSError if the files of servers cannot be read or written in `state`.
        """
        self.retry = retry or Retry(say)
        self.logs = state / "logs"
        self._state = state.resolve()
        self._named_port = named_port
        self._files = TaskFolder(self._state / "tasks")
        self._clusters = self._state / "clusters"
        self._shared = Shared(
            state=self._state,
            logs=self.logs,
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
        for folder in (self._files.path, self.logs, self._shared.spool, self._clusters):
            disk.make_folder(folder)
        self._lock = self._shared.lock
        self._live: dict[str, TaskProcess] = {}  # by name; also those that are gone
        self._closing = False
        self._load()

    # The port

    def run(self, request: TaskRequest) -> str:
        claim = claim_of(request)
        known = self._live.get(request.name)
        if known and known.task.claim not in ("", claim):  # its record was deleted with the data, and is a new one
            self.forget([request.name])
        with self._lock:
            if self._closing:
                raise RuntimeError("local mode is ending: no server is started any more")
            known = self._live.get(request.name)
            if known:
                return known.task.arn
            id_ = hashlib.sha256(f"{self._state}\0{request.name}\0{time.time_ns()}".encode()).hexdigest()[:32]
            task = TaskRecord.of(request, id_)
            live = TaskProcess(task, self._shared)
            live.begin(request)
            self._live[request.name] = live
            live.begun.set()
        return task.arn

    def stop(self, task: str, cluster: str, reason: str) -> None:
        live = next((one for one in self._all() if one.task.arn == task), None)
        if live:
            live.end(reason, time.monotonic() + self._shared.stop_timeout)

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        wanted = set(interfaces)
        return {
            task.interface: Address(HOST, self._named_port or task.port)
            for task in (live.task for live in self._all() if live.lives)
            if task.interface in wanted and task.port
        }

    def port_of(self, label: str) -> int | None:
        """The port of the newest server with this name, or of the participant with this id in lower case."""
        there = [live.task for live in self._all() if live.lives and live.task.port]
        named = [task for task in there if label in (task.name, task.folder.rstrip("/").rpartition("/")[2].lower())]
        return max(named, key=lambda task: task.created).port if named else None

    def find(self, name: str, cluster: str) -> str | None:
        live = self._live.get(name)
        return live.task.arn if live and live.lives and live.task.cluster == cluster else None

    def list(self) -> Iterator[RunningTask]:
        for task in (live.task for live in self._all() if live.lives):
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

    # What local mode does with it

    def start(self) -> None:
        """Take over the servers of an earlier process: follow those that still run, and send the end of the others.

        Raises OSError; it may then be called again.
        """
        found = marked(self._state)
        for live in self._all():
            if live.begun.is_set():  # already taken up
                found.pop(live.task.name, None)
                continue
            if live.task.status == "STOPPED":
                if live.unfinished:
                    live.take_up()
                continue
            processes = found.pop(live.task.name, [])
            shell = next((p for p in processes if is_shell(p)), None)
            never = live.task.pid is None and not processes and not self._files.note(live.task.name, "exit")
            if never:
                # The intent was written, but no process began. The message that requested it comes again.
                self._forget(live)
                continue
            if not shell:
                kill(processes)
            elif shell.pid != live.task.pid:
                live.task, live.unsaved = replace(live.task, pid=shell.pid), True
            live.take_up()
        for leaked in found.values():
            kill(leaked)
        with contextlib.suppress(OSError):
            self._prune()

    def close(self, seconds: float = 5.0) -> None:
        """End every server now, SIGTERM first; return when all are gone, at the latest a second after `seconds`."""
        with self._lock:
            self._closing = True
            going = [live for live in self._all() if live.task.status != "STOPPED"]
        until = time.monotonic() + seconds
        for live in going:
            live.end("local mode was ended", until, surely=True)
        for live in going:
            live.gone.wait(max(0.0, until - time.monotonic()))
        for live in going:
            if not live.gone.is_set():
                live.kill_at_once()
        until = time.monotonic() + 1
        for live in going:
            live.gone.wait(max(0.0, until - time.monotonic()))
        self._shared.closed.set()

    def forget(self, names: Sequence[str] | None = None) -> int:
        """End these servers (None: all) at once and remove their files; return how many were running.

        For servers whose records are gone: nothing else would stop them, and their names are free again.
        """
        going = [live for live in self._all() if names is None or live.task.name in names]
        playing = [live for live in going if live.task.status != "STOPPED"]
        for live in playing:
            live.silent = True
            live.end("its record is gone", time.monotonic(), surely=True)
        for live in playing:
            live.gone.wait(5)
        for live in going:
            self._forget(live)
            self.log(live.task.name).unlink(missing_ok=True)
        return len(playing)

    def playing(self) -> Sequence[TaskRecord]:
        """The servers that have not stopped. A warm server has a `folder` once it is assigned."""
        there = [live for live in self._all() if live.task.status != "STOPPED"]
        for live in there:
            with contextlib.suppress(OSError):  # the next look sees it
                live.read_handover()
        return [live.task for live in there]

    def log(self, name: str) -> Path:
        """The log file of the server of this name."""
        return self._shared.log(name)

    def _all(self) -> Sequence[TaskProcess]:
        with self._lock:
            return [*self._live.values()]

    def _forget(self, live: TaskProcess) -> None:
        with self._lock:
            if self._live.get(live.task.name) is live:
                del self._live[live.task.name]
            live.forget()

    def _load(self) -> None:
        for task in self._files.load():
            live = self._live[task.name] = TaskProcess(task, self._shared)
            if task.status == "STOPPED":
                live.gone.set()

    def _prune(self) -> None:
        """Forget servers that are long gone."""
        gone = [live for live in self._all() if live.task.status == "STOPPED"]
        gone.sort(key=lambda live: live.task.stopped or "", reverse=True)
        for live in gone[KEPT_LOGS:]:
            self.log(live.task.name).unlink(missing_ok=True)
        for live in gone[KEPT_TASKS:]:
            if not live.unfinished:
                self._forget(live)
