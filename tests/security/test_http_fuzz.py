"""Thousands of hostile requests to the three functions behind the HTTP API, and some hundreds over a real socket."""

from __future__ import annotations

import base64
import contextlib
import copy
import gzip
import io
import json
import random
import re
import socket
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from urllib.parse import quote, quote_plus

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from hippodrome.control.log import logger
from hippodrome.control.model import ids, participant, server
from hippodrome.control.model.records import to_json
from hippodrome.control.ports import Topic
from hippodrome.functions import (
    installed,
    next_step,
    send_start_server_message,
    send_stop_server_message,
    start_server,
    stop_server,
)
from hippodrome.local.web.app import App
from hippodrome.local.web.server import WebServer, listen
from testing import aws_events, exploration
from testing.fake_platform import FakePlatform
from tests.security import hostile
from tests.security.hostile import MINE, PROJECT, TEXTS, VICTIM

VISITS = 150 if not exploration.TIMES else 460 * exploration.TIMES  # each of up to twelve requests, by a new visitor
REQUESTS = 10 * VISITS  # at least
RAW = 500
PATIENCE = 2.0  # seconds; some requests promise more than they send
WEB = {
    "next_step": next_step.handler,
    "send_start_server_message": send_start_server_message.handler,
    "send_stop_server_message": send_stop_server_message.handler,
}
SECRETS = (hostile.study().secret, hostile.token(VICTIM), VICTIM)
WRITTEN = re.compile(
    rf"{PROJECT}/users/[A-Za-z0-9_-]{{1,64}}/(participant|answers/(1|2|4|finalStep))\.json"
    rf"|_servers/s[a-z2-7]{{20}}\.json|{PROJECT}/slots/[0-9]+\.json|_slots/{PROJECT}\.json"
)

texts = st.sampled_from(TEXTS) | st.text(max_size=30)
FIELDS = ["projectId", "userId", "PROLIFIC_PID", "workerId", "survey_code", "poll", "note", "x", "signature"]


def _ticket(step: str) -> str:
    return ids.ticket(hostile.study().secret, MINE, step)


def _field(name: str, value: str, encode: Any) -> str:
    try:
        return f"{encode(name)}={encode(value)}"
    except UnicodeEncodeError:
        return f"{name}={value}"


def _query(fields: list[tuple[str, str]], encode: Any) -> str:
    return "&".join(_field(name, value, encode) for name, value in fields)


# Mostly valid values, so that the requests also reach code behind the first checks.
pairs = st.tuples(st.sampled_from(FIELDS) | texts, st.sampled_from([PROJECT, MINE, "bob", "3"]) | texts)
encodings = st.sampled_from(
    [quote_plus, quote, lambda text: text, lambda text: text.encode("utf-16", "replace").hex("%")]
)
queries = st.one_of(
    st.just(f"projectId={PROJECT}&userId={MINE}"),
    st.builds(
        lambda fields, encode: f"projectId={PROJECT}&" + _query(fields, encode), st.lists(pairs, max_size=4), encodings
    ),
    st.builds(
        lambda note, encode: f"projectId={PROJECT}&userId={MINE}&" + _query([("note", note)], encode), texts, encodings
    ),
    st.builds(_query, st.lists(pairs, max_size=4), encodings),
    texts,
    st.just("&".join(f"projectId={PROJECT}" for _ in range(70))),
)  # fmt: skip
files = (
    st.sampled_from(["picture.svg", "consent-0.html", "..%2f..", "x.png", "\0.png", ".png", "a" * 5000 + ".png"])
    | texts
)
paths = st.one_of(
    st.sampled_from(
        ["/next", "/next", "/next", "/", "//xss.example/", "/\\xss.example", "/next\r\nxss: 1", "/next/../..", ""]
    ),
    st.builds(lambda file: f"/steps/{PROJECT}/{file}", files),
    st.builds(lambda project, file: f"/steps/{project}/{file}", texts, files),
    texts.map(lambda text: "/" + text),
)
fields = st.dictionaries(
    st.sampled_from(["consent", "age", "q", "token", "delay", "projectId", "userId"]) | texts, texts, max_size=4
)
signed = st.sampled_from(["1", "2", "3", "4", "finalStep"]).map(
    lambda step: {"hippodrome-step": step, "hippodrome-ticket": _ticket(step)}
)
forged = st.fixed_dictionaries(
    {},
    optional={
        "hippodrome-step": texts | st.sampled_from(["1", "3"]),
        "hippodrome-ticket": texts,
        "hippodrome-action": st.sampled_from(["restart", "xss"]),
        "token": texts | st.just(hostile.token(MINE)),
        "delay": texts | st.integers() | st.floats() | st.just("60"),
    },
)
answers = st.builds(lambda one, two: {**one, **two}, fields, signed | forged)
trees = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=6,
)


