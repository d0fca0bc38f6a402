"""Servers as processes of this machine, and the ECS events that tell of them.

Each server is `python -m trial` in a session of its own, below a shell that does nothing but wait for it and write down
its exit status: so that the status is known even if this process was killed and started again meanwhile. Both carry
the mark `-X hippodrome={state folder}/{name}` in their command line, by which they are found again; a process id alone
proves nothing, since the system gives it to somebody else one day.

The order in which things are written is what keeps anything from leaking:
the intent, then the process, then its id; an event, then that it was sent. A kill in between repeats the event.

Each server has a thread that follows it from its start to its end. What the machine refuses this thread is tried again
until it works (`retry.py`), so that the end of each server is noticed: also with a full disk, and with a data folder
on another file system.
"""

from __future__ import annotations

import contextlib
import errno
import filecmp
import hashlib
import http.client
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

import psutil

from hippodrome.ports import Address, Refused, RunningTask, TaskRequest
from local.backend import files
from local.backend.retry import Retry, reports_errors, start_thread
from protocol import environment, handover
from protocol.keys import handover_key, participant_folder
from trial import disk
from trial.spool import with_number

ARN = "arn:aws:ecs:local:000000000000"
HOST = "127.0.0.1"
STOP_TIMEOUT = 30.0  # seconds from SIGTERM to SIGKILL, as on Fargate
START_TIMEOUT = 120.0  # seconds in which a server must listen
RESCUE_TIMEOUT = 10.0  # seconds that the next server waits for recordings of the last one which cannot be moved
KEPT_TASKS, KEPT_LOGS = 200, 50  # of servers that are gone

PYTHON_TRIAL = (sys.executable, "-P", "-m", "trial")  # -P: a project's random.py must not stand in for Python's
_SHELL = '"$@" & echo $! > "$0.pid"; wait $!; status=$?; echo $status > "$0.exit"; exit $status'
_AWS = ("AWS_", "ECS_")  # variables that a server must not inherit: it has no business with anybody's credentials

# What the system says of a command that cannot be run, however often it is tried.
_REFUSED = (errno.ENOENT, errno.ENOTDIR, errno.EACCES, errno.EPERM, errno.ENOEXEC, errno.E2BIG, errno.EINVAL)

T = TypeVar("T")
Emit = Callable[[Mapping[str, Any]], None]
Say = Callable[[str], None]
_Marked = dict[str, list[psutil.Process]]


@dataclass(frozen=True)
class Task:
    """What is written down of a task. Immutable: a change is a new one."""

    name: str
    cluster: str
    id: str
    created: str
    pid: int | None = None  # of the shell, which leads the process group
    port: int | None = None
    status: str = "PROVISIONING"  # the last status that was told
    version: int = 0
    started: str | None = None
    stopped: str | None = None
    asked: str | None = None  # why it was asked to stop
    folder: str = (
        ""  # the participant's, below the data folder and the spool; of a warm server that nobody has taken, empty
    )
    server: str = ""  # what its recordings' folder is called, if not by its own name
    warm_server: str = ""  # of a warm server, the document that says whose it is
    kept: bool = False  # whether recordings belong into the data folder
    claim: str = ""  # a hash of its token: which server of that name it is

    @property
    def arn(self) -> str:
        return f"{ARN}:task/{self.cluster}/{self.id}"

    @property
    def interface(self) -> str:
        return f"eni-{self.id[:17]}"


@dataclass
class _Live:
    """A task together with what only this process knows of it."""

    task: Task
    begun: threading.Event = field(default_factory=threading.Event)  # there is a process, or there will be none
    gone: threading.Event = field(default_factory=threading.Event)  # the process is gone and the event is sent
    forgotten: threading.Event = field(default_factory=threading.Event)  # nothing is written down of it any more
    silent: bool = False  # no more events: its record is gone, and a new server may have its name
    unsaved: bool = False  # the task has changed since it was written down
    child: subprocess.Popen[bytes] | None = None
    ending: threading.Thread | None = None
    exit_code: int | None = None
    over: bool = False  # its process is gone; the event that says so may not have been sent yet

    @property
    def lives(self) -> bool:
        """Whether it counts as running: as in ECS's lists, not any more once it was asked to stop."""
        return not self.over and self.task.status != "STOPPED" and self.task.asked is None


