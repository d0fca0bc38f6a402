"""One server: its process, which a thread follows from its start to its end, and the ECS events that tell of it.

If this machine refuses something, the thread tries again until it succeeds (`retry.py`). So it notices the end of each
server, even with a full disk.
"""

from __future__ import annotations

import contextlib
import errno
import filecmp
import http.client
import json
import os
import secrets
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

from hippodrome.console.run_state import mark_of
from hippodrome.control.config import layout
from hippodrome.control.ports import Refused, TaskRequest
from hippodrome.local.backend.processes import kill_group
from hippodrome.local.backend.retry import Retry, start_thread
from hippodrome.local.inherited import inherited_environment
from hippodrome.protocol import disk, environment, handover
from hippodrome.protocol.keys import handover_key, with_number
from hippodrome.protocol.session import owner_folder

ARN = "arn:aws:ecs:local:000000000000"
HOST = "127.0.0.1"
KILLED = 137
"""The exit code of a process that SIGKILL has ended."""
START_TIMEOUT = 120.0  # seconds in which a server must listen
RESCUE_TIMEOUT = 10.0  # seconds for which the event of a server's end waits for its recordings to be moved

# Errors of a command that can never be run, however often it is tried.
_REFUSED = (errno.ENOENT, errno.ENOTDIR, errno.EACCES, errno.EPERM, errno.ENOEXEC, errno.E2BIG, errno.EINVAL)

T = TypeVar("T")
Emit = Callable[[Mapping[str, Any]], None]
Say = Callable[[str], None]


@dataclass(frozen=True)
class Shared:
    """What all servers of a study share: folders, the command that runs them, and functions to report to."""

    state: Path
    data: Path
    command: Sequence[str]
    stop_timeout: float
    emit: Emit
    say: Say
    retry: Retry
    projects: dict[str, Path] = field(default_factory=dict)
    """The folders of the projects that are served here, by their ids."""
    with_model: set[str] = field(default_factory=set)  # the ids of projects whose games have a language model
    unrecorded: set[str] = field(default_factory=set)  # the ids of projects that keep no recordings (`s3upload`)
    closed: threading.Event = field(default_factory=threading.Event)  # set when this process ends

    def agent_folder(self, project_id: str) -> Path:
        """Return the folder of this project's agent.py."""
        return layout.agent_folder(self.projects[project_id]).resolve()

    def log(self, name: str) -> Path:
        """Return the log file of the server of this name."""
        return self.state / "logs" / f"{name}.log"

    def note(self, name: str) -> Path:
        """Return the file that says of a running server whose it is, and its process id."""
        return self.state / "tasks" / f"{name}.json"

    @property
    def spool(self) -> Path:
        """The folder where servers keep recordings that are not finished."""
        return self.state / "spool"

    def environment(self, request: TaskRequest) -> dict[str, str]:
        """Return the environment variables of a server's process."""
        project_id = request.environment.get(environment.PROJECT_ID, "")
        key = os.environ.get(environment.LLM_KEY)
        return {
            **inherited_environment(),
            # Code of studies without a language model never sees the key.
            **({environment.LLM_KEY: key} if key and project_id in self.with_model else {}),
            **request.environment,
            environment.STORE: str(self.data),
            environment.SPOOL: str(self.spool),
            environment.HOST: HOST,
            environment.PORT: "0",
            environment.TLS: "off",
            environment.AGENT_DIR: str(self.agent_folder(project_id)),
            "PYTHONUNBUFFERED": "1",
        }

    def rescue(self, project_id: str, server: str = "*") -> None:
        """Move recordings that a killed server left unfinished to the data. By default, of all servers of a project.

        They are cut off, but all lines before that place can be read. Raises OSError; it may then be called again.
        """
        if project_id in self.unrecorded:
            return
        for recording in sorted(self.spool.glob(f"{project_id}/*/*/trials/{server}/*.part")):
            if recording.stat().st_size:  # else the disk was full, or the server was killed in the first half second
                _move(recording, (self.data / recording.relative_to(self.spool)).with_suffix(""))
            recording.unlink(missing_ok=True)