def _form(given: dict[str, Any]) -> str:
    return "&".join(_field(str(name), str(value), quote_plus) for name, value in given.items())


def _deep(depth: int) -> str:
    return '{"a":' * depth + "[]" + "}" * depth


BOMB = base64.b64encode(gzip.compress(b"a=" + b"0" * 3_000_000)).decode()
LARGE = st.sampled_from([
    "a=" + "<xss>" * 60_000, "&".join(f"f{n}=1" for n in range(2_500)), json.dumps({"a": "\"" * 100_000}), BOMB,
    json.dumps({str(n): n for n in range(2_500)}), "[" * 100_000, '{"a":' + "[" * 900 + "1," * 60_000,
    '{"a":' + "[" * 600 + "1" + ",1" * 60_000 + "]" * 600 + "}", '{"a":' + "9" * 5_000 + "}", '{"a": 1e999}',
])  # fmt: skip
bodies = st.one_of(
    st.builds(_form, answers),
    st.builds(lambda tree, more: json.dumps({"a": tree, **more}), trees, answers),
    st.builds(_form, answers).map(lambda text: base64.b64encode(text.encode("utf-8", "surrogatepass")).decode()),
    st.sampled_from([_deep(n) for n in (5, 19, 20, 21, 200, 900, 5_000, 40_000)]),
    st.binary(max_size=40).map(lambda data: base64.b64encode(data).decode()),
    texts,
)
FORM, JSON = "application/x-www-form-urlencoded", "application/json"
kinds = st.sampled_from([FORM, FORM, FORM, JSON, JSON]) | st.sampled_from([
    f"{FORM}; charset=utf-16", f"{JSON}; charset=utf-7", FORM.upper(), "multipart/form-data; boundary=xss", "text/plain", "",
    "application/json\r\nxss: 1", "application/x-gzip",
])  # fmt: skip
headers = st.builds(
    lambda accept, kind, encoding, more: {"accept": accept, "content-type": kind, "accept-encoding": encoding, **more},
    st.sampled_from(["text/html", "text/html", JSON, "*/*", "text/html;q=0,application/json", "xss"]),
    kinds,
    st.sampled_from(["", "gzip", "gzip;q=0", "br, gzip;q=0.5", "," * 2_000, "gzip" + " " * 2_000]),
    st.dictionaries(
        st.sampled_from(
            [
                "host",
                "x-forwarded-host",
                "origin",
                "referer",
                "cookie",
                "user-agent",
                "sec-purpose",
                "X-HTTP-Method-Override",
            ]
        ),
        texts,
        max_size=2,
    ),
)
methods = st.sampled_from(["GET"] * 4 + ["POST"] * 6 + ["HEAD", "OPTIONS", "PUT", "post", "XSS\r\nxss: 1", "é", ""])


def _event(method: str, path: str, query: str, header: dict[str, str], body: str, coded: bool) -> dict[str, Any]:
    return {**aws_events.http_event(method, query, body, path, header), "isBase64Encoded": coded}