@reports_errors
class ProcessTasks:
    """Implements `hippodrome.ports.Tasks`. `emit` takes the events; it must have kept one when it returns."""

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
    ) -> None:
        """Raises OSError if what is written down of servers cannot be read or kept there."""
        self.retry = retry or Retry(say)
        self.logs = state / "logs"
        self._state = state.resolve()
        self._data = data.resolve()
        self._project = project_folder.resolve()
        self._emit = emit
        self._command = tuple(command)
        self._stop_timeout = stop_timeout
        self._say = say
        self._folder = self._state / "tasks"
        self._spool = self._state / "spool"
        self._clusters = self._state / "clusters"
        for folder in (self._folder, self.logs, self._spool, self._clusters):
            disk.make_folder(folder)
        self._lock = threading.RLock()
        self._live: dict[str, _Live] = {}  # by name; also those that are gone
        self._closing = False
        self._closed = threading.Event()
        self._load()

    # The port

    def run(self, request: TaskRequest) -> str:
        claim = hashlib.sha256(request.environment.get(environment.TOKEN, "").encode()).hexdigest()[:16]
        known = self._live.get(request.name)
        if known and known.task.claim not in ("", claim):  # its record was deleted with the data, and is a new one
            self.forget([request.name])
        with self._lock:
            if self._closing:
                raise RuntimeError("local mode is ending: no server is started any more")
            known = self._live.get(request.name)
            if known:
                return known.task.arn
            task = Task(
                name=request.name,
                cluster=request.cluster,
                id=hashlib.sha256(f"{self._state}\0{request.name}\0{time.time_ns()}".encode()).hexdigest()[:32],
                created=_now(),
                folder=_folder(request.environment),
                warm_server=_warm_server(request),
                kept=_kept(request.environment),
                claim=claim,
            )
            self._begin(_Live(task), request)
        return task.arn

    def stop(self, task: str, cluster: str, reason: str) -> None:
        live = next((one for one in self._all() if one.task.arn == task), None)
        if live:
            self._end(live, reason, time.monotonic() + self._stop_timeout)

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        wanted = set(interfaces)
        return {
            task.interface: Address(HOST, task.port)
            for task in (live.task for live in self._all() if live.lives)
            if task.interface in wanted and task.port
        }

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
        """Take up what an earlier process left: servers that still play go on, the end of the others is told.

        Raises OSError; may then be called again.
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
            shell = next((p for p in processes if _is_shell(p)), None)
            never = live.task.pid is None and not processes and not self._note(live.task.name, "exit")
            if never:
                # The intent was written and nothing begun. The message that asked for it comes again.
                self._forget(live)
                continue
            if not shell:
                _kill(processes)
            elif shell.pid != live.task.pid:
                live.task, live.unsaved = replace(live.task, pid=shell.pid), True
            self._take_up(live)
        for leaked in found.values():
            _kill(leaked)
        with contextlib.suppress(OSError):
            self._prune()

    def close(self, seconds: float = 5.0) -> None:
        """End every server now, SIGTERM first; returns when all are gone, at the latest a second after `seconds`."""
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
                _kill_group(live.task.pid if self._may_live(live) else None)
        until = time.monotonic() + 1
        for live in going:
            live.gone.wait(max(0.0, until - time.monotonic()))
        self._closed.set()

    def forget(self, names: Sequence[str] | None = None) -> int:
        """End these servers (all of them) at once, as if they had never been; how many were there.

        For those whose records are gone: nobody may stop them any more, and their names are to be had again.
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
        """The servers whose processes are there. A warm server has a folder from when it has a participant."""
        there = [live for live in self._all() if live.task.status != "STOPPED"]
        for live in there:
            with contextlib.suppress(OSError):  # the next look sees it
                self._see_whose(live)
        return [live.task for live in there]

    def log(self, name: str) -> Path:
        """Where the server of that name writes what it has to say."""
        return self.logs / f"{name}.log"

    # One process

    def _begin(self, live: _Live, request: TaskRequest) -> None:
        """Start the process and the thread that follows it. If one cannot be had, there is neither."""
        name = request.name
        self._save(live)
        for kind in ("pid", "exit"):
            self._file(name, kind).unlink(missing_ok=True)
        try:
            self._follow(live)
            live.child = self._spawn(request)
        except BaseException:
            live.forgotten.set()
            live.begun.set()
            disk.remove_if_possible(self._file(name))  # if it stays, the next start sees that nothing was begun
            raise
        # From here on there is a process, and nothing may fail. The thread writes the rest down.
        live.task, live.unsaved = replace(live.task, pid=live.child.pid), True
        self._live[name] = live
        live.begun.set()

    def _spawn(self, request: TaskRequest) -> subprocess.Popen[bytes]:
        """Raises `Refused` if the command can never be run, and OSError if it may be later."""
        mark = self._mark(request.name)
        command = [self._command[0], "-X", mark, *self._command[1:]]
        with self.log(request.name).open("wb") as log:
            try:
                return subprocess.Popen(  # noqa: S603 - our own command
                    ["/bin/sh", "-c", _SHELL, str(self._folder / request.name), *command],
                    env=self._environment(request),
                    cwd=self._project,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                )
            except OSError as error:
                if error.errno in _REFUSED:
                    raise Refused(f"{self._command[0]}: {error.strerror}") from error
                raise

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
            environment.AGENT_DIR: str(self._project),
            "PYTHONPATH": os.pathsep.join(paths),
            "PYTHONUNBUFFERED": "1",
        }

    def _follow(self, live: _Live) -> None:
        start_thread(self._life, live, name=f"task {live.task.name}")

    def _take_up(self, live: _Live) -> None:
        self._follow(live)
        live.begun.set()

    def _life(self, live: _Live) -> None:
        """From the start to the end of a process: tells of each change, and writes down that it was told."""
        live.begun.wait()
        if live.task.status != "STOPPED":
            self._retry(live, lambda: self._see_start(live))
            self._retry(live, lambda: self._wait(live))
            self._rescue_in_time(live)
            self._retry(live, lambda: self._tell_end(live))
        self._retry(live, lambda: self._clear(live))
        live.gone.set()

    def _retry(self, live: _Live, act: Callable[[], T], seconds: float | None = None) -> T | None:
        """The result of `act`, tried again until it works, or until nothing is to be written down any more."""

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
        if live.task.asked:  # by a process that was killed before it could see to it
            self._end(live, live.task.asked, time.monotonic() + self._stop_timeout)
        if live.task.status == "PROVISIONING" and self._listens(live):
            self._tell(live, status="RUNNING", started=_now())

    def _listens(self, live: _Live) -> bool:
        """Wait until the server answers; False if it is gone. One that takes too long is ended. Raises OSError."""
        until = time.monotonic() + START_TIMEOUT
        while self._lives(live):
            port = _port(self.log(live.task.name))
            if port and _healthy(port):
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
        return _process(live.task.pid, self._mark(live.task.name)) is not None

    def _may_live(self, live: _Live) -> bool:
        try:
            return self._lives(live)
        except OSError:
            return True

    def _wait(self, live: _Live) -> None:
        """Until it is gone; then what it has left running goes too, as it would with a container."""
        process = live.child or _process(live.task.pid, self._mark(live.task.name))
        if process:
            process.wait()
            _kill_group(process.pid)

    def _tell_end(self, live: _Live) -> None:
        if live.task.status == "STOPPED":  # told, but not yet written down
            self._save(live)
            return
        live.exit_code = self._exit_code(live)
        live.over = True  # before the event is sent: who has heard of its end finds it among the running no more
        self._tell(live, status="STOPPED", stopped=_now())

    def _exit_code(self, live: _Live) -> int | None:
        note = self._note(live.task.name, "exit")
        if note.isdecimal():
            return int(note)
        if live.child and live.child.returncode is not None and live.child.returncode >= 0:
            return live.child.returncode  # the shell's, which is that of the server: it could not write it down
        return 137 if live.task.pid else None  # the shell was killed with it

    def _clear(self, live: _Live) -> None:
        """What is left to do when its end has been told."""
        try:
            self._rescue(live)
            for kind in ("pid", "exit"):
                self._file(live.task.name, kind).unlink(missing_ok=True)
        finally:
            live.gone.set()  # nobody need wait for what cannot be done at once

    # Its end

    def _end(self, live: _Live, reason: str, until: float, *, surely: bool = False) -> None:
        """Ask it to end, and make sure of it at that time (monotonic); returns at once.

        Raises OSError, and then it is not asked to; `surely` asks it even if that cannot be written down.
        """
        with self._lock:
            if live.task.status == "STOPPED":
                return
            try:
                self._see_whose(live)  # who asks for the end removes the document that says it
                self._see_out_later(live, until)
                self._save(live, asked=live.task.asked or reason)
            except OSError:
                if not surely:
                    raise
                live.task, live.unsaved = replace(live.task, asked=live.task.asked or reason), True
                try:
                    self._see_out_later(live, until)
                except OSError:  # no thread is to be had: no time for a goodbye
                    _kill_group(live.task.pid if self._may_live(live) else None)

    def _see_out_later(self, live: _Live, until: float) -> None:
        if not (live.ending and live.ending.is_alive()):
            live.ending = start_thread(self._see_out, live, until, name=f"end {live.task.name}")

    def _see_out(self, live: _Live, until: float) -> None:
        with self._lock:  # held by `_end` until the reason is written down
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
        """Send SIGTERM to the server; whether it is there. Raises OSError."""
        note, mark = self._note(live.task.name, "pid"), self._mark(live.task.name)
        server = _process(int(note), mark) if note.isdecimal() else _child(live.task.pid, mark)
        if server is None:
            return False
        with contextlib.suppress(psutil.NoSuchProcess):
            server.terminate()
        return True

    def _kill(self, live: _Live) -> None:
        if not live.gone.is_set() and self._lives(live):
            _kill_group(live.task.pid)

    # Its recordings

    def _see_whose(self, live: _Live) -> None:
        """Write down whose a warm server has become, if it has. Raises OSError if that cannot be seen or written."""
        with self._lock, contextlib.suppress(FileNotFoundError, handover.BadHandover):
            task = live.task
            if task.warm_server and not task.folder and self._live.get(task.name) is live:
                found = handover.parse((self._data / task.warm_server).read_bytes())
                project = task.warm_server.partition("/")[0]
                folder = participant_folder(project, found.user_id).rstrip("/")
                self._save(live, folder=folder, server=found.server)

    def _rescue_in_time(self, live: _Live) -> None:
        """Save the recordings before the end is told, since the next server goes on from them; but not at any price."""
        try:
            self._retry(live, lambda: self._rescue(live), RESCUE_TIMEOUT)
        except Exception:  # noqa: BLE001 - it is tried again when the end has been told
            self._say(f"a recording of server {live.task.name} cannot be moved to the data yet; it is tried again")

    def _rescue(self, live: _Live) -> None:
        """Put recordings that a killed server left unfinished where they belong; they can be read up to their end."""
        self._see_whose(live)
        for left in self._leftovers(live.task):
            place = self._data / left.relative_to(self._spool)
            _move(left, place.with_name(place.name.removesuffix(".part")))

    def _leftovers(self, task: Task) -> Sequence[Path]:
        """The recordings in the spool that belong into the data folder. Raises OSError."""
        if not (task.kept and task.folder):
            return []
        folder = self._spool / f"{task.folder}/trials/{task.server or task.name}"
        return [folder / name for name in files.names(folder, ".part")] if files.exists(folder) else []

    # What is written down

    def _all(self) -> Sequence[_Live]:
        with self._lock:
            return [*self._live.values()]

    def _file(self, name: str, kind: str = "json") -> Path:
        return self._folder / f"{name}.{kind}"

    def _note(self, name: str, kind: str) -> str:
        """What the shell has written; empty if it has not. Raises OSError."""
        try:
            return self._file(name, kind).read_text().strip()
        except FileNotFoundError:
            return ""

    def _save(self, live: _Live, **changes: Any) -> None:
        """Change the task, once that is on the disk. Raises OSError."""
        with self._lock:
            task = replace(live.task, **changes)
            if not live.forgotten.is_set():
                # After a power cut every process is gone: to know that there was one is enough to tell its end.
                files.write_json(self._file(task.name), asdict(task), surely=task.version == 0)
            live.task, live.unsaved = task, False

    def _forget(self, live: _Live) -> None:
        with self._lock:
            live.forgotten.set()
            if self._live.get(live.task.name) is live:
                del self._live[live.task.name]
            self._file(live.task.name).unlink(missing_ok=True)

    def _load(self) -> None:
        for name in files.names(self._folder, ".json"):
            kept = files.read_json(self._folder / name)
            with contextlib.suppress(TypeError):
                live = _Live(Task(**kept))
                self._live[live.task.name] = live
                if live.task.status == "STOPPED":
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
        return mark(self._state, name)