class TaskProcess:
    """A server: a process, and the thread that follows it."""

    def __init__(self, request: TaskRequest, shared: Shared) -> None:
        variables = request.environment
        self.name, self.cluster = request.name, request.cluster
        self.token = variables.get(environment.TOKEN)  # by which servers of the same name differ
        self.project_id = variables.get(environment.PROJECT_ID, "")
        self.port: int | None = None
        self.runs = False
        self.over = False  # whether the process is gone; its last event may not be sent yet
        self.asked: str | None = None  # the reason for which it was asked to stop
        self.silent = False  # no event is sent: the server's record was deleted, and a new server may have its name
        self.gone = threading.Event()  # set when the process is gone and its last event is sent
        owner = variables.get(environment.SESSION) or variables.get(environment.USER_ID)
        self.folder = folder_of(self.project_id, owner) if owner else ""
        """The folder of the participant or session, below the data; empty until a warm server is assigned."""
        self.server = request.name
        """The name of its folder of recordings: that of the participant's server."""
        self._handover = ""  # the key of a warm server's handover
        if variables.get(environment.WARM_SERVER) == "on":
            self._handover = handover_key(self.project_id, variables.get(environment.SERVER, ""))
        self._id = secrets.token_hex(16)
        self._shared = shared
        self._process = self._spawn(request)
        try:
            start_thread(self._follow, name=f"task {self.name}")
        except OSError:
            kill_group(self._process.pid)
            self._process.wait()
            raise

    @property
    def arn(self) -> str:
        return f"{ARN}:task/{self.cluster}/{self._id}"

    @property
    def interface(self) -> str:
        return f"eni-{self._id[:17]}"

    @property
    def lives(self) -> bool:
        """Whether the task counts as running. As in ECS's lists, a task that was asked to stop does not."""
        return not self.over and self.asked is None

    def end(self, reason: str, seconds: float) -> None:
        """Send SIGTERM, and SIGKILL after so many seconds. Returns at once."""
        with contextlib.suppress(OSError):
            self.read_handover()  # the caller removes the handover afterwards
        if self.asked is not None or self.over:
            return
        self.asked = reason
        self._process.terminate()
        try:
            start_thread(self._kill_after, seconds, name=f"end {self.name}")
        except OSError:
            self.kill()

    def kill(self) -> None:
        """Send SIGKILL to the process and all that it has started."""
        if not self.over:
            kill_group(self._process.pid)

    def read_handover(self) -> None:
        """If it is a warm server that has been assigned, note for whom. Raises OSError."""
        if self._handover and not self.folder:
            with contextlib.suppress(FileNotFoundError, handover.BadHandover):
                assigned = handover.parse((self._shared.data / self._handover).read_bytes())
                self.server, self.folder = assigned.server, folder_of(self.project_id, assigned.user_id)
                self._note()

    def _spawn(self, request: TaskRequest) -> subprocess.Popen[bytes]:
        """Start the process, in its own session. Raises `Refused` if it can never run, and OSError if it may later."""
        program, *arguments = self._shared.command
        with self._shared.log(self.name).open("wb") as output:
            try:
                return subprocess.Popen(  # noqa: S603 - our own command
                    [program, "-X", mark_of(self._shared.state, self.name), *arguments],
                    env=self._shared.environment(request),
                    cwd=self._shared.agent_folder(self.project_id),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                )
            except OSError as error:
                if error.errno in _REFUSED:
                    raise Refused(f"{program}: {error.strerror}") from error
                raise

    def _follow(self) -> None:
        """Follow the process from its start to its end, and send an event for each change."""
        self._retry(self._note)
        if self._retry(self._listens):
            self.runs = True
            self._tell()
        exit_code = self._process.wait()
        kill_group(self._process.pid)  # what it has left running ends with it, as in a container
        self._rescue_in_time()
        self.over = True  # before the event is sent: its receiver must not find the task in `list`
        self._tell(exit_code if exit_code >= 0 else 128 - exit_code)
        self.gone.set()
        self._retry(self._clear)

    def _retry(self, act: Callable[[], T], seconds: float | None = None) -> T | None:
        """Call `act` until it succeeds, and return its result; None if `run` ends."""
        return self._shared.retry.run(act, self._shared.closed.wait, seconds)

    def _listens(self) -> bool:
        """Wait until the server answers; return False if it ends. Kill it after START_TIMEOUT. Raises OSError."""
        until = time.monotonic() + START_TIMEOUT
        while self._process.poll() is None:
            port = _port_in(self._shared.log(self.name))
            if port and _is_healthy(port):
                self.port = port
                return True
            if time.monotonic() > until:
                log = self._shared.log(self.name)
                self._shared.say(f"server {self.name} does not answer and is ended; see {log}")
                self.kill()
                return False
            time.sleep(0.05)
        return False

    def _kill_after(self, seconds: float) -> None:
        if not self.gone.wait(seconds):
            self.kill()

    def _rescue_in_time(self) -> None:
        """Move the recordings before the event of the end is sent, since the next server resumes from them.

        Give up after RESCUE_TIMEOUT: the participant must not wait for it.
        """
        try:
            self._retry(self._rescue, RESCUE_TIMEOUT)
        except Exception:  # noqa: BLE001 - `_clear` tries again
            self._shared.say(f"a recording of server {self.name} cannot be moved to the data yet; it is tried again")

    def _rescue(self) -> None:
        """Move its unfinished recordings; if its data were deleted, delete them, too. Raises OSError."""
        self.read_handover()
        if self.silent:
            for path in self._shared.spool.glob(f"{self.project_id}/*/*/trials/{self.server}/*.part"):
                path.unlink(missing_ok=True)
        elif self.folder:
            self._shared.rescue(self.project_id, self.server)

    def _clear(self) -> None:
        self._rescue()
        self._shared.note(self.name).unlink(missing_ok=True)

    def _note(self) -> None:
        """Write down whose server it is, and its process id. Raises OSError."""
        disk.replace(
            self._shared.note(self.name), json.dumps({"folder": self.folder, "pid": self._process.pid}).encode()
        )

    def _tell(self, exit_code: int | None = None) -> None:
        """Send the event that it runs, or that it has ended with this exit code."""
        if not self.silent:
            self._shared.emit(
                event(self.name, self.arn, self.cluster, self.interface, exit_code=exit_code, asked=self.asked)
            )