plain = {"accept": "text/html", "content-type": FORM}
SIGNATURE = ids.link_signature(hostile.study().secret, PROJECT, MINE)
link = st.sampled_from(["", "&note=%3Cxss%3E", "&note=%0d%0axss:1"]).flatmap(
    lambda more: st.sampled_from([f"userId={MINE}&signature={SIGNATURE}"] * 9 + ["x="]).map(
        lambda who: f"projectId={PROJECT}&{who}{more}"
    )
)
whole = st.sampled_from([True, False, False, False, False])


def _near(method: str, form: dict[str, Any] | str, header: dict[str, str], query: str, coded: bool) -> dict[str, Any]:
    """Return a valid request, except for what the visitor wrote."""
    text = form if isinstance(form, str) else json.dumps(form) if header["content-type"] == JSON else _form(form)
    body = base64.b64encode(text.encode("utf-8", "surrogatepass")).decode() if coded else text
    return _event(method, "/next", query, header, body, coded)


near = st.builds(
    _near,
    st.sampled_from(["GET", "POST", "POST"]),
    answers | LARGE,
    headers
    | st.just(plain)
    | st.just({**plain, "content-type": JSON})
    | st.just({"accept": JSON, "content-type": JSON}),
    link,
    whole,
)
far = st.builds(_event, methods, paths, queries, headers, bodies | LARGE, whole)
proofs = st.sampled_from([
    {"hippodrome-step": "3", "hippodrome-ticket": _ticket("3")}, {"token": hostile.token(MINE)}, {"token": hostile.token(VICTIM)}, {},
])  # fmt: skip
delays = st.fixed_dictionaries(
    {}, optional={"delay": texts | st.integers() | st.sampled_from(["60", 60, 86_400, 86_401, True])}
)
relayed = st.builds(
    lambda proof, delay, query: _near("POST", {**proof, **delay}, {"content-type": JSON}, query, False),
    proofs,
    delays,
    link,
)
pages = st.tuples(st.just("next_step"), near | near | far)
relays = st.tuples(st.sampled_from(["send_start_server_message", "send_stop_server_message"]), relayed | near | far)
visits = st.lists(pages | pages | relays, min_size=11, max_size=12)


LIMITS: dict[str, Any] = {"max_participants": 3, "max_servers": 2, "max_server_hours": 2}
STUDIES = st.sampled_from([{}, {}, LIMITS, {"signed_links": True}, {"signed_links": True, **LIMITS}])


def _world(**changes: Any) -> FakePlatform:
    """Return a platform with the study, a participant with a running server, and one unknown to the attacker."""
    platform = hostile.installed(**changes)
    for user in (MINE, VICTIM):
        arrived = participant.new_participant(hostile.study(), user, {"note": "<xss>"}, platform.now())
        platform.documents.put(participant.participant_key(PROJECT, user), to_json(arrived))
        claim = server.new_attempt(
            hostile.study(), user, 1, nonce=hostile.NONCE, settings=platform.settings, now=platform.now()
        )
        platform.documents.put(server.key(claim.label), to_json(claim))
    return platform


def _only_what_may_be_written(before: dict[str, Any], platform: FakePlatform) -> None:
    kept = platform.documents.kept
    for key in kept.keys() - before.keys():
        assert WRITTEN.fullmatch(key), key
        assert len(kept[key][0]) < 4_000_000, "a small body made a huge document"
    for key, was in before.items():
        assert kept.get(key) == was, f"{key} was written over"