def mark(state: Path, name: str) -> str:
    """What is in the command line of a server's processes."""
    return f"hippodrome={state.resolve() / 'tasks' / name}"


def marked(state: Path) -> _Marked:
    """Every process that carries the mark of this state folder, by the server's name."""
    found: _Marked = {}
    ours = mark(state, "") + "/"
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            for word in process.cmdline():
                name = word.removeprefix(ours)
                if name != word and "/" not in name:
                    found.setdefault(name, []).append(process)
    return found


def end_everything(state: Path) -> None:
    """Kill whatever servers of this state folder there are."""
    for processes in marked(state).values():
        _kill(processes)


def event(task: Task, exit_code: int | None = None) -> dict[str, Any]:
    """The "ECS Task State Change" event of EventBridge for this state of a task."""
    details = {"subnetId": "subnet-local", "networkInterfaceId": task.interface, "privateIPv4Address": HOST}
    detail: dict[str, Any] = {
        "taskArn": task.arn,
        "clusterArn": f"{ARN}:cluster/{task.cluster}",
        "taskDefinitionArn": f"{ARN}:task-definition/local:1",
        "group": "family:local",
        "launchType": "FARGATE",
        "lastStatus": task.status,
        "desiredStatus": "STOPPED" if task.asked or task.status == "STOPPED" else "RUNNING",
        "startedBy": task.name,
        "version": task.version,
        "createdAt": task.created,
        "updatedAt": _now(),
        "attachments": [
            {
                "id": f"{task.id[:8]}-attachment",
                "type": "eni",
                "status": {"RUNNING": "ATTACHED", "STOPPED": "DELETED"}.get(task.status, "PRECREATED"),
                "details": [{"name": name, "value": value} for name, value in details.items()],
            }
        ],
        "containers": [{"name": "trial", "lastStatus": task.status, "taskArn": task.arn}],
    }
    if task.started:
        detail["startedAt"] = task.started
    if task.status == "STOPPED":
        detail["stoppedAt"] = task.stopped
        if task.asked:
            detail |= {"stopCode": "UserInitiated", "stoppedReason": task.asked}
        elif exit_code is None:
            detail |= {"stopCode": "TaskFailedToStart", "stoppedReason": "The process could not be started"}
        else:
            detail |= {"stopCode": "EssentialContainerExited", "stoppedReason": "Essential container in task exited"}
        if exit_code is not None:
            detail["containers"][0]["exitCode"] = exit_code
    return {
        "version": "0",
        "id": f"{task.id[:8]}-{task.version}",
        "detail-type": "ECS Task State Change",
        "source": "aws.ecs",
        "account": "000000000000",
        "time": _now(),
        "region": "local",
        "resources": [task.arn],
        "detail": detail,
    }


