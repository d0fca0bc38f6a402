"""Runs a study by `hippodrome run` in a process of its own, ends it, and looks at its servers and records."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import psutil
import yaml

from hippodrome import places
from hippodrome.bots.verification import document
from hippodrome.console.run_state import state_of
from hippodrome.control.config.folder import read_source
from hippodrome.control.lobby import decisions
from hippodrome.protocol import environment, handover
from hippodrome.protocol import players as who
from hippodrome.protocol.keys import handover_key, membership_key
from hippodrome.protocol.session import is_session_id

TRIED = "data-try"  # the project's folder with the data of its rehearsals
START_SECONDS = 60.0  # the study must start within so many seconds
PATIENCE = 30  # seconds: the longest `patience` in the copy of a study
GONE_SECONDS = 45.0  # after the last bot has ended, the servers must end within so many seconds
END_SECONDS = 30.0  # local mode must end within so many seconds
LOG_ROOM = 1 << 16  # bytes: a disk without room for so many is full

_LINK = re.compile(r"http://127\.0\.0\.1:\d+/next\S*")


class StudyNotStarted(Exception):
    """The study cannot be started; the text is the reason, or what local mode printed."""


class Process(Protocol):
    """The methods of `subprocess.Popen` that are used here."""

    @property
    def pid(self) -> int: ...

    def poll(self) -> int | None: ...

    def wait(self, timeout: float | None = None) -> int: ...

    def send_signal(self, sig: int, /) -> None: ...

    def kill(self) -> None: ...


class StudyProcess:
    """Runs a study by `hippodrome run` in a process of its own. `link` is the study's link once the study has started.

    If this process ends in whatever way, the study ends, too.
    """

    def __init__(self, folder: Path, data: Path, *, log: Path | None = None, real_llm: bool = False) -> None:
        """With `real_llm`, the study asks its language model if there is a key, and no stand-in."""
        self._model = [] if real_llm else ["--fake-model"]
        self.folder, self.data = folder.resolve(), data.resolve()
        self.log = log or data.resolve().parent / f"{data.name}.log"
        self.link = ""
        self._process: Process | None = None

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def start(self, seconds: float = START_SECONDS) -> None:
        """Start the study and wait for its link. Raises StudyNotStarted after `seconds`, or if the study ends."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("ab") as log:
            begin = log.tell()
            self._process = self._begin(
                [
                    str(self.folder),
                    "--port",
                    "0",
                    "--data",
                    str(self.data),
                    "--starter",
                    str(os.getpid()),
                    *self._model,
                ],
                env={**places.for_child(os.environ), "PYTHONUNBUFFERED": "1", "COLUMNS": "200"},
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C must not reach it: `interrupt` ends it
            )
        until = time.monotonic() + seconds
        while True:
            ended = self._process.poll() is not None
            text = self.log.read_bytes()[begin:].decode("utf-8", "replace")
            match = _LINK.search(text)
            if match:
                self.link = match[0]
                return
            if ended or time.monotonic() > until:
                self.kill()
                raise StudyNotStarted(text.strip() or self._why_silent())
            time.sleep(0.05)

    def _why_silent(self) -> str:
        """Say why local mode left no line: on a full disk, its log cannot hold one."""
        try:
            with tempfile.TemporaryFile(dir=self.log.parent) as probe:
                probe.write(bytes(LOG_ROOM))
        except OSError as error:
            return (
                f"The bots' data cannot be stored in {self.data}: {error.strerror}. Make room there, or name another "
                "folder with --data."
            )
        return f"`hippodrome run` did not start the study, and printed nothing into {self.log}"

    def _begin(self, arguments: list[str], **options: Any) -> Process:
        """Start `hippodrome run`; `options` are those of `subprocess.Popen`."""
        command = [sys.executable, "-P", "-m", "hippodrome", "run", *arguments]
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, **options)  # noqa: S603 - our own command

    def interrupt(self, seconds: float = END_SECONDS) -> bool:
        """End the study as Ctrl-C does; return False if it had to be killed after `seconds`."""
        process = self._process
        if process is None:
            return True
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.kill()
            return False
        return True

    def kill(self) -> None:
        """Send SIGKILL to local mode, and wait for its end. Its servers go on."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def clear(self) -> int:
        """Kill local mode and all its servers; return how many servers there were."""
        self.kill()
        servers = servers_of(self.data)
        for process in servers:
            with contextlib.suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(servers, timeout=5)
        return len(servers)


def servers_of(data: Path, users: Collection[str] | None = None) -> list[psutil.Process]:
    """Return the server processes of a data folder, which are found by their environment.

    With `users`, return only servers of these owners: ids of participants and sessions.
    """
    store = str(data.resolve())
    servers = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            variables = process.environ()
            if variables.get(environment.STORE) == store and (users is None or _owner(variables, data) in users):
                servers.append(process)
    return servers


def _owner(variables: Mapping[str, str], data: Path) -> str | None:
    """The participant or session of a server: from its environment, or for a warm server from its handover."""
    for name in (environment.USER_ID, environment.SESSION):
        if variables.get(name):
            return variables[name]
    with contextlib.suppress(OSError, ValueError, KeyError):
        key = handover_key(variables[environment.PROJECT_ID], variables[environment.SERVER])
        return handover.parse((data / key).read_bytes()).user_id
    return None


class _AsWritten(yaml.SafeLoader):
    """Leaves words such as `no` and `on` as they are written, since a level or a right answer may be one."""


_AsWritten.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:bool" or first in "tTfF"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def copy_of(project: Path, folder: Path) -> list[str]:
    """Copy the project to `folder`, by links, and change the copy so that bots can end the game.

    Returns what was changed, in words.
    """
    folder.mkdir(parents=True)
    source = read_source(project)
    config = source.layout.config
    for path in project.iterdir():
        if path != config and path.name not in ("data", TRIED) and not path.name.startswith("."):
            (folder / path.name).symlink_to(path.resolve())
    tree = yaml.load(config.read_text(encoding="utf-8"), _AsWritten)  # noqa: S506 - a SafeLoader
    _copy_policies(project, folder, tree.get("trial") or {})
    project_id = source.adapted.at(("project", "id"))  # it may come from the folder's name, and the copy has another
    if isinstance(project_id, str):
        tree["project"]["id"] = project_id
    changes = []
    if not tree["project"].get("live"):
        tree["project"]["live"] = True
        changes.append("`live` is true")
    limits = [key for key in ("maxParticipants", "maxServers", "maxServerHours") if tree["project"].pop(key, None)]
    if limits:
        changes.append(f"there are no limits (no {', '.join(f'`{key}`' for key in limits)})")
    if tree["project"].pop("signedLinks", None):
        changes.append("no link need be signed")
    if tree["project"].get("players", 1) != 1 and tree["project"].get("patience", 300) > PATIENCE:
        tree["project"]["patience"] = PATIENCE
        changes.append(f"`patience` is {PATIENCE}")
    if _without_least_times(tree["project"].get("steps")):
        changes.append("no page has `minSeconds`")
    trial = tree.get("trial") or {}
    ui = trial.get("ui")
    if isinstance(ui, list):
        ui = dict.fromkeys(ui, True)
    ui = ui or dict.fromkeys(("left", "right", "up", "down", "start", "pause"), True)
    if not ui.get("stop"):
        tree["trial"] = {**trial, "ui": {**ui, "stop": True}}
        changes.append("the game may be stopped (`ui.stop`)")
    (folder / config.name).write_text(yaml.safe_dump(tree, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return changes


def _without_least_times(steps: Any) -> bool:
    """Remove `minSeconds` from pages in a list of steps, also from those in blocks; return whether there were any."""
    has_least_times = False
    for item in steps if isinstance(steps, list) else ():
        for name, settings in item.items() if isinstance(item, dict) else ():
            if name == "steps":
                has_least_times |= _without_least_times(settings)
            elif isinstance(settings, dict):
                has_least_times |= settings.pop("minSeconds", None) is not None
    return has_least_times


def _copy_policies(project: Path, folder: Path, trial: Mapping[str, Any]) -> None:
    """Replace the links to the policies' files, or to their folders, by copies: a server reads no policy by a link.

    Local mode reports the mistakes in `players` and `substitute`.
    """
    policies = {key: trial.get(key) for key in ("players", "substitute")}
    for top in {Path(file).parts[0] for _, file in who.files(policies) if "{" in file or (project / file).is_file()}:
        if not (folder / top).is_symlink():
            continue
        (folder / top).unlink()
        if (project / top).is_dir():
            shutil.copytree(project / top, folder / top)
        else:
            shutil.copy2(project / top, folder / top)


def logs_of(data: Path) -> Path:
    """Return the folder with the logs of the functions and servers of a study with this data folder."""
    return state_of(data) / "logs"


def sessions_of(data: Path, project_id: str, users: Collection[str]) -> set[str]:
    """Return the ids of the sessions in which these participants play with others."""
    keys = (membership_key(project_id, user_id) for user_id in users)
    return {str(membership["session"]) for key in keys if (membership := document(data / key)).get("session")}


def sessions_not_open(data: Path, project_id: str) -> set[str]:
    """Return the ids of the sessions that have a server, except those that the lobby lists as open.

    The servers of open sessions were started ahead, and wait for participants who may still come.
    """
    ahead = {session_ahead["id"] for session_ahead in document(data / decisions.key(project_id)).get("open", ())}
    owners = {str(document(path).get("userId")) for path in (data / "_servers").glob("*.json")}
    return {owner for owner in owners - ahead if is_session_id(owner)}


def open_records(data: Path, users: Collection[str] | None) -> list[str]:
    """Return the labels of the servers whose records are not closed.

    With `users`, return only servers of these owners: ids of participants and sessions.
    """
    records = ((path.stem, document(path)) for path in sorted((data / "_servers").glob("*.json")))
    return [
        name
        for name, record in records
        if record.get("state") != "closed" and (users is None or record.get("userId") in users)
    ]


@dataclass
class Leftovers:
    """What a study has left over: processes of servers, records that are not closed, and local mode itself."""

    processes: int = 0
    records: list[str] = field(default_factory=list)
    local_mode_killed: bool = False  # whether it was killed, since Ctrl-C did not end it

    def words(self) -> list[str]:
        """Return lines that say what is left over; none if nothing is."""
        lines = [f"the record of server {name} is not closed" for name in self.records]
        if self.processes:
            lines.append(f"{self.processes} server process(es) were left over")
        if self.local_mode_killed:
            lines.append(f"local mode did not end within {END_SECONDS:.0f} s")
        return lines


def wait_until_gone(data: Path, users: Collection[str] | None = None) -> Leftovers:
    """Wait up to GONE_SECONDS until the last servers have ended; return what is left."""
    until = time.monotonic() + GONE_SECONDS
    while True:
        leftovers = Leftovers(len(servers_of(data, users)), open_records(data, users))
        if not leftovers.words() or time.monotonic() > until:
            return leftovers
        time.sleep(0.2)
