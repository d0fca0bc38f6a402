"""What the control plane costs: cold starts, AWS calls, bytes. Everything runs on moto, and moto's recorder counts.

The study is the example project, with its real pages.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import logging
import os
import re
import ssl
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import urlencode

from bench.table import Row, each, row
from bench.trial_server import trial_server
from hippodrome.aws import AwsPlatform
from hippodrome.config import read_project
from hippodrome.log import logger
from hippodrome.model.project import MASTER_LIST
from hippodrome.servers import dns
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
from testing.iam.enforcement import Call
from testing.moto_world import MotoWorld
from testing.simulation import hippo
from testing.visitors import body_of, hidden

ROOT = Path(__file__).resolve().parents[1]
RUNS = 11  # fresh processes of each kind
MINUTE = timedelta(minutes=1)

ANSWERS: Mapping[str, Mapping[str, object]] = {
    "1": {"adult": "yes", "consent": "yes"},
    "2": {"age": "33", "games": "weekly"},
    "4": {"fun": 4, "control": 5, "learned": 3, "effort": 4, "trouble": "no", "notes": "The ghosts were fast. " * 5},
}


def rows() -> Iterator[Row]:
    """Measure everything, one row after another; about a minute."""
    yield from each([cold_start, calls_of_requests, calls_of_a_participant, calls_of_the_trial, bytes_per_answer])


# The study on moto


class AgingPlatform(AwsPlatform):
    """AWS on a clock that the bench moves, so that the functions' caches are as fresh or stale as it says."""

    def __init__(self, env: Mapping[str, str]) -> None:
        super().__init__(env)
        self.clock = datetime.now(UTC)

    def now(self) -> datetime:
        return self.clock


class Study:
    """The example project in an AWS account on moto, and its functions, each with a memory (its caches) of its own."""

    def __init__(self, world: MotoWorld, registration: Mapping[str, Any] | None = None) -> None:
        self.world = world
        self.platform = AgingPlatform(world.env)
        self.calls: dict[str, list[Call]] = {}
        self._memory: dict[str, dict[Any, Any]] = {}
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
        self.world.client("s3").put_object(Bucket=self.world.env["BUCKET"], Key=key, Body=body)

    def invoke(self, function: ModuleType, event: Mapping[str, Any]) -> dict[str, Any]:
        """Run a function as Lambda would, on its own caches, and write down its AWS calls."""
        name = function.__name__.rpartition(".")[2]
        installed._made = self._memory.setdefault(name, {})  # each function is a process of its own
        with self.world.recording() as calls:
            answer: dict[str, Any] = function.handler(dict(event), None)
        self.calls.setdefault(name, []).extend(calls)
        if answer.get("batchItemFailures") or answer.get("statusCode", 200) >= 400:
            raise RuntimeError(f"{name} failed: {answer}")
        return answer

    def play(self, user: str, step: str = "3") -> None:
        """The trial is done: it has written the answer of the game step."""
        self.upload(answer_key(self.id, user, step), b'{"step": "3", "answers": {"score": 120}}')

    def wait(self, time: timedelta) -> None:
        self.platform.clock += time


class Browser:
    """A participant's browser: opens the link, sends forms, follows redirects. Notes what each request cost."""

    def __init__(self, study: Study, user: str) -> None:
        self.study, self.user = study, user
        self.query = urlencode({"projectId": study.id, "userId": user})
        self.costs: list[tuple[str, list[str]]] = []
        self.step = ""

    def open(self) -> dict[str, Any]:
        """The link, as the function answers it."""
        return self._send("GET", http_event("GET", self.query))

    def get(self, more: str = "", accept: str = "text/html,application/xhtml+xml") -> str:
        """A page, or with `more` in the query what else there is."""
        event = http_event("GET", self.query + more, accept=accept)
        page = body_of(self._send(f"poll at step {self.step}" if more else "GET", event)).decode()
        if not more:
            self.step = hidden(page).get("hippodrome-step", "final")
            self.costs[-1] = (f"GET step {self.step}", self.costs[-1][1])
        return page

    def post(self, page: str, answers: Mapping[str, object]) -> None:
        """Submit the page's form; the redirect is followed with `get`."""
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
    """A request as an HTTP API hands it to its function (payload format 2.0), with a browser's usual headers."""
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
def on_moto(registration: Mapping[str, Any] | None = None) -> Iterator[Study]:
    """The study in a fresh account; what the functions log is not shown."""
    quiet = io.StringIO()
    handler = logger.registered_handler
    assert isinstance(handler, logging.StreamHandler)
    before = handler.setStream(quiet)
    try:
        with MotoWorld(enforce=False) as world:
            yield Study(world, registration)
    finally:
        installed.use(None)
        if before is not None:
            handler.setStream(before)


