"""`LocalPlatform`: the five ports on one machine, and their threads.

The state folder holds everything that is not data:

    logs/ spool/      logs of functions and servers, and recordings that are being written
    tasks/            whose each running server is, for `erase`
    locks/ scratch/   locks of documents, and documents that are being written

What the functions still have to do, timers and names are in memory. If the process is killed, the next start makes of
the servers' records what it needs (`start`).
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TypeVar

from hippodrome.control.config import Config
from hippodrome.control.model.project import MASTER_LIST, Project
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import RECORDS, Server
from hippodrome.control.ports import Conflict, Document, Settings, Topic
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.secret import KEY, SecretCache
from hippodrome.functions import installed, start_server, stop_server, sweep, task_changed
from hippodrome.local.backend import files
from hippodrome.local.backend.bus import Handler, LocalBus
from hippodrome.local.backend.dns import LocalDns
from hippodrome.local.backend.documents import FolderDocuments, Written
from hippodrome.local.backend.retry import Retry, start_thread
from hippodrome.local.backend.task_process import KILLED, event
from hippodrome.local.backend.tasks import PYTHON_TRIAL, STOP_TIMEOUT, ProcessTasks
from hippodrome.local.backend.timers import LocalTimers
from hippodrome.local.publish import publish

DOMAIN = "localhost"
GAME_PATH = "/game/"  # where browsers find the servers of a lab (`local/web/relay.py`)
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
        self.dns = LocalDns(named=named_port is not None or not is_private)
        self.bus = LocalBus(self._handlers, say, self.retry)
        self.timers = LocalTimers(lambda message: self.bus.publish(Topic.STOP, message))
        self.tasks = ProcessTasks(
            state,
            data,
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
        self.tasks.add_project(
            config.project.id, folder, has_model=bool(config.models), keeps_recordings=config.trial.s3upload
        )
        return config

    def project(self, project_id: str) -> Project | None:
        """Return the registered project; None if there is none."""
        return ProjectCache(self, SecretCache(self.documents)).project(project_id)

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

    def start(self) -> int:
        """Begin; end what a killed process has left, and return how many servers it has lost.

        Raises OSError if this machine refuses that.
        """
        installed.use(self)
        self.documents.tidy()
        lost: list[Server] = []
        steps: list[Callable[[], object]] = [
            self._clear,
            lambda: lost.extend(self._open_records()),
            self.bus.start,
            partial(start_thread, self._sweep, name="sweep"),
            partial(start_thread, self._look_after, name="guard"),
        ]
        for step in steps:
            self.retry.run(step, seconds=START_RETRY_SECONDS)
        for record in lost:
            self.bus.emit(event(record.name, record.task or "", record.cluster, exit_code=KILLED))
        self.bus.drain(START_RETRY_SECONDS)  # before a page is shown
        return len(lost)

    def _clear(self) -> None:
        """End what a killed process has left. Recordings are kept also if it served other studies. Raises OSError."""
        registered = ProjectCache(self).projects()
        self.tasks.clear(project.id for project in registered if project.trial.get("s3upload", True))

    def _open_records(self) -> list[Server]:
        """The records of servers that are not closed. Raises OSError."""
        documents = [self.documents.get(entry.key) for entry in self.documents.list(RECORDS)]
        records = []
        for document in filter(None, documents):
            with contextlib.suppress(ValueError):
                records.append(from_json(document.body, Server))
        return [record for record in records if not record.is_closed]

    def close(self, seconds: float = 5.0) -> None:
        """End every server, and let the functions clean up for some seconds. The next start does what is left to do."""
        self._closed.set()
        self.timers.close()
        self.tasks.close(seconds)
        self.bus.drain(2)
        self.bus.close(2)
        installed.use(None)

    # The data folder, which the researcher may delete while the study runs

    def _look_after(self) -> None:
        """Look whether the registration, the pages or the records were deleted; if so, publish the study again."""
        kept: dict[str, Document] = {}  # the documents of `_KEPT`, as they were last
        known, last = frozenset[str](), frozenset[str]()
        while not self._closed.wait(LOOK):
            try:
                kept |= {key: document for key in _KEPT if (document := self.documents.get(key))}
                existing = self._existing()
            except OSError:  # what exists is not known, so nothing counts as deleted
                continue
            if not known - existing:
                known = existing
            elif existing == last:  # the deletion is complete
                self._say(f"THE DATA FOLDER {self.documents.folder} WAS DELETED, or files in it that the study needs.")
                begin_again = partial(
                    self._begin_again, kept, servers="_servers" not in existing and "_servers" in known
                )
                self.retry.run(begin_again, self._closed.wait)
                known = frozenset()
            last = existing

    def _existing(self) -> frozenset[str]:
        """Those of the study's documents and folders in the data that exist. Raises OSError if that cannot be seen."""
        folder = self.documents.folder
        projects = files.names(folder) if files.exists(folder) else []
        names = [*(f"{project}/steps" for project in projects), *_KEPT, "_servers"]
        return frozenset(name for name in names if files.exists(folder / name))

    def _begin_again(self, kept: Mapping[str, Document], *, servers: bool) -> None:
        """Publish the study again. `servers`: whether the servers' records were deleted; then the servers are ended."""
        self.documents.prepare()
        ended = self.tasks.forget() if servers else 0
        for key, document in kept.items():  # as they were, so that open pages and completion codes stay valid
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
                handler({}, None)
            except Exception as error:  # noqa: BLE001 - the next sweep tries again
                self._say(f"the sweep failed: {type(error).__name__}: {error}")


def _game_sources(lab: str | None, named_port: int | None) -> str:
    """The sources of servers: in a lab the web server's own address; else their names at one port, or any port here."""
    if lab is not None:
        return lab.replace("http", "ws", 1)
    return f"wss://*.{DOMAIN}:{named_port}" if named_port else "ws://127.0.0.1:*"
