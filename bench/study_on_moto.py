"""The example study on moto with its real pages, and a participant who goes through it. The AWS calls are counted."""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import urlencode

from hippodrome.aws import AwsPlatform
from hippodrome.config import read_project
from hippodrome.log import logger
from lambdas import (
    installed,
    next_step,
    start_server,
    stop_server,
    task_changed,
    update_project_master_list,
)
from protocol.keys import answer_key
from testing import aws_events
from testing.aws_events import FORM
from testing.iam.enforcement import ApiCall
from testing.moto_world import MotoWorld
from testing.visitors import body_of, hidden

ROOT = Path(__file__).resolve().parents[1]

ANSWERS: Mapping[str, Mapping[str, object]] = {
    "1": {"adult": "yes", "consent": "yes"},
    "2": {"age": "33", "games": "weekly"},
    "4": {"fun": 4, "control": 5, "learned": 3, "effort": 4, "trouble": "no", "notes": "The ghosts were fast. " * 5},
}


class AgingPlatform(AwsPlatform):
    """AWS on a clock that the bench moves, so that the bench decides whether the functions' caches are stale."""

    def __init__(self, env: Mapping[str, str]) -> None:
        super().__init__(env)
        self.clock = datetime.now(UTC)

    def now(self) -> datetime:
        return self.clock


class MeasuredStudy:
    """The example project in an AWS account on moto, and its functions, each with caches of its own.

    `registration` is used instead of the example project's. Raises RuntimeError if the study cannot be registered.
    """

    def __init__(self, world: MotoWorld, registration: Mapping[str, Any] | None = None) -> None:
        self.world = world
        self.platform = AgingPlatform(world.env)
        self.calls: dict[str, list[ApiCall]] = {}  # by function: the AWS calls that it made
        self._caches: dict[str, dict[Any, Any]] = {}  # by function: what its process has cached
        installed.use(self.platform)
        project = dict(registration) if registration else read_project(ROOT).registration()
        self.id = str(project["id"])
        self.steps: list[dict[str, Any]] = project["steps"]
        for step in self.steps:
            for file in [f"{step['page']}-{n}" for n in range(step["variants"])] or [step["page"]]:
                if file != "game":
                    self.upload(f"{self.id}/steps/{file}.html", (ROOT / "steps" / f"{file}.html").read_bytes())
        answer = self.invoke(update_project_master_list, {"project": project})
        if "registered" not in answer:
            raise RuntimeError(f"the study was not registered: {answer}")
        self.calls.clear()

    def upload(self, key: str, body: bytes) -> None:
        """Store a document in the bucket."""
        self.world.client("s3").put_object(Bucket=self.world.env["BUCKET"], Key=key, Body=body)

    def invoke(self, function: ModuleType, event: Mapping[str, Any]) -> dict[str, Any]:
        """Run a function with its own caches, and note its AWS calls; return its answer.

        Raises RuntimeError if a message of the batch fails, or if the status is 400 or more.
        """
        name = function.__name__.rpartition(".")[2]
        installed._made = self._caches.setdefault(name, {})  # each function is a process of its own
        with self.world.recording() as calls:
            answer: dict[str, Any] = function.handler(dict(event), None)
        self.calls.setdefault(name, []).extend(calls)
        if answer.get("batchItemFailures") or answer.get("statusCode", 200) >= 400:
            raise RuntimeError(f"{name} failed: {answer}")
        return answer

    def play(self, user: str, step: str = "3") -> None:
        """Store the answer of the game step, as the trial does at its end."""
        self.upload(answer_key(self.id, user, step), b'{"step": "3", "answers": {"score": 120}}')

    def wait(self, time: timedelta) -> None:
        """Move the clock."""
        self.platform.clock += time


class MeasuredBrowser:
    """A participant's browser: it opens the link and sends forms. `costs` has the AWS calls of each request."""

    def __init__(self, study: MeasuredStudy, user: str) -> None:
        self.study, self.user = study, user
        self.query = urlencode({"projectId": study.id, "userId": user})
        self.costs: list[tuple[str, list[str]]] = []
        self.step = ""

    def open(self) -> dict[str, Any]:
        """Open the link; return the function's answer."""
        return self._send("GET", http_event("GET", self.query))

    def get(self, more: str = "", accept: str = "text/html,application/xhtml+xml") -> str:
        """Load the page; or with `more` in the query, poll. Return the body."""
        event = http_event("GET", self.query + more, accept=accept)
        page = body_of(self._send(f"poll at step {self.step}" if more else "GET", event)).decode()
        if not more:
            self.step = hidden(page).get("hippodrome-step", "final")
            self.costs[-1] = (f"GET step {self.step}", self.costs[-1][1])
        return page

    def post(self, page: str, answers: Mapping[str, object]) -> None:
        """Submit the page's form with these answers. The caller follows the redirect with `get`."""
        body = urlencode({**hidden(page), **answers})
        self._send(f"POST step {self.step}", http_event("POST", self.query, body))

    def _send(self, name: str, event: dict[str, Any]) -> dict[str, Any]:
        with self.study.world.recording() as calls:
            answer = self.study.invoke(next_step, event)
        self.costs.append((name, [call.action for call in calls]))
        return answer


