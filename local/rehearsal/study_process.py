"""A study held by `python -m local` in a process of its own: started, killed, ended, and looked at from outside."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import psutil
import yaml

from bots.verification import document
from hippodrome.config.folder import read_source
from hippodrome.lobby import decisions
from protocol import environment, handover
from protocol import players as who
from protocol.keys import handover_key, membership_key
from protocol.session import is_session_id

ROOT = Path(__file__).resolve().parents[2]
TRIED = "data-try"  # the folder in the project's with the data of each rehearsal
START_SECONDS = 60.0  # until the study must be held
PATIENCE = 30  # seconds in which a bot must have found others, in the copy of a study
GONE_SECONDS = 45.0  # until the servers must be gone after the last bot
END_SECONDS = 30.0  # until local mode must have ended

_LINK = re.compile(r"http://127\.0\.0\.1:\d+/next\S*")


class NotHeld(Exception):
    """The study could not be held; the text is what local mode said."""


class Process(Protocol):
    """What is asked of the process; `subprocess.Popen` is one."""

    @property
    def pid(self) -> int: ...

    def poll(self) -> int | None: ...

    def wait(self, timeout: float | None = None) -> int: ...

    def send_signal(self, sig: int, /) -> None: ...

    def kill(self) -> None: ...


class StudyProcess:
    """`python -m local` in a process of its own."""

    def __init__(self, folder: Path, data: Path, *, log: Path | None = None) -> None:
        self.folder, self.data = folder.resolve(), data.resolve()
        self.log = log or data.resolve().parent / f"{data.name}.log"
        self.link = ""
        self._process: Process | None = None

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def start(self, seconds: float = START_SECONDS) -> None:
        """Start it and wait for its link. Raises NotHeld."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("ab") as log:
            said = log.tell()
            self._process = self._begin(
                [str(self.folder), "--port", "0", "--data", str(self.data)],
                cwd=ROOT,
                env={**os.environ, "PYTHONUNBUFFERED": "1", "COLUMNS": "200"},
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is for us; we end it ourselves
            )
        until = time.monotonic() + seconds
        while True:
            ended = self._process.poll() is not None
            text = self.log.read_bytes()[said:].decode("utf-8", "replace")
            found = _LINK.search(text)
            if found:
                self.link = found[0]
                return
            if ended or time.monotonic() > until:
                self.kill()
                raise NotHeld(text.strip() or "it said nothing")
            time.sleep(0.05)

    def _begin(self, arguments: list[str], **options: Any) -> Process:
        """Start `python -m local`; `options` are those of `subprocess.Popen`."""
        command = [sys.executable, "-m", "local", *arguments]
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, **options)  # noqa: S603 - our own command

    def interrupt(self, seconds: float = END_SECONDS) -> bool:
        """End it as Ctrl-C does; whether it did so by itself."""
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
        """`kill -9`: it has no time to say goodbye."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def clear(self) -> int:
        """End what is left of it, in any case; how many processes there were."""
        self.kill()
        left = servers_of(self.data)
        for process in left:
            with contextlib.suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(left, timeout=5)
        return len(left)


def servers_of(data: Path, users: Collection[str] | None = None) -> list[psutil.Process]:
    """The trial processes of this data folder (and these users), found by their environment."""
    store = str(data.resolve())
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            told = process.environ()
            if told.get(environment.STORE) == store and (users is None or _plays(told, data) in users):
                found.append(process)
    return found


def _plays(told: Mapping[str, str], data: Path) -> str | None:
    """The participant or session of a server: from its environment, or for a warm server from its handover."""
    for name in (environment.USER_ID, environment.SESSION):
        if told.get(name):
            return told[name]
    with contextlib.suppress(OSError, ValueError, KeyError):
        key = handover_key(told[environment.PROJECT_ID], told[environment.SERVER])
        return handover.parse((data / key).read_bytes()).user_id
    return None


def copy_of(project: Path, folder: Path) -> list[str]:
    """A copy of the project in which bots can end the game; what was changed, in words. Its files are links."""
    folder.mkdir(parents=True)
    source = read_source(project)
    config = source.layout.config
    for path in project.iterdir():
        if path != config and path.name not in ("data", TRIED) and not path.name.startswith("."):
            (folder / path.name).symlink_to(path.resolve())
    tree = yaml.safe_load(config.read_text(encoding="utf-8"))
    _copy_policies(project, folder, tree.get("trial") or {})
    known_as = source.adapted.at(("project", "id"))  # it may come from the folder's name, which the copy has not
    if isinstance(known_as, str):
        tree["project"]["id"] = known_as
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
    trial = tree.get("trial") or {}
    shown = trial.get("ui")
    if isinstance(shown, list):
        shown = dict.fromkeys(shown, True)
    shown = shown or dict.fromkeys(("left", "right", "up", "down", "start", "pause"), True)
    if not shown.get("stop"):
        tree["trial"] = {**trial, "ui": {**shown, "stop": True}}
        changes.append("the game may be stopped (`ui.stop`)")
    (folder / config.name).write_text(yaml.safe_dump(tree, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return changes


def _copy_policies(project: Path, folder: Path, trial: Mapping[str, Any]) -> None:
    """Copy the policies' files and what lies beside them: a server reads none that a link leads to.

    What is wrong in `players` and `substitute` is said by local mode.
    """
    named = {key: trial.get(key) for key in ("players", "substitute")}
    for top in {Path(file).parts[0] for _, file in who.files(named) if (project / file).is_file()}:
        (folder / top).unlink()
        if (project / top).is_dir():
            shutil.copytree(project / top, folder / top)
        else:
            shutil.copy2(project / top, folder / top)


def logs_of(data: Path) -> Path:
    """Where a study with this data folder puts what its functions and servers say."""
    return data.resolve().parent / ".hippodrome" / data.resolve().name / "logs"


def sessions_of(data: Path, project_id: str, users: Collection[str]) -> set[str]:
    """The sessions in which these participants play together with others."""
    keys = (membership_key(project_id, user_id) for user_id in users)
    return {str(membership["session"]) for key in keys if (membership := document(data / key)).get("session")}


def sessions_not_open(data: Path, project_id: str) -> set[str]:
    """The sessions that have a server, but those that the lobby lists as open.

    Their servers were started ahead, and wait for participants who may still come.
    """
    ahead = {each["id"] for each in document(data / decisions.key(project_id)).get("open", ())}
    owners = {str(document(path).get("userId")) for path in (data / "_servers").glob("*.json")}
    return {owner for owner in owners - ahead if is_session_id(owner)}


def open_records(data: Path, users: Collection[str] | None = None) -> list[str]:
    """The servers (of these users) that the records call open."""
    records = ((path.stem, document(path)) for path in sorted((data / "_servers").glob("*.json")))
    return [
        name
        for name, record in records
        if record.get("state") != "closed" and (users is None or record.get("userId") in users)
    ]


@dataclass
class Leftovers:
    """What must not be there at the end."""

    processes: int = 0
    records: list[str] = field(default_factory=list)
    stubborn: bool = False  # local mode had to be killed

    def words(self) -> list[str]:
        """What is wrong; nothing if nothing is left over."""
        lines = [f"the record of server {name} is not closed" for name in self.records]
        if self.processes:
            lines.append(f"{self.processes} server process(es) were left over")
        if self.stubborn:
            lines.append(f"local mode did not end within {END_SECONDS:.0f} s")
        return lines


def wait_until_gone(data: Path, users: Collection[str] | None = None) -> Leftovers:
    """Give the last servers time to end; what is left."""
    until = time.monotonic() + GONE_SECONDS
    while True:
        left = Leftovers(len(servers_of(data, users)), open_records(data, users))
        if not left.words() or time.monotonic() > until:
            return left
        time.sleep(0.2)