# A whole participant


def travel(study: Study, user: str, pause: timedelta = timedelta()) -> Browser:
    """One participant from the link until nothing of them is left but their data.

    `pause` passes before each thing they do. The server starts while they fill in the questionnaire; the waiting page
    asks once. As in Route 53, a change of names is PENDING when it is first asked for, and in sync the second time.
    """
    world, browser = study.world, Browser(study, user)
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


def warm(study: Study) -> None:
    """Others have been there before the one that is measured: every function has project and pages in its cache."""
    for n in range(6):
        travel(study, f"before-{n}")
    study.calls.clear()


HIPPO_CALLS = {  # of one request; its first visit of a page and its answer are one request
    "GET": len([*hippo.page_calls("survey")]),
    "POST": len([*hippo.page_calls("survey")]),
    "POST that publishes": len([*hippo.page_calls("survey", publishes=True)]),
    "poll": len([*hippo.page_calls("game", waiting=True)]),
}


def calls_of_requests() -> Iterator[Row]:
    """AWS calls of `next_step` on a participant's request: project and pages in its cache, as in a running study."""
    with on_moto() as study:
        warm(study)
        browser = travel(study, "P1")
    kinds: dict[str, dict[str, list[str]]] = {}
    for name, actions in browser.costs:
        kind = name.partition(" ")[0]
        if kind == "POST" and "sns:Publish" in actions:
            kind = "POST that publishes"
        kinds.setdefault(kind, {})[name] = actions
    for kind, found in sorted(kinds.items()):
        most = 3 if "publishes" in kind else 2
        count = max(len(actions) for actions in found.values())
        detail = {name: " ".join(actions) for name, actions in found.items()}
        detail["the yardstick"] = "HIPPO's calls for such a request, by its source"
        yield row(
            f"AWS calls of a {kind}, warm, at most",
            count,
            "calls",
            yardstick=HIPPO_CALLS[kind],
            at_most=most,
            judge="value",
            detail=detail,
        )


def calls_of_a_participant() -> Iterator[Row]:
    """AWS calls of a whole participant, from the link until all is cleaned up."""
    limits = {"maxParticipants": 100, "maxServers": 10, "maxServerHours": 50}
    limited = read_project(ROOT).registration() | limits
    for name, pause, registration, most in (
        ("in a running study", timedelta(), None, 30),
        ("alone, at a minute a page: caches stale", MINUTE, None, 30),
        ("in a running study with limits", timedelta(), limited, 36),
    ):
        with on_moto(registration) as study:
            warm(study)
            study.wait(pause)
            browser = travel(study, "P1", pause)
            by_function = {name: Counter(call.action for call in calls) for name, calls in study.calls.items()}
        detail: dict[str, Any] = {
            f"{function} ({counted.total()})": dict(sorted(counted.items()))
            for function, counted in by_function.items()
        }
        requests = [f"{request} {len(actions)}" for request, actions in browser.costs]
        detail["next_step, request by request"] = ", ".join(requests)
        detail["waiting"] = (
            "one poll of the waiting page is included, each further one costs 1 S3 GET (and another when the cache of "
            "the project is over 10 s old); one look at a DNS change that is not in sync yet is included, each "
            f"further one, every {dns.PAUSES[1]} s at first, costs 2 calls for all servers of its batch; the trial "
            "server's own calls are in a row of their own"
        )
        total = sum(counted.total() for counted in by_function.values())
        theirs = [*hippo.calls({step["key"]: step["page"] for step in study.steps}, start="2", stop="4")]
        detail["the yardstick"] = (
            f"HIPPO's calls for the same study and one poll, by its source: {dict(Counter(of for of, _ in theirs))}"
        )
        yield row(
            f"AWS calls, link to clean-up, {name}",
            total,
            "calls",
            yardstick=len(theirs),
            at_most=most,
            judge="value",
            detail=detail,
        )


# Bytes