def http_event(
    method: str, query: str, body: str | None = None, accept: str = "text/html,application/xhtml+xml"
) -> dict[str, Any]:
    """Return a request with a browser's usual headers, as an HTTP API passes it on (payload format 2.0)."""
    headers = {
        "accept": accept,
        "accept-encoding": "gzip, deflate, br, zstd",
        "accept-language": "en-CA,en;q=0.9",
        "content-length": str(len(body or "")),
        "host": "abcdefghij.execute-api.us-east-1.amazonaws.com",
        "sec-fetch-dest": "document",
        "sec-fetch-mode": "navigate",
        "user-agent": "Mozilla/5.0 (X11; Linux x86_64) AppleWebKit/537.36 Chrome/142.0 Safari/537.36",
        "x-amzn-trace-id": "Root=1-691f5a3c-5d2b8e1f6a7c9d0e1f2a3b4c",
        "x-forwarded-for": "203.0.113.7",
        "x-forwarded-port": "443",
        "x-forwarded-proto": "https",
    }
    if body is not None:
        headers["content-type"] = FORM
    event = aws_events.http_event(method, query, body.encode() if body is not None else None, headers=headers)
    event["requestContext"]["http"] |= {"protocol": "HTTP/1.1", "sourceIp": "203.0.113.7"}
    event["requestContext"] |= {
        "accountId": "123456789012",
        "apiId": "abcdefghij",
        "domainName": headers["host"],
        "requestId": "JKJaXmPLvHcESHA=",
        "stage": "$default",
        "time": "21/Nov/2026:14:46:00 +0000",
        "timeEpoch": 1795272360000,
    }
    return {"routeKey": f"{method} /next", "isBase64Encoded": False, **event}


@contextlib.contextmanager
def on_moto(registration: Mapping[str, Any] | None = None) -> Iterator[MeasuredStudy]:
    """Make the study in a new account for the block. The functions' logs are not shown."""
    discarded = io.StringIO()
    handler = logger.registered_handler
    assert isinstance(handler, logging.StreamHandler)
    before = handler.setStream(discarded)
    try:
        with MotoWorld(enforce=False) as world:
            yield MeasuredStudy(world, registration)
    finally:
        installed.use(None)
        if before is not None:
            handler.setStream(before)


# A whole participant


def travel(study: MeasuredStudy, user: str, pause: timedelta = timedelta()) -> MeasuredBrowser:
    """Take a participant from the link to the end, until only their data are left; return their browser.

    `pause` passes before each of their actions. The server starts while they fill in the questionnaire; the waiting
    page polls once. A DNS change is PENDING at the first look, and in sync at the second. Raises RuntimeError if
    anything else is left.
    """
    world, browser = study.world, MeasuredBrowser(study, user)
    study.wait(pause)
    page = browser.get()
    study.wait(pause)
    browser.post(page, ANSWERS["1"])
    study.invoke(start_server, world.receive("start"))
    page = browser.get()
    study.wait(pause)
    browser.post(page, ANSWERS["2"])
    browser.get()
    task = world.task_arns()[-1]
    study.invoke(task_changed, world.sqs_event("task", [world.task_event(task, "RUNNING")]))
    for in_sync in (False, True):
        world.in_sync = in_sync
        world.skip_delays()
        study.invoke(task_changed, world.receive("task"))
    study.wait(pause)
    browser.get("&poll=3", accept="application/json")
    study.play(user)
    study.wait(pause)
    page = browser.get()
    study.invoke(stop_server, world.receive("stop"))
    stopped = world.task_event(task, "STOPPED", stop_code="UserInitiated", reason=world.task(task).stopped_reason)
    study.invoke(task_changed, world.sqs_event("task", [stopped]))
    study.wait(pause)
    browser.post(page, ANSWERS["4"])
    browser.get()
    left = [*world.timers(), *world.records(), *[arn for arn in [task] if world.task(arn).last_status != "STOPPED"]]
    if left or any(world.receive(queue)["Records"] for queue in ("start", "stop", "task")):
        raise RuntimeError(f"something of the participant is left: {left}")
    return browser


def warm(study: MeasuredStudy) -> None:
    """Take other participants through the study first, so that every function has project and pages in its cache."""
    for n in range(6):
        travel(study, f"before-{n}")
    study.calls.clear()
