"""`LocalPlatform`: the five ports on one machine, and their threads.

The state folder holds everything that is not data:

    queue/ dead/                             messages that are not handled yet, and those given up
    timers/ tasks/ clusters/ names.json      what EventBridge Scheduler, ECS and Route 53 know on AWS
    logs/ spool/                             logs of functions and servers, and recordings that are being written
    locks/ scratch/                          locks of documents, and documents that are being written
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from hippodrome.control.config import Config
from hippodrome.control.model.project import MASTER_LIST
from hippodrome.control.ports import Conflict, Document, Settings, Topic
from hippodrome.control.storage.secret import KEY
from hippodrome.functions import installed, start_server, stop_server, sweep, task_changed
from hippodrome.local.backend import files
from hippodrome.local.backend.bus import FolderBus, Handler
from hippodrome.local.backend.dns import FileDns
from hippodrome.local.backend.documents import FolderDocuments, Written
from hippodrome.local.backend.retry import Retry, start_thread
from hippodrome.local.backend.tasks import PYTHON_TRIAL, STOP_TIMEOUT, ProcessTasks
from hippodrome.local.backend.timers import FolderTimers
from hippodrome.local.publish import NotPublished, publish
from hippodrome.protocol import disk

DOMAIN = "localhost"
GAME_PATH = "/game/"  # where browsers find the servers of a lab (`local/web/relay.py`)
_OURS = ("queue", "tasks", "timers")  # folders in which no other process has unfinished files
_KEPT = (KEY, MASTER_LIST)  # documents whose content cannot be made again
SWEEP_FIRST, SWEEP_EVERY = 20.0, 600.0  # seconds
LOOK = 0.5  # seconds between two looks whether the data still exist
START_RETRY_SECONDS = 5.0  # seconds for which `start` tries again what this machine refuses

HANDLERS: Mapping[str, Handler] = {
    "start": start_server.handler,
    "stop": stop_server.handler,
    "task": task_changed.handler,
    "sweep": sweep.handler,
}
"""The functions behind the queues, and the one behind the timer."""

T = TypeVar("T")


class LocalPlatform:
    """Implements `hippodrome.control.ports.Platform`.

    The ports may be used at once; `start` begins to deliver messages, fire timers and look after servers of an earlier
    run, and makes this the platform of the functions. One process at a time may hold a state folder.
    """

    def __init__(
        self,
        data: Path,
        state: Path,
        *,
        project_folder: Path = Path(),
        handlers: Mapping[str, Handler] | None = None,
        command: Sequence[str] = PYTHON_TRIAL,
        stop_timeout: float = STOP_TIMEOUT,
        written: Written | None = None,
        named_port: int | None = None,
        subdomain: str | None = None,
        more_folders: Sequence[Path] = (),
        lab: str | None = None,
        say: Callable[[str], None] = print,
    ) -> None:
        """`named_port`: the port at which browsers find all servers by their names, with TLS.

        None: each server has its own port. `subdomain` says how servers are named, instead of the project's.

        `more_folders` are those of further studies. With `lab`, the address of the web server, other machines take
        part: links are signed, and browsers find servers at that address, below GAME_PATH.
        """
        self._state = state
        self._folders = (project_folder, *more_folders)
        self._is_lab = lab is not None
        self._subdomain = subdomain
        self._handlers = HANDLERS if handlers is None else handlers
        self._say = say
        # The researcher of a study is the administrator here, unless others can reach the servers.
        is_private = lab is None
        self.settings = Settings(
            root_domain=DOMAIN,
            bucket="data",
            game_sources=_game_sources(lab, named_port),
            game_path="" if is_private else GAME_PATH,
            plain_clients=is_private,
            user_id_names=is_private,
        )
        self.retry = Retry(say)
        self.documents = FolderDocuments(data, state, written, self.retry)
        self.dns = FileDns(state, self.retry, named=named_port is not None or not is_private)
        self.bus = FolderBus(state, self._handlers, say, self.retry)
        self.timers = FolderTimers(state, lambda message: self.bus.publish(Topic.STOP, message), say, retry=self.retry)
        self.tasks = ProcessTasks(
            state,
            data,
            project_folder,
            self.bus.emit,
            command=command,
            stop_timeout=stop_timeout,
            say=say,
            retry=self.retry,
            named_port=named_port,
        )
        self._closed = threading.Event()

    def publish(self, folder: Path | None = None) -> Config:
        """Register the project in this folder (None: the first), and copy its pages to the documents.

        Raises NotPublished.
        """
        folder = folder or self._folders[0]
        config = publish(folder, self.documents, self._subdomain, self._say, signed=self._is_lab)
        self.tasks.add_project(config.project.id, folder, has_model=bool(config.models))
        return config

    def port_of(self, name: str) -> int | None:
        """Return the port of the server with this DNS name; None if there is no such server."""
        label, _, domain = name.partition(".")
        return self.tasks.port_of(label) if domain == DOMAIN and self.dns.has(name) else None

    def port_of_label(self, label: str) -> int | None:
        """Return the port of the server whose DNS name begins with this label; None if there is no such server."""
        return self.port_of(f"{label}.{DOMAIN}")

    def now(self) -> datetime:
        return datetime.now(UTC)

    def run_all(self, acts: Sequence[Callable[[], T]]) -> list[T]:
        return [act() for act in acts]

    def start(self) -> None:
        """Continue where the last process ended. Raises OSError if this machine refuses that."""
        installed.use(self)
        self.documents.tidy()
        for unfinished in [*self._state.glob(".*.new"), *(f for d in _OURS for f in (self._state / d).rglob(".*.new"))]:
            disk.remove_if_possible(unfinished)
        documents_before = {key: self.documents.get(key) for key in _KEPT}
        steps: list[Callable[[], object]] = [
            self.tasks.start,
            self.bus.start,
            self.timers.start,
            partial(start_thread, self._sweep, name="sweep"),
            partial(start_thread, self._look_after, documents_before, name="guard"),
        ]
        for step in steps:
            self.retry.run(step, seconds=START_RETRY_SECONDS)

    def close(self, seconds: float = 5.0) -> None:
        """End every server, and let the functions clean up for some seconds. The next start does what is left to do."""
        self._closed.set()
        self.timers.close()
        self.tasks.close(seconds)
        self.bus.drain(2)
        self.bus.close(2)
        installed.use(None)

    # The data folder, which the researcher may delete while the study runs

    def _look_after(self, documents_before: dict[str, Document | None]) -> None:
        """Look whether the registration, the pages or the records were deleted; if so, publish the study again.

        `kept` are the documents of `_KEPT`, as they were at the start.
        """
        previous, last, warned = frozenset[str](), frozenset[str](), False
        while not self._closed.wait(LOOK):
            try:
                documents_before = {
                    key: self.documents.get(key, before) or before for key, before in documents_before.items()
                }
                existing = self._existing()
            except OSError as error:  # what exists is not known, so nothing counts as deleted
                self.retry.report(error)
                continue
            deleted = previous - existing
            if deleted and existing == last:  # the deletion is complete
                if not warned:
                    self._say(
                        f"THE DATA FOLDER {self.documents.folder} WAS DELETED, or files in it that the study needs."
                    )
                try:
                    self._begin_again(documents_before, servers="_servers" in deleted)
                    previous, warned = self._existing(), False
                except Exception as error:  # noqa: BLE001 - the next look tries again
                    if not warned:
                        self._say(f"The study cannot be published again (yet): {_reason(error)}")
                    warned = True
            elif not deleted:
                previous = existing
            last = existing

    def _existing(self) -> frozenset[str]:
        """Those of the study's documents and folders in the data that exist. Raises OSError if that cannot be seen."""
        folder = self.documents.folder
        projects = files.names(folder) if files.exists(folder) else []
        names = [*(f"{project}/steps" for project in projects), *_KEPT, "_servers"]
        return frozenset(name for name in names if files.exists(folder / name))

    def _begin_again(self, documents_before: Mapping[str, Document | None], *, servers: bool) -> None:
        """Publish the study again. `servers`: whether the servers' records were deleted; then the servers are ended."""
        self.documents.prepare()
        ended = self.tasks.forget() if servers else 0
        for (
            key,
            document,
        ) in documents_before.items():  # written as they were, so that open pages and completion codes stay valid
            if document:
                with contextlib.suppress(Conflict):
                    self.documents.create(key, document.body)
        for folder in self._folders:
            self.publish(folder)
        installed.use(self)  # the functions forget what they have cached
        self._say("The study was published again and goes on. Answers that were deleted do not come back.")
        if ended:
            self._say(f"{ended} server(s) whose records were deleted have been ended.")

    def _sweep(self) -> None:
        """Call the function `sweep` now and then, as EventBridge does."""
        handler = self._handlers.get("sweep")
        wait = SWEEP_FIRST
        while handler and not self._closed.wait(wait):
            wait = SWEEP_EVERY
            try:
                handler(_scheduled(self.now()), None)
            except Exception as error:  # noqa: BLE001 - the next sweep tries again
                self._say(f"the sweep failed: {type(error).__name__}: {error}")


def _game_sources(lab: str | None, named_port: int | None) -> str:
    """The sources of servers: in a lab the web server's own address; else their names at one port, or any port here."""
    if lab is not None:
        return lab.replace("http", "ws", 1)
    return f"wss://*.{DOMAIN}:{named_port}" if named_port else "ws://127.0.0.1:*"


def _reason(error: Exception) -> str:
    return "; ".join(error.problems) if isinstance(error, NotPublished) else f"{type(error).__name__}: {error}"


def _scheduled(now: datetime) -> dict[str, Any]:
    """The event of an EventBridge schedule."""
    return {
        "version": "0",
        "id": "local",
        "detail-type": "Scheduled Event",
        "source": "aws.events",
        "account": "000000000000",
        "time": now.strftime("%Y-%m-%dT%H:%M:%SZ"),
        "region": "local",
        "resources": [],
        "detail": {},
    }
