"""Measures the control plane: cold starts, AWS calls, bytes. Everything runs on moto, which counts the calls.

The study is the example project, with its real pages.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import re
import ssl
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import timedelta
from typing import Any
from urllib.parse import urlencode

from bench.moto_server import moto_server
from bench.study_on_moto import ANSWERS, ROOT, MeasuredBrowser, http_event, on_moto, travel, warm
from bench.table import Row, each, row
from bench.trial_server import trial_server
from hippodrome.certificates.rules import location
from hippodrome.config import read_project
from hippodrome.model import server
from hippodrome.model.project import MASTER_LIST
from hippodrome.servers import dns
from hippodrome.storage import secret
from testing.certificates import authority
from testing.simulation import hippo
from testing.strict_s3 import BUCKET, StrictS3
from testing.studies import study
from testing.visitors import hidden

RUNS = 11  # fresh processes of each kind
MINUTE = timedelta(minutes=1)


def rows() -> Iterator[Row]:
    """Measure everything, one row after another; about a minute."""
    yield from each([cold_start, calls_of_requests, calls_of_a_participant, calls_of_the_trial, bytes_per_answer])


HIPPO_CALLS = {  # HIPPO's AWS calls of one request; it has the same for the first visit of a page and for its answer
    "GET": len([*hippo.page_calls("survey")]),
    "POST": len([*hippo.page_calls("survey")]),
    "POST that publishes": len([*hippo.page_calls("survey", publishes=True)]),
    "poll": len([*hippo.page_calls("game", waiting=True)]),
}


def calls_of_requests() -> Iterator[Row]:
    """Count the AWS calls of `next_step` for each kind of request. Its caches are warm, as in a running study."""
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
            bound="ours: what a request may cost in a running study",
            detail=detail,
        )


def calls_of_a_participant() -> Iterator[Row]:
    """Count the AWS calls for a whole participant, from the link until everything is cleaned up."""
    limits = {"maxParticipants": 100, "maxServers": 10, "maxServerHours": 50}
    limited = read_project(ROOT).registration() | limits
    for name, pause, registration, most in (
        ("in a running study", timedelta(), None, 30),
        ("alone, at a minute a page: caches stale", MINUTE, None, 39),
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
            "HIPPO's calls for the same study and one poll, by its source: "
            f"{dict(Counter(function for function, _ in theirs))}"
        )
        yield row(
            f"AWS calls, link to clean-up, {name}",
            total,
            "calls",
            yardstick=len(theirs),
            at_most=most,
            judge="value",
            bound="ours: docs/architecture.md, 'What a participant costs', has the usual figures",
            detail=detail,
        )


# Bytes


def bytes_per_answer() -> Iterator[Row]:
    """Measure the bytes that the first and the last answer write, beside HIPPO's record of the same requests."""
    steps = 8
    pages = [{"key": str(n + 1), "page": "survey", "variants": 0} for n in range(steps)]
    pages.append({"key": "finalStep", "page": "debrief", "variants": 0})
    registration = {"id": "long", "live": True, "maxRuntime": 30, "steps": pages}
    with on_moto(registration) as study:
        browser, record = MeasuredBrowser(study, "P1"), hippo.HippoRecord()
        written: list[int] = []
        page = browser.get()
        for _ in range(steps):
            body = urlencode({**hidden(page), **ANSWERS["4"]})
            theirs = record.request(http_event("POST", browser.query, body))
            with study.world.recording() as calls:
                browser.post(page, ANSWERS["4"])
            written.append(sum(size(call.params["Body"]) for call in calls if call.operation == "PutObject"))
            page = browser.get()
    yield from judged_bytes(written, theirs)


def judged_bytes(written: Sequence[int], theirs: int) -> Iterator[Row]:
    """Yield the rows of the bytes that each answer writes. `theirs` are the bytes that HIPPO writes for the last."""
    first, last = written[0], written[-1]
    detail = {
        "each answer in turn": written,
        "the yardstick": "HIPPO's record, to which the event of every request is appended; no page is loaded twice",
    }
    yield row("bytes written by the first answer", first, "bytes")
    yield row("bytes written by the last answer, against the first", last, "bytes", yardstick=first, at_most=1)
    yield row(
        f"bytes written by the last of {len(written)} answers, against HIPPO's record of {len(written)} requests",
        last,
        "bytes",
        yardstick=theirs,
        at_most=1,
        detail=detail,
    )


def size(body: Any) -> int:
    """Return the size of a body in the recorded parameters of a call: a stream, or the text "<n bytes>"."""
    if isinstance(body, io.BytesIO):
        return body.getbuffer().nbytes
    return int(re.findall(r"\d+", str(body))[0])


# The cold start, on moto's server in a process of its own

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