def _deliver(platform: FakePlatform) -> None:
    """Deliver the messages of the visit to the functions behind the queues."""
    for topic, handler in ((Topic.START, start_server.handler), (Topic.STOP, stop_server.handler)):
        messages = [message for sent, message in platform.bus.sent if sent is topic]
        for message in messages:
            assert message["projectId"] == PROJECT
            assert ids.is_user_id(message["userId"])
            assert message["userId"] != VICTIM
        for start in range(0, len(messages), 10):
            batch = aws_events.sqs_event(
                messages[start : start + 10], "arn:aws:sqs:us-east-1:123456789012:q", "us-east-1"
            )
            assert handler(batch, None) == {"batchItemFailures": []}
    for task in platform.tasks.running.values():
        assert re.fullmatch(r"s[a-z2-7]{20}-[1-8]", task.name)
    for timer in platform.timers.due:
        assert re.fullmatch(r"s[a-z2-7]{20}-[1-8](-delay)?", timer)


@pytest.fixture
def _put_back() -> Iterator[None]:
    yield
    installed.use(None)


@pytest.mark.usefixtures("_put_back")
@pytest.mark.timeout(600)
@pytest.mark.explores
def test_thousands_of_hostile_requests_have_no_effect(capsys: pytest.CaptureFixture[str]) -> None:
    """There is no status 5xx, no exception, no unescaped text, no header of the attacker's, and no changed document but the visitor's own."""
    seen: Counter[str] = Counter()
    statuses: Counter[int] = Counter()
    said = io.StringIO()
    before_stream = logger.registered_handler.setStream(said)  # type: ignore[attr-defined]

    @settings(max_examples=VISITS, phases=[Phase.explicit, Phase.generate, Phase.shrink])
    @given(STUDIES, visits)
    def visit(changes: dict[str, Any], requests: list[tuple[str, dict[str, Any]]]) -> None:
        platform = _world(**changes)
        installed.use(platform)
        before = dict(platform.documents.kept)
        for name, event in requests:
            answer = WEB[name](event, None)
            seen[name] += 1
            statuses[hostile.check_answer(answer)] += 1
            told = json.dumps(answer["headers"]).encode() + hostile.body_of(answer)
            for secret in SECRETS:
                assert secret.encode() not in told
        _only_what_may_be_written(before, platform)
        _deliver(platform)

    try:
        visit()
    finally:
        logger.registered_handler.setStream(before_stream)  # type: ignore[attr-defined]
    with capsys.disabled():
        print(f"\n{seen.total()} hostile requests ({dict(seen)}): {dict(sorted(statuses.items()))}")
    assert seen.total() >= REQUESTS
    assert min(seen[name] for name in WEB) >= VISITS // 2
    assert statuses.keys() >= {200, 202, 204, 302, 303, 400, 403, 404, 405, 409, 413, 415}, "the fuzz does not get far"
    log = said.getvalue()
    assert "request failed" not in log
    for line in log.splitlines():
        json.loads(line)  # no line is the attacker's
    assert "xss" not in log
    assert MINE not in log


# Over a real socket


class Site:
    """The web server of `make run` with the real functions on a platform in memory."""

    def __init__(self) -> None:
        self.platform = _world()
        installed.use(self.platform)
        self.said: list[str] = []
        self.server = WebServer(App(WEB, self.said.append), listen(0))
        self.server.start()

    def ask(self, raw: bytes, patience: float = PATIENCE) -> bytes:
        """Send bytes, and read until the server closes the connection or waits for more."""
        host, port = self.server.url.removeprefix("http://").split(":")
        got = b""
        with socket.create_connection((host, int(port)), timeout=patience) as asked, contextlib.suppress(OSError):
            asked.sendall(raw)  # the server has answered with an error before it read all
            while more := asked.recv(65536):
                got += more
        return got


@pytest.fixture
def site() -> Iterator[Site]:
    made = Site()
    yield made
    made.server.close()
    installed.use(None)


