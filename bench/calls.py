"""Counts the AWS calls of the functions on moto, and measures the cold start of the function behind the pages."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import re
import statistics
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from types import ModuleType
from typing import Any
from urllib.parse import urlencode

import botocore.session

from bench.row import Row, row
from bench.study import ANSWERS, ROOT
from testing import aws_events

FORM = "application/x-www-form-urlencoded"

MINUTE = timedelta(minutes=1)
WARM = 6  # participants who go first, so that every function has project and pages in its cache
RUNS = 5  # fresh processes of each kind


# A participant


class MeasuredStudy:
    """The example study on moto. Its functions have caches of their own and a clock that the bench moves.

    `calls` has, by function, the AWS calls that it made.
    """

    def __init__(self, world: Any) -> None:
        from hippodrome.control.aws import AwsPlatform
        from hippodrome.control.config import read_project
        from hippodrome.functions import installed, update_project_master_list

        class Aging(AwsPlatform):
            clock = datetime.now(UTC)

            def now(self) -> datetime:
                return self.clock

        self.world, self.platform = world, Aging(world.env)
        self.calls: dict[str, list[str]] = {}
        self._caches: dict[str, dict[Any, Any]] = {}
        installed.use(self.platform)
        project = read_project(ROOT).registration()
        self.query = f"projectId={project['id']}&userId="
        self.id = str(project["id"])
        for file in (ROOT / "steps").glob("*.html"):
            self.upload(f"{self.id}/steps/{file.name}", file.read_bytes())
        self.invoke(update_project_master_list, {"project": project})

    def upload(self, key: str, body: bytes) -> None:
        """Store a document in the bucket."""
        self.world.client("s3").put_object(Bucket=self.world.env["BUCKET"], Key=key, Body=body)

    def invoke(self, function: ModuleType, event: Mapping[str, Any]) -> dict[str, Any]:
        """Run a function, and note its AWS calls; return its answer."""
        from hippodrome.functions import installed

        name = function.__name__.rpartition(".")[2]
        installed._made = self._caches.setdefault(name, {})  # each function is a process of its own
        with self.world.recording() as calls:
            answer: dict[str, Any] = function.handler(dict(event), None)
        self.calls.setdefault(name, []).extend(call.action for call in calls)
        if answer.get("batchItemFailures") or answer.get("statusCode", 200) >= 400:
            raise RuntimeError(f"{name} failed: {answer}")
        return answer

    def request(self, method: str, user: str, more: str = "", body: str | None = None) -> str:
        """Send a request of a browser to `next_step`; return the body of the answer."""
        from hippodrome.functions import next_step

        headers = {"accept": "application/json" if more else "text/html"}
        if body is not None:
            headers["content-type"] = FORM
        event = aws_events.http_event(method, self.query + user + more, body, headers=headers)
        return str(self.invoke(next_step, event)["body"])

    def answer(self, user: str, page: str, answers: Mapping[str, object]) -> None:
        """Submit the form of a page."""
        hidden = dict(re.findall(r'<input type="hidden" name="([^"]+)" value="([^"]*)"', page))
        self.request("POST", user, body=urlencode({**hidden, **answers}))

    def travel(self, user: str, pause: timedelta = timedelta()) -> None:
        """Take a participant from the link to the end, until only their data are left.

        `pause` passes before each action. The server starts while they fill in the questionnaire; the waiting page
        polls once. A DNS change is PENDING at the first look, and in sync at the second. Raises RuntimeError if
        anything else is left.
        """
        from hippodrome.functions import start_server, stop_server, task_changed
        from hippodrome.protocol.keys import answer_key

        world = self.world

        def later() -> None:
            self.platform.clock += pause

        later()
        page = self.request("GET", user)
        later()
        self.answer(user, page, ANSWERS["1"])
        page = self.request("GET", user)
        self.invoke(start_server, world.receive("start"))
        later()
        self.answer(user, page, ANSWERS["2"])
        self.request("GET", user)
        task = world.task_arns()[-1]
        self.invoke(task_changed, world.sqs_event("task", [world.task_event(task, "RUNNING")]))
        for in_sync in (False, True):
            world.in_sync = in_sync
            world.skip_delays()
            self.invoke(task_changed, world.receive("task"))
        later()
        self.request("GET", user, "&poll=3")
        self.upload(answer_key(self.id, user, "3"), b'{"step": "3", "answers": {"score": 120}}')  # as the trial does
        later()
        page = self.request("GET", user)
        self.invoke(stop_server, world.receive("stop"))
        stopped = world.task_event(task, "STOPPED", stop_code="UserInitiated", reason=world.task(task).stopped_reason)
        self.invoke(task_changed, world.sqs_event("task", [stopped]))
        later()
        self.answer(user, page, ANSWERS["4"])
        self.request("GET", user)
        left = [*world.timers(), *world.records(), *[arn for arn in [task] if world.task(arn).last_status != "STOPPED"]]
        if left or any(world.receive(queue)["Records"] for queue in ("start", "stop", "task")):
            raise RuntimeError(f"something of the participant is left: {left}")


@contextlib.contextmanager
def on_moto() -> Iterator[MeasuredStudy]:
    """Make the study in a new account for the block. Logs of functions are not shown."""
    from hippodrome.control.log import logger
    from hippodrome.functions import installed
    from testing.moto_world import MotoWorld

    handler = logger.registered_handler
    assert isinstance(handler, logging.StreamHandler)
    before = handler.setStream(io.StringIO())
    try:
        with MotoWorld(enforce=False) as world:
            yield MeasuredStudy(world)
    finally:
        installed.use(None)
        if before is not None:
            handler.setStream(before)


def of_a_participant() -> Iterator[Row]:
    """Count the AWS calls of a whole participant, from the link until everything is cleaned up."""
    for name, pause, most in (("in a running study", timedelta(), 31), ("alone, at a minute a page", MINUTE, 40)):
        with on_moto() as study:
            for number in range(WARM):
                study.travel(f"before-{number}")
            study.calls.clear()
            study.platform.clock += pause
            study.travel("P1", pause)
        yield row(
            f"AWS calls of a participant {name}",
            sum(map(len, study.calls.values())),
            "calls",
            at_most=most,
            decides="the bill for S3, SNS, SQS and Route 53; `cost` counts by it, and docs/architecture.md names it",
            detail={function: dict(sorted(Counter(calls).items())) for function, calls in study.calls.items()},
        )


# The cold start, on moto's server in a process of its own

MOTO = """
import sys
from moto.server import ThreadedMotoServer
server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
server.start()
print(server.get_host_and_port()[1], flush=True)
sys.stdin.read()
"""
OURS = """
import json, sys, time
event = json.loads(sys.argv[1])
begun = time.process_time()
from hippodrome.functions import next_step
answer = next_step.handler(event, None)
assert answer["statusCode"] == 200 and len(answer["body"]) > 5000, answer
print(time.process_time() - begun)
"""
# The simplest code that makes the same calls: the same library, one client, no page.
BARE = """
import os, sys, time
page, user, *keys = sys.argv[1:]
begun = time.process_time()
import botocore.session
s3, bucket = botocore.session.get_session().create_client("s3"), os.environ["BUCKET"]
for key in (*keys, page):
    s3.get_object(Bucket=bucket, Key=key)["Body"].read()