# The simplest code that makes the same calls: the same library, one client, no page.
YARDSTICK = f"""
import json, os, sys, time
project, user, page = sys.argv[1:]
wall, cpu = time.perf_counter(), time.process_time()
import botocore.session
s3, bucket = botocore.session.get_session().create_client("s3"), os.environ["BUCKET"]
s3.get_object(Bucket=bucket, Key="{MASTER_LIST}")["Body"].read()
s3.get_object(Bucket=bucket, Key="{secret.KEY}")["Body"].read()
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


def fresh(code: str, env: Mapping[str, str], *arguments: str) -> tuple[float, float]:
    """Run code in a new process; return the seconds that it reports, by the wall clock and of processor time.

    Raises RuntimeError if the process fails.
    """
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


def example_documents() -> dict[str, bytes]:
    """Return the documents of a bucket with the registered example project, by key."""
    with on_moto() as study:
        s3, bucket = study.world.client("s3"), study.world.env["BUCKET"]
        keys = [line["Key"] for line in s3.list_objects_v2(Bucket=bucket)["Contents"]]
        return {key: s3.get_object(Bucket=bucket, Key=key)["Body"].read() for key in keys}


def cold_start() -> Iterator[Row]:
    """Measure the time from the first import to the first page, and beside it that of botocore with the same calls.

    Fresh processes of each kind take turns, so that load on the machine slows down all kinds.
    """
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
            measure(0)  # the first run compiles modules that have no bytecode yet
        taken: dict[str, list[tuple[float, float]]] = {kind: [] for kind in kinds}
        asked: dict[str, int] = {}
        for n in range(RUNS):
            for kind, measure in kinds.items():
                before = len(server.requests())
                taken[kind].append(measure(n + 1))
                asked[kind] = len(server.requests()) - before
    if asked["ours"] != asked["yardstick"]:
        raise RuntimeError(f"the two do not make as many calls: {asked}")
    yield from judged_start(taken, asked["ours"])


def judged_start(taken: Mapping[str, Sequence[tuple[float, float]]], requests: int) -> Iterator[Row]:
    """Yield the rows of the cold start.

    `taken` has, by kind of run, seconds by the wall clock and of the processor. `requests` counts those of each to S3.
    """
    for at, clock in ((1, "CPU"), (0, "wall")):
        times = {kind: [1000 * run[at] for run in runs] for kind, runs in taken.items()}
        detail = {kind: f"{min(t):.0f} to {max(t):.0f} ms in {len(t)} fresh processes" for kind, t in times.items()} | {
            "S3 requests of each": requests
        }
        yield row(
            f"next_step, import to first page, {clock}, against botocore and the same calls alone",
            statistics.median(times["ours"]),
            "ms",
            yardstick=statistics.median(times["yardstick"]),
            at_most=1.5,  # our own code and the page may take half of the library's time
            detail=detail,
        )


def calls_of_the_trial() -> Iterator[Row]:
    """Count the requests of a real trial server with TLS, from its certificate to the end of its first episode."""
    with StrictS3().serving() as bucket, tempfile.TemporaryDirectory() as spool:
        project, now = study(id="bench"), bucket.now()
        record = server.new_attempt(project, "P1", 1, settings=bucket.settings, now=now, nonce="bench")
        files = location(record.domain, bucket.settings.root_domain)
        for key, pem in zip((files.fullchain, files.privkey), authority().issue("localhost"), strict=True):
            bucket.documents.put(key, pem)
        variables = bucket.variables(bucket.keep(record))
        trial = {"game": "ALE/MsPacman-v5", "maxEpisodes": 1, "ui": {"start": True, "stop": True}}
        serving = trial_server(
            ROOT,
            variables["STORE"],
            trial,
            SERVER=variables["SERVER"],
            CREDENTIAL=variables["CREDENTIAL"],
            USER_ID="P1",
            GAME_STEPS=",".join(project.game_steps),
            SSL_FULLCHAIN=files.fullchain,
            SSL_PRIVKEY=files.privkey,
            TLS="on",
            SPOOL=spool,
        )
        with serving as (port, process):
            asyncio.run(asyncio.wait_for(_play(port, project.game_steps[0]), 60))
            process.wait(60)
        requests = [f"{method} {path.removeprefix(f'/{BUCKET}')}" for method, path, _ in bucket.requests]
    more = "2 for each further recording, and for each document of an earlier server; 4 an hour for the certificate"
    detail = {"each": ", ".join(requests), "more": more}
    yield row("requests of the trial server, one episode", len(requests), "requests", detail=detail)


async def _play(port: int, step: str) -> None:
    """Start the game, stop it after a second, and stay until the trial is over."""
    from websockets.asyncio.client import connect
    from websockets.exceptions import ConnectionClosed

    trusting = ssl.create_default_context()
    trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE  # the certificate has another name
    options: dict[str, Any] = {"subprotocols": ["hippodrome.1"], "compression": None, "max_size": None, "proxy": None}
    async with connect(f"wss://127.0.0.1:{port}/", ssl=trusting, **options) as ws:
        await ws.send(json.dumps({"userId": "P1", "token": "bench", "step": step}))
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