def _raw(chance: random.Random) -> bytes:
    """Bytes that are almost an HTTP request."""
    text = chance.choice(TEXTS).encode("utf-8", "surrogatepass")
    other = quote(chance.choice(TEXTS).encode("utf-8", "surrogatepass")).encode()
    path = chance.choice([
        *[b"/next?projectId=maze&userId=alice&note=" + other] * 9, b"/next?projectId=maze&userId=" + other, b"/next?projectId=maze&note=" + text,
        b"/next?projectId=maze&userId=alice&note=" + other, b"//xss.example/?projectId=maze", b"/next%0d%0axss:1?projectId=maze",
        b"/steps/maze/" + other + b".png", b"/steps/maze/..%2f..%2fproject_master_list.json", b"/steps/%2e%2e/x.png", b"/start", b"/stop",
        b"/start?projectId=maze&userId=alice", b"/stop?projectId=maze&userId=" + other, b"http://xss.example/next?projectId=maze",
        b"/next/?projectId=maze", text, b"*", b"/" + b"a" * 9_000,
    ])  # fmt: skip
    method = chance.choice([b"GET"] * 6 + [b"POST"] * 9 + [b"HEAD", b"OPTIONS", b"PUT", b"XSS", text[:8]])
    body = chance.choice(
        [b"a=1&b=" + other, b'{"a":"' + text + b'"}', b"[" * 30_000, text, b"", gzip.compress(b"0" * 10_000)]
    )
    headers = [b"Host: localhost", b"Connection: close"]
    headers += [b"Content-Type: application/x-www-form-urlencoded"] * (chance.random() < 0.5)
    headers += chance.sample([
        b"Accept: text/html", b"Accept: application/json", b"Content-Type: application/x-www-form-urlencoded",
        b"Content-Type: application/json", b"Content-Encoding: gzip", b"X-Forwarded-Host: xss.example", b"X: " + text,
        b"Transfer-Encoding: chunked", b"Content-Length: 99999999999", b"Content-Length: -1", b"Cookie: " + other,
        b"Expect: 100-continue", b"Upgrade: websocket", b"X" + text + b": 1", b"Accept-Encoding: gzip", b"Range: bytes=0-1",
    ], chance.choice([0, 0, 1, 1, 2, 4]))  # fmt: skip
    if chance.random() < 0.95:
        headers.append(b"Content-Length: %d" % len(body))
    version = chance.choice([b"HTTP/1.1"] * 9 + [b"HTTP/1.0", b"HTTP/9.9", b"HTTP/2"])
    return method + b" " + path + b" " + version + b"\r\n" + b"\r\n".join(headers) + b"\r\n\r\n" + body


@pytest.mark.timeout(120)
def test_hundreds_of_raw_requests_over_a_socket_have_no_effect(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    """Through a real HTTP server: any bytes get a status below 500 or a closed connection."""
    chance = random.Random(20261121)
    before = copy.copy(site.platform.documents.kept)
    statuses: Counter[str] = Counter()
    requests = [_raw(chance) for _ in range(RAW)]
    with ThreadPoolExecutor(16) as threads:
        told = list(threads.map(site.ask, requests))
    for raw, answer in zip(requests, told, strict=True):
        head, _, body = answer.partition(b"\r\n\r\n")
        status = re.match(rb"HTTP/1\.[01] (\d{3}) ", head)
        statuses[status[1].decode() if status else "no answer"] += 1
        if not status:
            assert answer == b"", answer[:100]
            continue
        assert 100 <= int(status[1]) < 500, (raw, answer[:500])
        names = [line.split(b":")[0].lower() for line in head.split(b"\r\n")[1:]]
        assert not any(b"xss" in name for name in names), head
        if b"text/html" in head and b"content-encoding" not in head.lower() and body:
            hostile.check_html(body.decode())
        for secret in SECRETS:
            assert secret.encode() not in answer
    with capsys.disabled():
        print(f"\n{RAW} raw requests: {dict(sorted(statuses.items()))}")
    assert statuses.keys() >= {"200", "302", "400", "404", "415"}, "the fuzz does not get far"
    assert not site.said
    _only_what_may_be_written(before, site.platform)
    healthy = site.ask(b"GET /healthz HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n", patience=60)
    assert healthy.startswith(b"HTTP/1.1 200")
