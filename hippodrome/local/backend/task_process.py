"""One task: the process of its server, followed from its start to its end.

No process is lost, even if `run` is killed: the task's record is written before its process begins, and again with
the process id. An event is sent before the record says so; if `hippodrome run` is killed in between, it is sent again.

Each server has a thread that follows it. If this machine refuses something, the thread tries again until it succeeds
(`retry.py`). So it notices the end of each server, even with a full disk.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import psutil

from hippodrome.control.config import layout
from hippodrome.control.ports import TaskRequest
from hippodrome.local.backend import recordings
from hippodrome.local.backend.health import is_healthy, port_in
from hippodrome.local.backend.processes import child_of, kill_group, mark_of, process_of, spawn
from hippodrome.local.backend.retry import Retry, start_thread
from hippodrome.local.backend.task_record import HOST, KILLED, TaskFolder, TaskRecord, event, folder_of, now
from hippodrome.local.inherited import inherited_environment
from hippodrome.protocol import disk, environment, handover

START_TIMEOUT = 120.0  # seconds in which a server must listen
RESCUE_TIMEOUT = 10.0  # seconds for which the event of a server's end waits for its recordings to be moved

T = TypeVar("T")
Emit = Callable[[Mapping[str, Any]], None]
Say = Callable[[str], None]


@dataclass(frozen=True)
class Shared:
    """What all servers of a study share: folders, the command that runs them, and functions to report to."""

    state: Path
    logs: Path
    spool: Path  # where servers keep recordings that are not finished
    files: TaskFolder
    data: Path
    project: Path
    command: Sequence[str]
    stop_timeout: float
    emit: Emit
    say: Say
    retry: Retry
    projects: dict[str, Path] = field(default_factory=dict)
    """The folders of projects by their ids. `project` is the folder of any other."""
    with_model: set[str] = field(default_factory=set)  # the ids of projects whose games have a language model
    lock: threading.RLock = field(default_factory=threading.RLock)
    closed: threading.Event = field(default_factory=threading.Event)  # set when this process ends

    def agent_folder(self, request: TaskRequest) -> Path:
        """Return the folder of agent.py for this server."""
        return layout.agent_folder(self.projects.get(self._project_id(request), self.project)).resolve()

    def log(self, name: str) -> Path:
        """Return the log file of the server of this name."""
        return self.logs / f"{name}.log"

    def environment(self, request: TaskRequest) -> dict[str, str]:
        """Return the environment variables of a server's process."""
        return {
            **inherited_environment(),
            **self._model_key(request),
            **request.environment,
            environment.STORE: str(self.data),
            environment.SPOOL: str(self.spool),
            environment.HOST: HOST,
            environment.PORT: "0",
            environment.TLS: "off",
            environment.AGENT_DIR: str(self.agent_folder(request)),
            "PYTHONUNBUFFERED": "1",
        }

    def _model_key(self, request: TaskRequest) -> dict[str, str]:
        """The key of the language model, for servers of a project that has one: code of other studies never sees it."""
        key = os.environ.get(environment.LLM_KEY)
        return {environment.LLM_KEY: key} if key and self._project_id(request) in self.with_model else {}

    def _project_id(self, request: TaskRequest) -> str:
        return request.environment.get(environment.PROJECT_ID, "")


