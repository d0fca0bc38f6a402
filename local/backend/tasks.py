"""Servers as processes of this machine, and their ECS events.

Each server is `python -m trial` in a process of its own (`processes.py`). The next `make run` finds it again by its
file on the disk (`task_record.py`).

Things are written in an order in which no process leaks: the intent, then the process, then its id; an event, then that
it was sent. If this process is killed in between, the event is repeated.

Each server has a thread that follows it from its start to its end. If the machine refuses something, the thread tries
again until it works (`retry.py`). So it notices the end of each server, even with a full disk, or with a data folder on
another file system.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import psutil

from hippodrome.config import layout
from hippodrome.ports import Address, RunningTask, TaskRequest
from local.backend import files, recordings
from local.backend.health import is_healthy, port_in
from local.backend.processes import (
    child_of,
    is_shell,
    kill,
    kill_group,
    mark_of,
    marked,
    process_of,
    spawn,
)
from local.backend.retry import Retry, reports_errors, start_thread
from local.backend.task_record import HOST, Task, TaskFolder, claim_of, event, now
from protocol import environment, handover
from protocol.keys import participant_folder
from trial.recordings import disk

STOP_TIMEOUT = 30.0  # seconds from SIGTERM to SIGKILL, as on Fargate
START_TIMEOUT = 120.0  # seconds in which a server must listen
RESCUE_TIMEOUT = 10.0  # seconds for which a server's end is held back while its recordings cannot be moved
KEPT_TASKS, KEPT_LOGS = 200, 50  # the most that are kept of servers that are gone

PYTHON_TRIAL = (sys.executable, "-P", "-m", "trial")  # -P: a project's random.py must not stand in for Python's
_AWS = ("AWS_", "ECS_")  # variables that a server must not inherit: it needs no credentials

T = TypeVar("T")
Emit = Callable[[Mapping[str, Any]], None]
Say = Callable[[str], None]


@dataclass
class _Live:
    """A task, with what only this process knows about it."""

    task: Task
    begun: threading.Event = field(default_factory=threading.Event)  # there is a process, or there will be none
    gone: threading.Event = field(default_factory=threading.Event)  # the process is gone and the event is sent
    forgotten: threading.Event = field(default_factory=threading.Event)  # its file is not written any more
    silent: bool = False  # no more events: its record is gone, and a new server may have its name
    unsaved: bool = False  # the task has changed since it was saved
    child: subprocess.Popen[bytes] | None = None
    ending: threading.Thread | None = None
    exit_code: int | None = None
    over: bool = False  # its process is gone; the event that says so may not have been sent yet

    @property
    def lives(self) -> bool:
        """Whether it counts as running. As in ECS's lists, it does not once it was asked to stop."""
        return not self.over and self.task.status != "STOPPED" and self.task.asked is None


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
        self._data = data.resolve()
        self._project = project_folder.resolve()
        self._emit = emit
        self._command = tuple(command)
        self._stop_timeout = stop_timeout
        self._say = say
        self._named_port = named_port
        self._files = TaskFolder(self._state / "tasks")
        self._spool = self._state / "spool"
        self._clusters = self._state / "clusters"
        for folder in (self._files.path, self.logs, self._spool, self._clusters):
            disk.make_folder(folder)
        self._lock = threading.RLock()
        self._live: dict[str, _Live] = {}  # by name; also those that are gone
        self._closing = False
        self._closed = threading.Event()
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
            task = Task.of(request, id_)
            self._begin(_Live(task), request)
        return task.arn

    def stop(self, task: str, cluster: str, reason: str) -> None:
        live = next((one for one in self._all() if one.task.arn == task), None)
        if live:
            self._end(live, reason, time.monotonic() + self._stop_timeout)

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
                if self._leftovers(live.task):
                    self._take_up(live)
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
            self._take_up(live)
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
            self._end(live, "local mode was ended", until, surely=True)
        for live in going:
            live.gone.wait(max(0.0, until - time.monotonic()))
        for live in going:
            if not live.gone.is_set():
                kill_group(live.task.pid if self._may_live(live) else None)
        until = time.monotonic() + 1
        for live in going:
            live.gone.wait(max(0.0, until - time.monotonic()))
        self._closed.set()

    def forget(self, names: Sequence[str] | None = None) -> int:
        """End these servers (None: all) at once and remove their files; return how many were running.

        For servers whose records are gone: nothing else would stop them, and their names are free again.
        """
        going = [live for live in self._all() if names is None or live.task.name in names]
        playing = [live for live in going if live.task.status != "STOPPED"]
        for live in playing:
            live.silent = True
            self._end(live, "its record is gone", time.monotonic(), surely=True)
        for live in playing:
            live.gone.wait(5)
        for live in going:
            self._forget(live)
            self.log(live.task.name).unlink(missing_ok=True)
        return len(playing)

    def playing(self) -> Sequence[Task]:
        """The servers that have not stopped. A warm server has a `folder` once it is assigned."""
        there = [live for live in self._all() if live.task.status != "STOPPED"]
        for live in there:
            with contextlib.suppress(OSError):  # the next look sees it
                self._read_handover(live)
        return [live.task for live in there]

    def log(self, name: str) -> Path:
        """The log file of the server of this name."""
        return self.logs / f"{name}.log"

    # One process

    def _begin(self, live: _Live, request: TaskRequest) -> None:
        """Start the process and the thread that follows it. If one of them cannot be started, there is neither."""
        name = request.name
        self._save(live)
        self._files.remove_notes(name)
        try:
            self._follow(live)
            live.child = self._spawn(request)
        except BaseException:
            live.forgotten.set()
            live.begun.set()
            disk.remove_if_possible(self._files.file(name))  # if it stays, the next start sees that no process began
            raise
        # From here on there is a process, and nothing may fail. The thread saves the rest.
        live.task, live.unsaved = replace(live.task, pid=live.child.pid), True
        self._live[name] = live
        live.begun.set()

    def _spawn(self, request: TaskRequest) -> subprocess.Popen[bytes]:
        """Raises `Refused` if the command can never be run, OSError if it may be possible later."""
        name = request.name
        return spawn(
            self._command,
            self._files.path / name,
            self.log(name),
            mark=self._mark(name),
            folder=self._agent_folder(),
            environment=self._environment(request),
        )

    def _agent_folder(self) -> Path:
        return layout.agent_folder(self._project).resolve()

    def _environment(self, request: TaskRequest) -> dict[str, str]:
        inherited = {key: value for key, value in os.environ.items() if not key.startswith(_AWS)}
        ours = str(Path(__file__).resolve().parents[2])
        paths = [ours, *filter(None, [inherited.get("PYTHONPATH")])]
        return {
            **inherited,
            **request.environment,
            environment.STORE: str(self._data),
            environment.SPOOL: str(self._spool),
            environment.HOST: HOST,
            environment.PORT: "0",
            environment.TLS: "off",
            environment.AGENT_DIR: str(self._agent_folder()),
            "PYTHONPATH": os.pathsep.join(paths),
            "PYTHONUNBUFFERED": "1",
        }

    def _follow(self, live: _Live) -> None:
        start_thread(self._life, live, name=f"task {live.task.name}")

    def _take_up(self, live: _Live) -> None:
        self._follow(live)
        live.begun.set()

    def _life(self, live: _Live) -> None:
        """Follow a process from its start to its end: send an event for each change, and save that it was sent."""
        live.begun.wait()
        if live.task.status != "STOPPED":
            self._retry(live, lambda: self._see_start(live))
            self._retry(live, lambda: self._wait(live))
            self._rescue_in_time(live)
            self._retry(live, lambda: self._tell_end(live))
        self._retry(live, lambda: self._clear(live))
        live.gone.set()

    def _retry(self, live: _Live, act: Callable[[], T], seconds: float | None = None) -> T | None:
        """The result of `act`, tried again until it works; None if this process ends or the server is forgotten."""

        def over() -> bool:
            return self._closed.is_set() or live.forgotten.is_set()

        def wait(pause: float) -> bool:
            return live.forgotten.wait(pause) or over()

        return None if over() else self.retry.run(act, wait, seconds)

    def _see_start(self, live: _Live) -> None:
        if live.task.version == 0:
            self._tell(live)
        elif live.unsaved:
            self._save(live)
        if live.task.asked:  # by a process that was killed before it had ended the server
            self._end(live, live.task.asked, time.monotonic() + self._stop_timeout)
        if live.task.status == "PROVISIONING" and self._listens(live):
            self._tell(live, status="RUNNING", started=now())

    def _listens(self, live: _Live) -> bool:
        """Wait until the server answers; return False if it is gone. Kill it after `START_TIMEOUT`. Raises OSError."""
        until = time.monotonic() + START_TIMEOUT
        while self._lives(live):
            port = port_in(self.log(live.task.name))
            if port and is_healthy(port):
                self._save(live, port=port)
                return True
            if time.monotonic() > until:
                self._say(f"server {live.task.name} does not answer and is ended; see {self.log(live.task.name)}")
                self._kill(live)
                return False
            time.sleep(0.05)
        return False

    def _lives(self, live: _Live) -> bool:
        if live.child:
            return live.child.poll() is None
        return process_of(live.task.pid, self._mark(live.task.name)) is not None

    def _may_live(self, live: _Live) -> bool:
        try:
            return self._lives(live)
        except OSError:
            return True

    def _wait(self, live: _Live) -> None:
        """Wait until it is gone; then kill what it has left running, as the end of a container does."""
        process = live.child or process_of(live.task.pid, self._mark(live.task.name))
        if process:
            process.wait()
            kill_group(process.pid)

    def _tell_end(self, live: _Live) -> None:
        if live.task.status == "STOPPED":  # the event was sent, but that is not saved yet
            self._save(live)
            return
        live.exit_code = self._exit_code(live)
        live.over = True  # before the event is sent: whoever gets it must not find the task in `list`
        self._tell(live, status="STOPPED", stopped=now())

    def _exit_code(self, live: _Live) -> int | None:
        note = self._files.note(live.task.name, "exit")
        if note.isdecimal():
            return int(note)
        if live.child and live.child.returncode is not None and live.child.returncode >= 0:
            return live.child.returncode  # the shell's, which is that of the server: it could not write it down
        return 137 if live.task.pid else None  # the shell was killed with it

    def _clear(self, live: _Live) -> None:
        """Do what is left when the event of its end has been sent."""
        try:
            self._rescue(live)
            self._files.remove_notes(live.task.name)
        finally:
            live.gone.set()  # no caller waits for what cannot be done at once

    # Its end

    def _end(self, live: _Live, reason: str, until: float, *, surely: bool = False) -> None:
        """Send SIGTERM; send SIGKILL at `until` (monotonic). Returns at once.

        Raises OSError if the reason cannot be saved; then no signal is sent. With `surely` it is sent all the same.
        """
        with self._lock:
            if live.task.status == "STOPPED":
                return
            try:
                self._read_handover(live)  # the caller removes the handover afterwards
                self._see_out_later(live, until)
                self._save(live, asked=live.task.asked or reason)
            except OSError:
                if not surely:
                    raise
                live.task, live.unsaved = replace(live.task, asked=live.task.asked or reason), True
                try:
                    self._see_out_later(live, until)
                except OSError:  # no thread can be started: SIGKILL at once
                    kill_group(live.task.pid if self._may_live(live) else None)

    def _see_out_later(self, live: _Live, until: float) -> None:
        if not (live.ending and live.ending.is_alive()):
            live.ending = start_thread(self._see_out, live, until, name=f"end {live.task.name}")

    def _see_out(self, live: _Live, until: float) -> None:
        with self._lock:  # held by `_end` until the reason is saved
            if not live.task.asked:
                return
        self._retry(live, lambda: self._ask_soon(live, until))
        if not live.gone.wait(max(0.0, until - time.monotonic())):
            self._retry(live, lambda: self._kill(live))

    def _ask_soon(self, live: _Live, until: float) -> None:
        """Send SIGTERM to the server as soon as there is one."""
        while not live.gone.is_set() and time.monotonic() < until:
            if self._ask(live):
                break
            live.gone.wait(0.02)  # the shell has not started it yet

    def _ask(self, live: _Live) -> bool:
        """Send SIGTERM to the server; return whether it is there. Raises OSError."""
        note, mark = self._files.note(live.task.name, "pid"), self._mark(live.task.name)
        server = process_of(int(note), mark) if note.isdecimal() else child_of(live.task.pid, mark)
        if server is None:
            return False
        with contextlib.suppress(psutil.NoSuchProcess):
            server.terminate()
        return True

    def _kill(self, live: _Live) -> None:
        if not live.gone.is_set() and self._lives(live):
            kill_group(live.task.pid)

    # Its recordings

    def _read_handover(self, live: _Live) -> None:
        """Save to whom a warm server was assigned, if it was. Raises OSError if that cannot be read or saved."""
        with self._lock, contextlib.suppress(FileNotFoundError, handover.BadHandover):
            task = live.task
            if task.handover_key and not task.folder and self._live.get(task.name) is live:
                found = handover.parse((self._data / task.handover_key).read_bytes())
                project = task.handover_key.partition("/")[0]
                folder = participant_folder(project, found.user_id).rstrip("/")
                self._save(live, folder=folder, server=found.server)

    def _rescue_in_time(self, live: _Live) -> None:
        """Move the recordings before the end is sent: the next server resumes from them. Give up in time."""
        try:
            self._retry(live, lambda: self._rescue(live), RESCUE_TIMEOUT)
        except Exception:  # noqa: BLE001 - `_clear` tries again
            self._say(f"a recording of server {live.task.name} cannot be moved to the data yet; it is tried again")

    def _rescue(self, live: _Live) -> None:
        """Move recordings that a killed server left unfinished to the data folder. Raises OSError."""
        self._read_handover(live)
        recordings.move_to_data(self._spool, self._data, live.task)

    def _leftovers(self, task: Task) -> Sequence[Path]:
        return recordings.unfinished(self._spool, task)

    # What is written down

    def _all(self) -> Sequence[_Live]:
        with self._lock:
            return [*self._live.values()]

    def _save(self, live: _Live, **changes: Any) -> None:
        """Write the changed task to disk, then use it. Raises OSError."""
        with self._lock:
            task = replace(live.task, **changes)
            if not live.forgotten.is_set():
                self._files.save(task)
            live.task, live.unsaved = task, False

    def _forget(self, live: _Live) -> None:
        with self._lock:
            live.forgotten.set()
            if self._live.get(live.task.name) is live:
                del self._live[live.task.name]
            self._files.file(live.task.name).unlink(missing_ok=True)

    def _load(self) -> None:
        for task in self._files.load():
            live = self._live[task.name] = _Live(task)
            if task.status == "STOPPED":
                live.gone.set()

    def _prune(self) -> None:
        """Forget servers that are long gone."""
        gone = [live.task for live in self._all() if live.task.status == "STOPPED"]
        gone.sort(key=lambda task: task.stopped or "", reverse=True)
        for task in gone[KEPT_LOGS:]:
            self.log(task.name).unlink(missing_ok=True)
        for task in gone[KEPT_TASKS:]:
            if not self._leftovers(task):
                self._forget(self._live[task.name])

    def _tell(self, live: _Live, **changes: Any) -> None:
        task = replace(live.task, version=live.task.version + 1, **changes)
        if not live.silent:
            self._emit(event(task, live.exit_code))
        with self._lock:
            live.task, live.unsaved = replace(live.task, version=task.version, **changes), True
            self._save(live)

    def _mark(self, name: str) -> str:
        return mark_of(self._state, name)