def _folder(told: Mapping[str, str]) -> str:
    """Where everything of the participant lies; empty for a warm server."""
    user_id = told.get(environment.USER_ID)
    return participant_folder(told.get(environment.PROJECT_ID, ""), user_id).rstrip("/") if user_id else ""


def _warm_server(request: TaskRequest) -> str:
    """The document that says whose a warm server is, below the data folder; empty for any other server."""
    told = request.environment
    if told.get(environment.WARM_SERVER) != "on":
        return ""
    return handover_key(told.get(environment.PROJECT_ID, ""), told.get(environment.SERVER, ""))


def _kept(told: Mapping[str, str]) -> bool:
    """Whether the project wants recordings kept (`s3upload`)."""
    try:
        return json.loads(told[environment.TRIAL]).get("s3upload") is not False
    except (KeyError, ValueError, AttributeError):
        return False


def _port(log: Path) -> int | None:
    """The port that the server has written down as the first thing."""
    try:
        text = log.read_bytes()
    except FileNotFoundError:
        return None
    for line in text.split(b"\n")[:-1]:
        if line.startswith(b'{"port"'):
            with contextlib.suppress(ValueError, KeyError, TypeError):
                return int(json.loads(line)["port"])
    return None


def _healthy(port: int) -> bool:
    connection = http.client.HTTPConnection(HOST, port, timeout=2)
    try:
        connection.request("GET", "/healthz")
        return connection.getresponse().status == 200
    except (ConnectionError, TimeoutError, http.client.HTTPException):
        return False
    finally:
        connection.close()