def event(
    name: str, arn: str, cluster: str, interface: str = "", *, exit_code: int | None = None, asked: str | None = None
) -> dict[str, Any]:
    """Return the "ECS Task State Change" event that a task runs; with an exit code, that it has ended.

    `asked` is the reason for which it was asked to stop. The event has what the functions read of one.
    """
    detail: dict[str, Any] = {
        "taskArn": arn,
        "clusterArn": f"{ARN}:cluster/{cluster}",
        "lastStatus": "RUNNING" if exit_code is None else "STOPPED",
        "desiredStatus": "RUNNING" if exit_code is None and asked is None else "STOPPED",
        "startedBy": name,
        "attachments": [{"type": "eni", "details": [{"name": "networkInterfaceId", "value": interface}]}],
    }
    if exit_code is not None:
        killed = ": the process was killed" if exit_code == KILLED else ""
        detail |= {
            "stopCode": "EssentialContainerExited" if asked is None else "UserInitiated",
            "stoppedReason": asked or f"Essential container in task exited{killed}",
            "containers": [{"name": "trial", "exitCode": exit_code}],
        }
    return {"source": "aws.ecs", "detail-type": "ECS Task State Change", "detail": detail}


def folder_of(project_id: str, owner: str) -> str:
    """Return the folder of a participant or a session, relative to the data folder and without a slash at its end.

    `owner` is the participant's or the session's id.
    """
    return owner_folder(project_id, owner).rstrip("/")


def _move(file: Path, place: Path) -> None:
    """Move a recording without overwriting a file, even to another file system. Can be called again if interrupted."""
    disk.make_folder(place.parent)
    for number in count(1):
        numbered = place.with_name(with_number(place.name, number))
        try:
            disk.move(file, numbered)
        except FileExistsError:
            if not filecmp.cmp(file, numbered, shallow=False):
                continue  # another recording has that name
        break


def _port_in(log: Path) -> int | None:
    """The port that the server has written into its log; None if there is none yet. Raises OSError."""
    for line in log.read_bytes().split(b"\n")[:-1]:
        if line.startswith(b'{"port"'):
            with contextlib.suppress(ValueError, KeyError, TypeError):
                return int(json.loads(line)["port"])
    return None


def _is_healthy(port: int) -> bool:
    """Whether the server at this port answers. Raises OSError if this machine refuses the connection."""
    connection = http.client.HTTPConnection(HOST, port, timeout=2)
    try:
        connection.request("GET", "/healthz")
        return connection.getresponse().status == 200
    except (ConnectionError, TimeoutError, http.client.HTTPException):
        return False
    finally:
        connection.close()
