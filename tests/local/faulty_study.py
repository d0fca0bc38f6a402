"""A study on one machine where calls of the operating system fail: the real ports and functions, and quick servers.

What a participant's browser does is done here, and tried again when it fails. If the injector kills the process, the
next one begins on the same folders; the killed one's threads end at their next call.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock
from urllib.parse import urlencode

from hippodrome.control.model import ids
from hippodrome.control.model.project import MASTER_LIST
from hippodrome.control.ports import Topic
from hippodrome.control.servers import dns
from hippodrome.control.storage.secret import KEY
from hippodrome.functions import installed, next_step, send_start_server_message, sweep
from hippodrome.local.backend import bus, platform, retry, task_process, timers
from hippodrome.local.backend.bus import Handler
from hippodrome.local.backend.platform import LocalPlatform
from hippodrome.local.backend.processes import end_everything, marked
from hippodrome.local.publish import publish
from testing import aws_events, derived
from testing.os_faults import Killed, OsFault, OsFaultInjector
from testing.visitors import hidden
from tests.local.conftest import write_study

QUICK = (sys.executable, "-I", "-S", str(Path(__file__).with_name("quick_trial.py")))
PROJECT, USER = "quick", "P1"
LIMIT = 40.0  # seconds until everything must be over, on a busy machine
STARTS = 3  # at most, until no message waits


class Stranded(AssertionError):
    """Something that must happen has not happened in time."""


class FaultyStudy:
    """The folders of a study, and the processes that hold it one after the other."""

    def __init__(self, folder: Path, *, warm: int = 0, fault: OsFault | None = None) -> None:
        folder.mkdir()
        self.project = write_study(folder / "project", warm=warm, start=2)
        self.root = folder / "study"
        self.data, self.state = self.root / "data", self.root / ".hippodrome" / "data"
        self.root.mkdir()
        self.injector = OsFaultInjector(self.root, fault)
        self.promised: dict[str, str] = {}  # by step, what the participant was told is kept
        self.told: list[str] = []
        self.until = time.monotonic() + LIMIT
        self.platform: LocalPlatform | None = None

    # The process

    def begin(self) -> LocalPlatform:
        """Start until it starts, as a researcher does who is told what to do."""
        while True:
            self.check_time("it does not start")
            self.injector.begin_process()
            try:
                self.platform = made = self._platform()
                installed.use(made)
                publish(self.project, made.documents)
                made.start()
                return made
            except (OSError, Killed):
                self._bury()

    def _platform(self) -> LocalPlatform:
        return LocalPlatform(
            self.data, self.state, project_folder=self.project, command=QUICK, stop_timeout=3, say=self.told.append
        )

    def kill(self) -> None:
        """`kill -9`, and the next process."""
        self.injector.dead.set()
        self.look()

    def look(self) -> None:
        """Start the next process if this one was killed."""
        if self.injector.dead.is_set():
            self._bury()
            self.begin()

    def end(self) -> None:
        """As Ctrl-C; then once more, without faults, so that what was left is finished, with the sweep.

        Ctrl-C does not wait for a message that a handler gave back and that is due a moment later: a start more finds it.
        """
        self.injector.heal()
        self.look()
        assert self.platform
        self.platform.close(5)
        for _ in range(STARTS):
            self.begin()
            assert self.platform
            self.platform.bus.drain(10)
            sweep.handler({}, None)
            self.platform.bus.drain(10)
            self.platform.close(5)
            if not any((self.state / "queue").rglob("*.json")):
                break

    def _bury(self) -> None:
        """Let the threads of a process that is no more go to sleep: they may not wait for ever."""
        dead, self.platform = self.platform, None
        if dead:
            self.injector.dead.set()
            dead._closed.set()
            dead.tasks._shared.closed.set()
            for queue in dead.bus._queues.values():
                with queue._changed:
                    queue._open = False
                    queue._changed.notify_all()
            with dead.timers._changed:
                dead.timers._open = False
                dead.timers._changed.notify()

    def check_time(self, what: str) -> None:
        if time.monotonic() > self.until:
            raise Stranded(f"{what}; told: {self.told}")

    # The participant

    def _start_again(self) -> None:
        """Press the page's button that starts the game again."""
        with self.injector.unharmed():
            [project] = json.loads((self.data / MASTER_LIST).read_bytes())["projects"]
            secret = derived.project_secret((self.data / KEY).read_bytes(), project)
        form = {"hippodrome-step": "2", "hippodrome-ticket": ids.ticket(secret, USER, "2")}
        self.ask("POST", form, function=send_start_server_message.handler)

    def ask(
        self,
        method: str,
        form: dict[str, str] | None = None,
        accept: str = "application/json",
        function: Handler = next_step.handler,
    ) -> dict[str, Any]:
        """Send a request until there is an answer."""
        query = urlencode({"projectId": PROJECT, "userId": USER})
        headers = {"accept": accept, "content-type": aws_events.FORM, "host": "localhost"}
        event = aws_events.http_event(method, query, urlencode(form or {}), headers=headers)
        while True:
            self.check_time("no page comes")
            self.look()
            with contextlib.suppress(Killed):
                answer = function(event, None)
                if answer["statusCode"] < 500:
                    return answer  # type: ignore[no-any-return]
            time.sleep(0.02)

    def answer(self, step: str, word: str) -> None:
        page = str(self.ask("GET", accept="text/html")["body"])
        sent = self.ask("POST", {**hidden(page), "word": word}, "text/html")
        assert sent["statusCode"] == 303, sent
        self.promised[step] = word

    def state_of_game(self) -> dict[str, Any]:
        return dict(json.loads(self.ask("GET")["body"]))

    def ready(self, attempt: int = 1) -> dict[str, Any]:
        """Wait until the server is there, asking for another one where the page offers that."""
        while True:
            self.check_time(f"no server {attempt}")
            page = self.state_of_game()
            if page.get("state") == "ready" and page["attempt"] >= attempt and self._reaches(page, "/healthz"):
                return page
            if page.get("again"):
                self._start_again()
            time.sleep(0.03)

    def _reaches(self, page: dict[str, Any], path: str) -> bool:
        connection = http.client.HTTPConnection("127.0.0.1", int(page["url"].rpartition(":")[2].strip("/")), timeout=5)
        try:
            with self.injector.unharmed():
                connection.request("GET", path)
                return connection.getresponse().status == 200
        except (OSError, http.client.HTTPException):
            return False
        finally:
            connection.close()

    def tell_server(self, path: str, attempt: int = 1) -> dict[str, Any]:
        """Send a request to the server, or to its replacement if it has ended meanwhile."""
        while True:
            page = self.ready(attempt)
            if self._reaches(page, path):
                return page

    def play(self, attempt: int = 1) -> None:
        """Until the game step is answered."""
        self.tell_server("/play", attempt)
        self.promised["2"] = "played"
        while self.state_of_game().get("state"):  # the game's page; the next one has no server
            self.check_time("the game is not over")
            time.sleep(0.03)

    def kill_server(self, page: dict[str, Any]) -> None:
        """Kill the server's own process, as the kernel does when memory runs out."""
        with self.injector.unharmed():
            for process in self.servers(page):
                os.kill(process.pid, signal.SIGKILL)

    def servers(self, page: dict[str, Any]) -> list[Any]:
        record = self.record()
        name = record.get("warmServerName") or f"{self.label()}-{page['attempt']}"
        return [p for p in marked(self.state).get(name, ()) if "quick_trial.py" in " ".join(p.cmdline()[:8])]

    def label(self) -> str:
        return ids.server_label(PROJECT, USER)

    def record(self) -> dict[str, Any]:
        with self.injector.unharmed():
            try:
                return dict(json.loads((self.data / "_servers" / f"{self.label()}.json").read_bytes()))
            except OSError:
                return {}

    # What must be so in the end

    def wrong(self) -> list[str]:
        """Whatever was forgotten, left over or lost."""
        found = [f"a process of {name}" for name in marked(self.state)]
        for path in sorted((self.data / "_servers").glob("*.json")):
            record = json.loads(path.read_bytes())
            if record["state"] != "closed":
                found.append(f"the record of {path.stem} is {record['state']}")
        found += [f"in the spool: {path.name}" for path in (self.state / "spool").rglob("*.part")]
        for kind in ("dead", "queue", "timers"):
            found += [f"{kind}: {path.relative_to(self.state)}" for path in (self.state / kind).rglob("*.json")]
        for step, word in self.promised.items():
            path = self.data / PROJECT / "users" / USER / "answers" / f"{step}.json"
            if not path.is_file():
                found.append(f"answer {step} is lost")
            elif step != "2" and json.loads(path.read_bytes())["answers"] != {"word": word}:
                found.append(f"answer {step} is another one")
        return found


