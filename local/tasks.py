"""Servers as processes of this machine, and the ECS events that tell of them.

Each server is `python -m trial` in a session of its own, below a shell that does nothing but wait for it and write down
its exit status: so that the status is known even if this process was killed and started again meanwhile. Both carry
the mark `-X hippodrome={state folder}/{name}` in their command line, by which they are found again; a process id alone
proves nothing, since the system gives it to somebody else one day.

The order in which things are written is what keeps anything from leaking:
the intent, then the process, then its id; an event, then that it was sent. A kill in between repeats the event.
"""

from __future__ import annotations

import contextlib
import errno
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
from pathlib import Path
from typing import Any

import psutil

from hippodrome.platform import Address, NoCapacity, Refused, RunningTask, TaskRequest
from local import files
from trial import spare

ARN = "arn:aws:ecs:local:000000000000"
HOST = "127.0.0.1"
STOP_TIMEOUT = 30.0  # seconds from SIGTERM to SIGKILL, as on Fargate
START_TIMEOUT = 120.0  # seconds in which a server must listen
KEPT_TASKS, KEPT_LOGS = 200, 50  # of servers that are gone

PYTHON_TRIAL = (sys.executable, "-P", "-m", "trial")  # -P: a project's random.py must not stand in for Python's
_SHELL = '"$@" & echo $! > "$0.pid"; wait $!; echo $? > "$0.exit"'
_AWS = ("AWS_", "ECS_")  # variables that a server must not inherit: it has no business with anybody's credentials

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
    folder: str = ""  # the participant's, below the data folder and the spool; of a spare that nobody has taken, empty
    server: str = ""  # what its recordings' folder is called, if not by its own name
    spare: str = ""  # of a spare, the document that says whose it is
    kept: bool = False  # whether recordings belong into the data folder
    claim: str = ""  # a hash of its token: which server of that name it is

    @property
    def arn(self) -> str:
        return f"{ARN}:task/{self.cluster}/{self.id}"

    @property
    def lives(self) -> bool:
        """Whether it counts as running: as in ECS's lists, not any more once it was asked to stop."""
        return self.status != "STOPPED" and self.asked is None

    @property
    def interface(self) -> str:
        return f"eni-{self.id[:17]}"


@dataclass
class _Live:
    """A task together with what only this process knows of it."""

    task: Task
    gone: threading.Event = field(default_factory=threading.Event)  # the process is gone and the event is sent
    child: subprocess.Popen[bytes] | None = None
    ending: threading.Thread | None = None
    exit_code: int | None = None