def _process(pid: int | None, mark: str) -> psutil.Process | None:
    """The process of that id, if it is the one that carries the mark."""
    if pid is None:
        return None
    try:
        process = psutil.Process(pid)
        return process if mark in process.cmdline() else None
    except psutil.Error:
        return None


def _child(shell: int | None, mark: str) -> psutil.Process | None:
    """The server that this shell has started, if its id could not be written down."""
    try:
        children = psutil.Process(shell).children() if shell else []
    except psutil.Error:
        return None
    found = (_process(child.pid, mark) for child in children)
    return next((process for process in found if process and not _is_shell(process)), None)


def _move(file: Path, place: Path) -> None:
    """Move a recording, also to another file system; nothing is overwritten. May be interrupted, and done again."""
    disk.make_folder(place.parent)
    for number in count(1):
        numbered = place.with_name(with_number(place.name, number))
        try:
            disk.move(file, numbered)
        except FileExistsError:
            if not filecmp.cmp(file, numbered, shallow=False):
                continue  # another recording of that name
        break
    file.unlink(missing_ok=True)


def _is_shell(process: psutil.Process) -> bool:
    try:
        return _SHELL in process.cmdline()
    except psutil.Error:
        return False


def _kill(processes: Sequence[psutil.Process]) -> None:
    """Kill processes that carry a mark, and what they have started: each server leads a group of its own."""
    for process in processes:
        with contextlib.suppress(psutil.Error, OSError):
            _kill_group(os.getpgid(process.pid) if process.is_running() else None)


def _kill_group(pid: int | None) -> None:
    if pid:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(pid, signal.SIGKILL)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