# Journeys


def plays_and_ends(study: FaultyStudy) -> None:
    study.play()
    study.answer("3", "bye")


def server_is_killed(study: FaultyStudy) -> None:
    study.kill_server(study.tell_server("/begin"))
    study.play(attempt=2)
    study.answer("3", "bye")


def server_is_stopped(study: FaultyStudy) -> None:
    study.tell_server("/begin")
    while True:
        study.look()
        try:
            assert study.platform
            study.platform.bus.publish(Topic.STOP, {"projectId": PROJECT, "userId": USER, "attempt": 1})
            break
        except (OSError, Killed):
            study.check_time("no stop can be sent")
            time.sleep(0.02)
    while study.record().get("state") != "closed":
        study.look()
        study.check_time("it is not stopped")
        time.sleep(0.03)


def restarted(study: FaultyStudy) -> None:
    study.tell_server("/begin")
    study.kill()
    study.play()
    study.answer("3", "bye")


def both_are_killed(study: FaultyStudy) -> None:
    page = study.tell_server("/begin")
    study.injector.dead.set()
    study.kill_server(page)
    study.look()
    study.play(attempt=2)
    study.answer("3", "bye")


def warm_is_given(study: FaultyStudy) -> None:
    """The warm server is killed in play, and another one follows."""
    while "ready" not in _states(study):
        study.look()
        study.check_time("no server waits")
        time.sleep(0.03)
    server_is_killed(study)