def bytes_per_answer() -> Iterator[Row]:
    """Bytes that each answer writes: the first, and the last, against HIPPO's record of the same requests."""
    steps = 8
    pages = [{"key": str(n + 1), "page": "survey", "variants": 0} for n in range(steps)]
    pages.append({"key": "finalStep", "page": "debrief", "variants": 0})
    registration = {"id": "long", "live": True, "maxRuntime": 30, "steps": pages}
    with on_moto(registration) as study:
        browser, kept = Browser(study, "P1"), hippo.Record()
        written: list[int] = []
        page = browser.get()
        for _ in range(steps):
            body = urlencode({**hidden(page), **ANSWERS["4"]})
            theirs = kept.request(http_event("POST", browser.query, body))
            with study.world.recording() as calls:
                browser.post(page, ANSWERS["4"])
            written.append(sum(size(call.params["Body"]) for call in calls if call.operation == "PutObject"))
            page = browser.get()
    first, last = written[0], written[-1]
    detail = {
        "each answer in turn": written,
        "the yardstick": "HIPPO's record, to which the event of every request is appended; nobody loads a page twice",
    }
    yield row("bytes written by the first answer", first, "bytes")
    yield row("bytes written by the last answer, against the first", last, "bytes", yardstick=first, at_most=1)
    yield row(
        f"bytes written by the last of {steps} answers, against HIPPO's record of {steps} requests",
        last,
        "bytes",
        yardstick=theirs,
        at_most=1,
        detail=detail,
    )


def size(body: Any) -> int:
    """The bytes of a body in moto's recorder: a stream, or "<n bytes>"."""
    if isinstance(body, io.BytesIO):
        return body.getbuffer().nbytes
    return int(re.findall(r"\d+", str(body))[0])


# Cold start, and the trial server: against moto as a server in a process of its own

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
wall, cpu = time.perf_counter(), time.process_time()
from lambdas import next_step
answer = next_step.handler(event, None)
wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
assert answer["statusCode"] == 200 and len(answer["body"]) > 5000, answer
print(json.dumps([wall, cpu]))
"""

# The least that a function needs that makes the same calls: the same library, one client, no page.
YARDSTICK = f"""
import json, os, sys, time
project, user, page = sys.argv[1:]
wall, cpu = time.perf_counter(), time.process_time()
import botocore.session
s3, bucket = botocore.session.get_session().create_client("s3"), os.environ["BUCKET"]
s3.get_object(Bucket=bucket, Key="{MASTER_LIST}")["Body"].read()
s3.list_objects_v2(Bucket=bucket, Prefix=project + "/users/" + user + "/")
s3.put_object(Bucket=bucket, Key=project + "/users/" + user + "/participant.json", Body=b"{{}}", IfNoneMatch="*")
s3.get_object(Bucket=bucket, Key=page)["Body"].read()
wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
print(json.dumps([wall, cpu]))
"""

EMPTY = """
import json, time
wall, cpu = time.perf_counter(), time.process_time()  # since this process began
print(json.dumps([0.0, cpu]))
"""


class MotoServer:
    """moto behind a port of its own. `env` is what processes need to take it for AWS."""

    def __init__(self, log: Path) -> None:
        self._log = log
        with log.open("wb") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-c", MOTO], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors
            )
        assert self._process.stdout is not None
        port = self._process.stdout.readline().strip().decode()
        if not port:
            raise RuntimeError(f"moto did not start: {log.read_text()}")
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("AWS_")}
        self.env = {
            **inherited,
            "AWS_ACCESS_KEY_ID": "testing",
            "AWS_SECRET_ACCESS_KEY": "testing",  # moto takes any
            "AWS_REGION": "us-east-1",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
            "BUCKET": "hippodrome",
            "ROOT_DOMAIN": "example.org",
        }
        self.s3 = self._client()
        self.s3.create_bucket(Bucket="hippodrome")

    def _client(self) -> Any:
        import botocore.session

        env = self.env
        return botocore.session.get_session().create_client(
            "s3",
            region_name=env["AWS_REGION"],
            endpoint_url=env["AWS_ENDPOINT_URL"],
            aws_access_key_id=env["AWS_ACCESS_KEY_ID"],
            aws_secret_access_key=env["AWS_SECRET_ACCESS_KEY"],
        )

    def put(self, key: str, body: bytes) -> None:
        self.s3.put_object(Bucket="hippodrome", Key=key, Body=body)

    def requests(self) -> list[str]:
        """Every request so far: `PUT /hippodrome/some/key`."""
        return re.findall(r'"([A-Z]+ /\S*) HTTP/', self._log.read_text())

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@contextlib.contextmanager
def moto_server() -> Iterator[MotoServer]:
    with tempfile.TemporaryDirectory() as folder:
        server = MotoServer(Path(folder, "moto.log"))
        try:
            yield server
        finally:
            server.close()


def example_documents() -> dict[str, bytes]:
    """What a bucket holds once the example project is registered."""
    with on_moto() as study:
        s3, bucket = study.world.client("s3"), study.world.env["BUCKET"]
        keys = [line["Key"] for line in s3.list_objects_v2(Bucket=bucket)["Contents"]]
        return {key: s3.get_object(Bucket=bucket, Key=key)["Body"].read() for key in keys}


def fresh(code: str, env: Mapping[str, str], *arguments: str) -> tuple[float, float]:
    """Run code in a fresh process; the seconds it says it took, by the wall clock and of the processor."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=ROOT,
        env=dict(env),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip() or "a fresh process failed")
    wall, cpu = json.loads(done.stdout.splitlines()[-1])
    return wall, cpu