class ProcessTasks:
    """Implements `hippodrome.platform.Tasks`. `emit` takes the events; it must have kept one when it returns."""

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
    ) -> None:
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
            folder.mkdir(parents=True, exist_ok=True)
        self._lock = threading.RLock()
        self._live: dict[str, _Live] = {}  # by name; also those that are gone
        self._closing = False
        self._load()

    # The port

    def run(self, request: TaskRequest) -> str:
        claim = hashlib.sha256(request.environment.get("TOKEN", "").encode()).hexdigest()[:16]
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
                spare=_spare(request),
                kept=_kept(request.environment),
                claim=claim,
            )
            live = _Live(task)
            self._save(live)
            try:
                live.child = self._spawn(request)
            except OSError as error:
                self._file(request.name).unlink(missing_ok=True)
                if error.errno in (errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE):
                    raise NoCapacity(error.strerror) from error
                raise Refused(f"{self._command[0]}: {error.strerror}") from error
            self._live[request.name] = live
            self._save(live, pid=live.child.pid)
        self._follow(live)
        return task.arn

    def stop(self, task: str, cluster: str, reason: str) -> None:
        live = next((one for one in self._all() if one.task.arn == task), None)
        if live:
            self._end(live, reason, self._stop_timeout)

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        wanted = set(interfaces)
        return {
            task.interface: Address(HOST, task.port)
            for task in (live.task for live in self._all())
            if task.interface in wanted and task.port and task.lives
        }

    def find(self, name: str, cluster: str) -> str | None:
        live = self._live.get(name)
        return live.task.arn if live and live.task.lives and live.task.cluster == cluster else None

    def list(self) -> Iterator[RunningTask]:
        for task in (live.task for live in self._all()):
            if task.lives:
                yield RunningTask(task.arn, task.cluster, task.name)

    def create_cluster(self, name: str) -> None:
        (self._clusters / name).touch()

    def delete_cluster(self, name: str) -> None:
        if any(task.cluster == name for task in self.list()):
            raise RuntimeError("the cluster still contains tasks")
        (self._clusters / name).unlink(missing_ok=True)

    def clusters(self) -> Iterator[str]:
        yield from sorted(path.name for path in self._clusters.iterdir())

    # What local mode does with it

    def start(self) -> None:
        """Take up what an earlier process left: servers that still play go on, the end of the others is told."""
        found = marked(self._state)
        for live in self._all():
            if live.task.status == "STOPPED":
                continue
            processes = found.pop(live.task.name, [])
            shell = next((p for p in processes if _is_shell(p)), None)
            if shell:
                self._save(live, pid=shell.pid)
            elif live.task.pid is None and not processes and not self._note(live.task.name, "exit"):
                # The intent was written and nothing begun. Whoever asked for it asks again.
                with self._lock:
                    self._live.pop(live.task.name)
                    self._file(live.task.name).unlink(missing_ok=True)
                continue
            else:
                _kill(processes)
            self._follow(live)
        for leaked in found.values():
            _kill(leaked)
        self._prune()

    def close(self, seconds: float = 5.0) -> None:
        """End every server now, SIGTERM first; returns when all are gone, at the latest a second after `seconds`."""
        with self._lock:
            self._closing = True
            going = [live for live in self._all() if live.task.status != "STOPPED"]
        for live in going:
            self._end(live, "local mode was ended", seconds)
        until = time.monotonic() + seconds
        for live in going:
            live.gone.wait(max(0.0, until - time.monotonic()))
        for live in going:
            if not live.gone.is_set():
                self._kill(live)
        until = time.monotonic() + 1
        for live in going:
            live.gone.wait(max(0.0, until - time.monotonic()))

    def forget(self, names: Sequence[str] | None = None) -> int:
        """End these servers (all of them) at once, as if they had never been; how many were there.

        For those whose records are gone: nobody may stop them any more, and their names are to be had again.
        """
        going = [live for live in self._all() if names is None or live.task.name in names]
        playing = [live for live in going if live.task.status != "STOPPED"]
        for live in playing:
            self._end(live, "its record is gone", 0)
        for live in playing:
            live.gone.wait(5)
        for live in going:
            with self._lock:
                self._live.pop(live.task.name, None)
                self._file(live.task.name).unlink(missing_ok=True)
            self.log(live.task.name).unlink(missing_ok=True)  # the next of that name writes its port there
        return len(playing)

    def playing(self) -> Sequence[Task]:
        """The servers whose processes are there. A spare has a folder from when it has a participant."""
        there = [live for live in self._all() if live.task.status != "STOPPED"]
        for live in there:
            self._see_whose(live)
        return [live.task for live in there]

    def log(self, name: str) -> Path:
        """Where the server of that name writes what it has to say."""
        return self.logs / f"{name}.log"

    # One process

    def _spawn(self, request: TaskRequest) -> subprocess.Popen[bytes]:
        mark = self._mark(request.name)
        command = [self._command[0], "-X", mark, *self._command[1:]]
        with self.log(request.name).open("ab") as log:
            return subprocess.Popen(  # noqa: S603 - our own command
                ["/bin/sh", "-c", _SHELL, str(self._folder / request.name), *command],
                env=self._environment(request),
                cwd=self._project,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def _environment(self, request: TaskRequest) -> dict[str, str]:
        inherited = {key: value for key, value in os.environ.items() if not key.startswith(_AWS)}
        ours = str(Path(__file__).resolve().parent.parent)
        paths = [ours, *filter(None, [inherited.get("PYTHONPATH")])]
        return {
            **inherited,
            **request.environment,
            "STORE": str(self._data),
            "SPOOL": str(self._spool),
            "HOST": HOST,
            "PORT": "0",
            "TLS": "off",
            "AGENT_DIR": str(self._project),
            "PYTHONPATH": os.pathsep.join(paths),
            "PYTHONUNBUFFERED": "1",
        }

    def _follow(self, live: _Live) -> None:
        thread = threading.Thread(target=self._life, args=[live], name=f"task {live.task.name}", daemon=True)
        thread.start()

    def _life(self, live: _Live) -> None:
        """From the start to the end of a process: tells of each change, and writes down that it was told."""
        try:
            if live.task.version == 0:
                self._tell(live)
            if live.task.asked:  # by a process that was killed before it could see to it
                self._end(live, live.task.asked, self._stop_timeout)
            if live.task.status == "PROVISIONING" and self._listens(live):
                self._tell(live, status="RUNNING", started=_now())
            self._wait(live)
            self._see_whose(live)
            self._rescue(live.task)
            live.exit_code = self._exit_code(live.task)
            self._tell(live, status="STOPPED", stopped=_now())
            for kind in ("pid", "exit"):
                self._file(live.task.name, kind).unlink(missing_ok=True)
        except Exception as error:  # noqa: BLE001 - a full disk must not be silent
            self._say(f"server {live.task.name} is lost sight of: {type(error).__name__}: {error}")
        finally:
            live.gone.set()

    def _listens(self, live: _Live) -> bool:
        """Wait until the server answers; False if it is gone. One that takes too long is ended."""
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

    def _wait(self, live: _Live) -> None:
        """Until it is gone; then what it has left running goes too, as it would with a container."""
        process = live.child or _process(live.task.pid, self._mark(live.task.name))
        if process:
            process.wait()
            _kill_group(process.pid)

    def _exit_code(self, task: Task) -> int | None:
        note = self._note(task.name, "exit")
        if note.isdecimal():
            return int(note)
        return 137 if task.pid else None  # the shell was killed with it

    def _end(self, live: _Live, reason: str, seconds: float) -> None:
        """Ask it to end, and make sure of it after that time; returns at once."""
        with self._lock:
            if live.task.status == "STOPPED":
                return
            self._see_whose(live)  # who asks for the end removes the document that says it
            self._save(live, asked=live.task.asked or reason)
            if live.ending and live.ending.is_alive():
                return
            live.ending = threading.Thread(
                target=self._see_out, args=[live, seconds], name=f"end {live.task.name}", daemon=True
            )
            live.ending.start()

    def _see_out(self, live: _Live, seconds: float) -> None:
        until = time.monotonic() + seconds
        while not live.gone.is_set() and time.monotonic() < until:
            note = self._note(live.task.name, "pid")
            server = _process(int(note), self._mark(live.task.name)) if note.isdecimal() else None
            if server:
                with contextlib.suppress(psutil.NoSuchProcess):
                    server.terminate()
                break
            live.gone.wait(0.02)  # the shell has not started it yet
        if not live.gone.wait(max(0.0, until - time.monotonic())):
            self._kill(live)

    def _kill(self, live: _Live) -> None:
        if not live.gone.is_set() and self._lives(live):
            _kill_group(live.task.pid)

    def _see_whose(self, live: _Live) -> None:
        """Write down whose a spare has become, if it has."""
        with self._lock, contextlib.suppress(OSError, spare.NotGiven):
            task = live.task
            if task.spare and not task.folder and self._live.get(task.name) is live:
                given = spare.parse((self._data / task.spare).read_bytes())
                project = task.spare.partition("/")[0]
                self._save(live, folder=f"{project}/users/{given.user_id}", server=given.server)

    def _rescue(self, task: Task) -> None:
        """Put recordings that a killed server left unfinished where they belong; they can be read up to their end."""
        if not (task.kept and task.folder):
            return
        folder = f"{task.folder}/trials/{task.server or task.name}"
        for left in (self._spool / folder).glob("*.part"):
            place = self._data / folder / left.name.removesuffix(".part")
            place.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileExistsError):
                os.link(left, place)
            left.unlink()

    # What is written down

    def _all(self) -> Sequence[_Live]:
        with self._lock:
            return [*self._live.values()]

    def _file(self, name: str, kind: str = "json") -> Path:
        return self._folder / f"{name}.{kind}"

    def _note(self, name: str, kind: str) -> str:
        """What the shell has written."""
        try:
            return self._file(name, kind).read_text().strip()
        except OSError:
            return ""

    def _save(self, live: _Live, **changes: Any) -> None:
        with self._lock:
            live.task = replace(live.task, **changes)
            files.write_json(self._file(live.task.name), asdict(live.task))

    def _load(self) -> None:
        for path in self._folder.glob("[!.]*.json"):
            kept = files.read_json(path)
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
            with self._lock:
                del self._live[task.name]
                self._file(task.name).unlink(missing_ok=True)

    def _tell(self, live: _Live, **changes: Any) -> None:
        task = replace(live.task, version=live.task.version + 1, **changes)
        self._emit(event(task, live.exit_code))
        self._save(live, version=task.version, **changes)

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


def _folder(environment: Mapping[str, str]) -> str:
    """Where everything of the participant lies; empty if it is nobody's server yet."""
    user_id = environment.get("USER_ID")
    return f"{environment.get('PROJECT_ID', '')}/users/{user_id}" if user_id else ""


def _spare(request: TaskRequest) -> str:
    """The document that says whose a spare is, below the data folder; empty for any other server."""
    told = request.environment
    return spare.key(told.get("PROJECT_ID", ""), told.get("SERVER", "")) if told.get("SPARE") == "on" else ""


def _kept(environment: Mapping[str, str]) -> bool:
    """Whether the project wants recordings kept (`s3upload`)."""
    try:
        return json.loads(environment["TRIAL"]).get("s3upload") is not False
    except (KeyError, ValueError, AttributeError):
        return False


def _port(log: Path) -> int | None:
    """The port that the server has written down as the first thing."""
    try:
        text = log.read_bytes()
    except OSError:
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
    except (OSError, http.client.HTTPException):
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