class TaskProcess:
    """A task with its process, and the thread that follows it."""

    def __init__(self, task: TaskRecord, shared: Shared) -> None:
        self.task = task
        self.begun = threading.Event()  # set when there is a process, or will be none
        self.gone = threading.Event()  # set when the process is gone and its last event is sent
        self.forgotten = threading.Event()  # set when the record's file is removed: it is not written any more
        self.silent = False  # no events are sent: the server's record was deleted, and a new server may have its name
        self.unsaved = False  # whether the task has changed since it was saved
        self._shared = shared
        self._child: subprocess.Popen[bytes] | None = None
        self._ending: threading.Thread | None = None
        self._exit_code: int | None = None
        self._over = False  # whether the process is gone; its last event may not be sent yet

    @property
    def lives(self) -> bool:
        """Whether the task counts as running. As in ECS's lists, a task that was asked to stop does not."""
        return not self._over and self.task.status != "STOPPED" and self.task.asked is None

    # What `ProcessTasks` calls

    def begin(self, request: TaskRequest) -> None:
        """Start the process, and a thread that follows it once the caller has set `begun`.

        If one of the two cannot be started, neither runs. Raises `Refused` if the command can never be run, and OSError
        if it may be possible later.
        """
        self._save()
        self._shared.files.remove_notes(self.task.name)
        try:
            self._follow()
            self._child = self._spawn(request)
        except BaseException:
            self.forgotten.set()
            self.begun.set()
            # If the file stays, `ProcessTasks.start` sees by it that no process began.
            disk.remove_if_possible(self._shared.files.file(self.task.name))
            raise
        # The process runs now, so nothing may fail here: the thread saves its id.
        self.task, self.unsaved = replace(self.task, pid=self._child.pid), True

    def take_up(self) -> None:
        """Follow the process that an earlier `run` has started; if it has ended, send the event of its end."""
        self._follow()
        self.begun.set()

    def end(self, reason: str, until: float, *, even_unsaved: bool = False) -> None:
        """Send SIGTERM, and SIGKILL at the time `until` (`time.monotonic`). Returns at once.

        Raises OSError if the reason cannot be saved; then no signal is sent, unless `even_unsaved` is True.
        """
        with self._shared.lock:
            if self.task.status == "STOPPED":
                return
            try:
                self.read_handover()  # the caller removes the handover afterwards
                self._see_out_later(until)
                self._save(asked=self.task.asked or reason)
            except OSError:
                if not even_unsaved:
                    raise
                self.task, self.unsaved = replace(self.task, asked=self.task.asked or reason), True
                try:
                    self._see_out_later(until)
                except OSError:  # no thread can be started: SIGKILL at once
                    self.kill_at_once()

    def kill_at_once(self) -> None:
        """Send SIGKILL, unless the process is known to have ended."""
        try:
            lives = self._lives()
        except OSError:
            lives = True
        if lives:
            kill_group(self.task.pid)

    def forget(self) -> None:
        """Remove the task's file, and do not write it again. Raises OSError."""
        self.forgotten.set()
        self._shared.files.file(self.task.name).unlink(missing_ok=True)

    def read_handover(self) -> None:
        """If the task is a warm server that has been assigned, save its participant or session. Raises OSError."""
        with self._shared.lock, contextlib.suppress(FileNotFoundError, handover.BadHandover):
            task = self.task
            if task.handover_key and not task.folder and not self.forgotten.is_set():
                handover_read = handover.parse((self._shared.data / task.handover_key).read_bytes())
                project = task.handover_key.partition("/")[0]
                self._save(folder=folder_of(project, handover_read.user_id), server=handover_read.server)

    @property
    def unfinished(self) -> Sequence[Path]:
        """The task's recordings that are still in the spool. Raises OSError."""
        return recordings.unfinished(self._shared.spool, self.task)

    # Its process

    def _spawn(self, request: TaskRequest) -> subprocess.Popen[bytes]:
        return spawn(
            self._shared.command,
            self._shared.files.path / self.task.name,
            self._log,
            mark=self._mark,
            folder=self._shared.agent_folder(request),
            environment=self._shared.environment(request),
        )

    def _follow(self) -> None:
        start_thread(self._life, name=f"task {self.task.name}")

    def _life(self) -> None:
        """Follow the process from its start to its end: send an event for each change, and save that it was sent."""
        self.begun.wait()
        if self.task.status != "STOPPED":
            self._retry(self._see_start)
            self._retry(self._wait)
            self._rescue_in_time()
            self._retry(self._send_end)
        self._retry(self._clear)
        self.gone.set()

    def _retry(self, act: Callable[[], T], seconds: float | None = None) -> T | None:
        """Call `act` until it succeeds, and return its result; None if `run` ends or the server is forgotten."""

        def over() -> bool:
            return self._shared.closed.is_set() or self.forgotten.is_set()

        def wait(pause: float) -> bool:
            return self.forgotten.wait(pause) or over()

        return None if over() else self._shared.retry.run(act, wait, seconds)

    def _see_start(self) -> None:
        """Send the events PROVISIONING and RUNNING, if they have not been sent. Raises OSError."""
        if self.task.version == 0:
            self._send()
        elif self.unsaved:
            self._save()
        if self.task.asked:  # an earlier `hippodrome run` told it to stop, and was killed before it had ended
            self.end(self.task.asked, time.monotonic() + self._shared.stop_timeout)
        if self.task.status == "PROVISIONING" and self._listens():
            self._send(status="RUNNING", started=now())

    def _listens(self) -> bool:
        """Wait until the server answers; return False if it ends. Kill it after `START_TIMEOUT`. Raises OSError."""
        until = time.monotonic() + START_TIMEOUT
        while self._lives():
            port = port_in(self._log)
            if port and is_healthy(port):
                self._save(port=port)
                return True
            if time.monotonic() > until:
                self._shared.say(f"server {self.task.name} does not answer and is ended; see {self._log}")
                self._kill()
                return False
            time.sleep(0.05)
        return False

    def _lives(self) -> bool:
        if self._child:
            return self._child.poll() is None
        return process_of(self.task.pid, self._mark) is not None

    def _wait(self) -> None:
        """Wait until it ends; then kill what it has left running, as the end of a container does."""
        process = self._child or process_of(self.task.pid, self._mark)
        if process:
            process.wait()
            kill_group(process.pid)

    def _send_end(self) -> None:
        """Send the event STOPPED, if it has not been sent. Raises OSError."""
        if self.task.status == "STOPPED":  # the event was sent, but that is not saved yet
            self._save()
            return
        self._exit_code = self._find_exit_code()
        self._over = True  # before the event is sent: its receiver must not find the task in `list`
        self._send(status="STOPPED", stopped=now())

    def _find_exit_code(self) -> int | None:
        """The server's exit code; None if no process began. Raises OSError."""
        note = self._shared.files.note(self.task.name, "exit")
        if note.isdecimal():
            return int(note)
        if self._child and self._child.returncode is not None and self._child.returncode >= 0:
            return self._child.returncode  # the server's code; the shell could not write its note
        return KILLED if self.task.pid else None  # the shell was killed with the server, and wrote no note

    def _clear(self) -> None:
        """Move the recordings that are left, and remove the notes of the shell. Raises OSError."""
        try:
            self._rescue()
            self._shared.files.remove_notes(self.task.name)
        finally:
            self.gone.set()  # set even if a step above fails: no caller waits until all succeed

    # Its end

    def _see_out_later(self, until: float) -> None:
        """Start the thread that ends the server, if none does so already. Raises OSError."""
        if not (self._ending and self._ending.is_alive()):
            self._ending = start_thread(self._see_out, until, name=f"end {self.task.name}")

    def _see_out(self, until: float) -> None:
        """Send SIGTERM, and SIGKILL at `until`."""
        with self._shared.lock:  # held by `end` until the reason is saved
            if not self.task.asked:
                return
        self._retry(lambda: self._terminate_soon(until))
        if not self.gone.wait(max(0.0, until - time.monotonic())):
            self._retry(self._kill)

    def _terminate_soon(self, until: float) -> None:
        """Send SIGTERM to the server as soon as there is one."""
        while not self.gone.is_set() and time.monotonic() < until:
            if self._terminate():
                break
            self.gone.wait(0.02)  # the shell has not started the server yet

    def _terminate(self) -> bool:
        """Send SIGTERM to the server; return False if there is no process of it. Raises OSError."""
        note, mark = self._shared.files.note(self.task.name, "pid"), self._mark
        server = process_of(int(note), mark) if note.isdecimal() else child_of(self.task.pid, mark)
        if server is None:
            return False
        with contextlib.suppress(psutil.NoSuchProcess):
            server.terminate()
        return True

    def _kill(self) -> None:
        if not self.gone.is_set() and self._lives():
            kill_group(self.task.pid)

    # Its recordings

    def _rescue_in_time(self) -> None:
        """Move the recordings before the event of the end is sent, since the next server resumes from them.

        Give up after RESCUE_TIMEOUT: the participant must not wait for it.
        """
        try:
            self._retry(self._rescue, RESCUE_TIMEOUT)
        except Exception:  # noqa: BLE001 - `_clear` tries again
            name = self.task.name
            self._shared.say(f"a recording of server {name} cannot be moved to the data yet; it is tried again")

    def _rescue(self) -> None:
        """Move recordings that a killed server left unfinished to the data folder. Raises OSError."""
        self.read_handover()
        recordings.move_to_data(self._shared.spool, self._shared.data, self.task)

    # Its record and its events

    def _save(self, **changes: Any) -> None:
        """Write the changed task to its file, then keep it here. Raises OSError."""
        with self._shared.lock:
            task = replace(self.task, **changes)
            if not self.forgotten.is_set():
                self._shared.files.save(task)
            self.task, self.unsaved = task, False

    def _send(self, **changes: Any) -> None:
        """Send the event of the changed task, then save the task. Raises OSError."""
        task = replace(self.task, version=self.task.version + 1, **changes)
        if not self.silent:
            self._shared.emit(event(task, self._exit_code))
        with self._shared.lock:
            self.task, self.unsaved = replace(self.task, version=task.version, **changes), True
            self._save()

    @property
    def _log(self) -> Path:
        return self._shared.log(self.task.name)

    @property
    def _mark(self) -> str:
        return mark_of(self._shared.state, self.task.name)