def cold_start() -> Iterator[Row]:
    """From the first import to a first visit's page, against botocore and the same calls; taken in turns."""
    documents = example_documents()
    with moto_server() as server:
        for key, body in documents.items():
            server.put(key, body)
        project = json.loads(documents[MASTER_LIST])["projects"][0]["id"]
        page = next(key for key in documents if "/steps/consent" in key)
        kinds: dict[str, Callable[[int], tuple[float, float]]] = {
            "ours": lambda n: fresh(
                OURS, server.env, json.dumps(http_event("GET", f"projectId={project}&userId=P{n}"))
            ),
            "yardstick": lambda n: fresh(YARDSTICK, server.env, project, f"Y{n}", page),
            "an empty Python, before both": lambda n: fresh(EMPTY, server.env),
        }
        for measure in kinds.values():
            measure(0)  # compiles what is not compiled yet
        taken: dict[str, list[tuple[float, float]]] = {kind: [] for kind in kinds}
        for n in range(RUNS):
            for kind, measure in kinds.items():
                taken[kind].append(measure(n + 1))
    for at, clock in ((1, "CPU"), (0, "wall")):
        times = {kind: [1000 * run[at] for run in runs] for kind, runs in taken.items()}
        detail = {kind: f"{min(t):.0f} to {max(t):.0f} ms in {len(t)} fresh processes" for kind, t in times.items()} | {
            "S3 requests": "4 of each: project, listing, participant, page"
        }
        yield row(
            f"next_step, import to first page, {clock}, against botocore and the same calls alone",
            statistics.median(times["ours"]),
            "ms",
            yardstick=statistics.median(times["yardstick"]),
            at_most=1.5,  # our own code and the page: at most half of what the library takes
            detail=detail,
        )


def calls_of_the_trial() -> Iterator[Row]:
    """S3 calls of a trial server itself: a real one, over TLS, from its certificate to the end of its first game."""
    with moto_server() as server:
        chain, private = _certificate()
        server.put("SSL/fullchain.pem", chain)
        server.put("SSL/privkey.pem", private)
        before = len(server.requests())
        trial = {"game": "ALE/MsPacman-v5", "maxEpisodes": 1, "ui": {"start": True, "stop": True}}
        variables = {
            "USER_ID": "P1",
            "GAME_STEPS": "3",
            "SSL_BUCKET": "hippodrome",
            "SSL_FULLCHAIN": "SSL/fullchain.pem",
            "SSL_PRIVKEY": "SSL/privkey.pem",
            "TLS": "on",
        }
        with trial_server(ROOT, "s3://hippodrome", trial, inherited=server.env, **variables) as (port, process):
            asyncio.run(asyncio.wait_for(_play(port), 60))
            process.wait(60)
        requests = [request.replace("/hippodrome/", "") for request in server.requests()[before:]]
    detail = {"each": ", ".join(requests), "more": "1 for each further recording; 2 an hour to renew the certificate"}
    yield row("S3 calls of the trial server, one episode", len(requests), "calls", detail=detail)


async def _play(port: int) -> None:
    """Begin a game, end it after a second, and stay until the trial is over."""
    from websockets.asyncio.client import connect
    from websockets.exceptions import ConnectionClosed

    trusting = ssl.create_default_context()
    trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE  # its name is another's, on loopback
    options: dict[str, Any] = {"subprotocols": ["hippodrome.1"], "compression": None, "max_size": None, "proxy": None}
    async with connect(f"wss://127.0.0.1:{port}/", ssl=trusting, **options) as ws:
        await ws.send(json.dumps({"userId": "P1", "token": "bench", "step": "3"}))
        await ws.send('{"command": "start"}')
        end, stopped = time.monotonic() + 1, False
        with contextlib.suppress(ConnectionClosed):
            while True:
                data = await ws.recv()
                if isinstance(data, bytes):
                    await ws.send(json.dumps({"ack": int.from_bytes(data[1:5], "big")}))
                if not stopped and time.monotonic() > end:
                    await ws.send('{"command": "stop"}')
                    stopped = True


def _certificate() -> tuple[bytes, bytes]:
    """A certificate for a few minutes, and its key."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - MINUTE)
        .not_valid_after(now + 30 * MINUTE)
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return made.public_bytes(serialization.Encoding.PEM), private