def _states(study: FaultyStudy) -> list[str]:
    """Of all servers."""
    with study.injector.unharmed():
        return [json.loads(path.read_bytes())["state"] for path in (study.data / "_servers").glob("*.json")]


JOURNEYS: dict[str, Callable[[FaultyStudy], None]] = {
    journey.__name__: journey
    for journey in (plays_and_ends, server_is_killed, server_is_stopped, restarted, both_are_killed, warm_is_given)
}


@contextlib.contextmanager
def hurried() -> Iterator[None]:
    """Shorten every wait."""
    with contextlib.ExitStack() as stack:
        for owner, name, value in (
            (bus, "RETRY", (0.02, 0.05, 0.1, 0.1)),
            (retry, "FIRST", 0.02),
            (retry, "LONGEST", 0.1),
            (timers, "AGAIN", 0.05),
            (dns, "RETRY_PAUSE", 0.05),  # a server that ends while it starts has no address: it is asked for again
            (task_process, "RESCUE_TIMEOUT", 0.2),
            (platform, "SWEEP_FIRST", 0.5),
            (platform, "LOOK", 0.1),
            (platform, "START_RETRY_SECONDS", 0.2),
        ):
            stack.enter_context(mock.patch.object(owner, name, value))
        yield


def run(journey: str, folder: Path, fault: OsFault | None = None) -> FaultyStudy:
    """One journey with one fault. Raises `Stranded`; `FaultyStudy.wrong` says what else is not as it should be."""
    study = FaultyStudy(folder, warm=1 if journey == "warm_is_given" else 0, fault=fault)
    try:
        with hurried(), study.injector.installed():
            study.begin()
            study.answer("1", "hello")
            JOURNEYS[journey](study)
            study.end()
    finally:
        end_everything(study.state)
    return study