s3.list_objects_v2(Bucket=bucket, Prefix="ms-pacman/users/" + user + "/")
s3.put_object(Bucket=bucket, Key="ms-pacman/users/" + user + "/participant.json", Body=b"{}", IfNoneMatch="*")
print(time.process_time() - begun)
"""


@contextlib.contextmanager
def moto_server() -> Iterator[tuple[dict[str, str], Callable[[], list[str]]]]:
    """Run moto's server; give the environment of its clients, and a function that returns all requests so far."""
    with (
        tempfile.TemporaryFile("w+") as log,
        subprocess.Popen(
            [sys.executable, "-c", MOTO], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
        ) as process,
    ):
        assert process.stdin is not None
        assert process.stdout is not None
        env = {
            **{name: value for name, value in os.environ.items() if not name.startswith("AWS_")},
            "AWS_ACCESS_KEY_ID": "testing",
            "AWS_SECRET_ACCESS_KEY": "testing",  # moto accepts any key
            "AWS_REGION": "us-east-1",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{process.stdout.readline().strip()}",
            "BUCKET": "hippodrome",
            "ROOT_DOMAIN": "example.org",
        }

        def requests() -> list[str]:
            log.seek(0)
            return re.findall(r'"([A-Z]+ /\S*) HTTP/', log.read())

        try:
            yield env, requests
        finally:
            process.stdin.close()


def example_documents() -> dict[str, bytes]:
    """Return the documents of a bucket with the registered example study, by key."""
    with on_moto() as study:
        s3, bucket = study.world.client("s3"), study.world.env["BUCKET"]
        keys = [entry["Key"] for entry in s3.list_objects_v2(Bucket=bucket)["Contents"]]
        return {key: s3.get_object(Bucket=bucket, Key=key)["Body"].read() for key in keys}


def cold_start() -> Iterator[Row]:
    """Measure the processor time from the first import to the first page, beside botocore with the same calls."""
    documents = example_documents()
    page = next(key for key in documents if "/steps/consent" in key)
    others = [key for key in documents if "/steps/" not in key]
    with moto_server() as (env, requests):

        def seconds(*arguments: str) -> float:
            command = [sys.executable, "-c", *arguments]
            return float(
                subprocess.run(command, env=env, capture_output=True, check=True, timeout=60).stdout.split()[-1]
            )

        settings = {"aws_access_key_id": "testing", "aws_secret_access_key": "testing", "region_name": "us-east-1"}
        s3 = botocore.session.get_session().create_client("s3", endpoint_url=env["AWS_ENDPOINT_URL"], **settings)
        s3.create_bucket(Bucket="hippodrome")
        for key, body in documents.items():
            s3.put_object(Bucket="hippodrome", Key=key, Body=body)
        times: dict[str, list[float]] = {"ours": [], "bare": []}
        calls: dict[str, int] = {}
        for number in range(RUNS + 1):  # by turns, so that load on the machine slows down both
            event = aws_events.http_event(
                "GET", f"projectId=ms-pacman&userId=P{number}", headers={"accept": "text/html"}
            )
            for kind, code in (("ours", (OURS, json.dumps(event))), ("bare", (BARE, page, f"Y{number}", *others))):
                before = len(requests())
                times[kind].append(1000 * seconds(*code))
                calls[kind] = len(requests()) - before
    if calls["ours"] != calls["bare"]:
        raise RuntimeError(f"the two do not make as many calls: {calls}")
    ours, bare = (times[kind][1:] for kind in ("ours", "bare"))  # the first run writes bytecode
    yield row(
        "cold start of next_step: CPU from the first import to the first page",
        statistics.median(ours),
        "ms",
        yardstick=statistics.median(bare),
        at_most=1.5,
        decides="the first participant after a pause waits for it; each new import of the function costs here",
        detail={
            "the yardstick": "botocore alone with the same calls",
            "S3 requests": calls["ours"],
            "runs": ours,
        },
    )
