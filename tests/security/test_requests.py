"""Single hostile requests have no effect: paths, nesting, names, compression, other origins, guesses."""

from __future__ import annotations

import gzip
import io
import json
import re
from collections.abc import Iterator
from typing import Any

import pytest

from hippodrome.control.model import ids, server
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import Server
from hippodrome.control.participants.forms import MAX_DEPTH
from hippodrome.control.ports import Topic
from hippodrome.control.storage.secret import SecretCache
from hippodrome.functions import (
    installed,
    next_step,
    send_start_server_message,
    send_stop_server_message,
    start_server,
    sweep,
)
from testing import aws_events
from testing.aws_events import http_event
from testing.fake_platform import FakePlatform
from tests.security import hostile
from tests.security.hostile import MINE, PROJECT

FORM, JSON = "application/x-www-form-urlencoded", "application/json"
LINK = f"projectId={PROJECT}&userId={MINE}"


@pytest.fixture
def platform() -> Iterator[FakePlatform]:
    made = hostile.installed()
    installed.use(made)
    yield made
    installed.use(None)


def send(method: str = "GET", query: str = LINK, body: str = "", path: str = "/next", **headers: str) -> dict[str, Any]:
    named = {"accept": "text/html", "content-type": FORM, **{k.replace("_", "-"): v for k, v in headers.items()}}
    event = http_event(method, query, body, path, named)
    answer: dict[str, Any] = next_step.handler(event, None)
    assert hostile.check_answer(answer) < 500
    return answer


# Headers and addresses


@pytest.mark.parametrize(
    "path",
    [
        "//xss.example/",
        "///xss.example",
        "/\\xss.example/",
        "\\\\xss.example",
        "/next\r\nxss: 1",
        "/next\n\n<xss>",
        "/\u2028\0\x7f",
        "https://xss.example/",
        "/é\ud800",
    ],
)
def test_a_path_becomes_neither_a_header_nor_another_host(platform: FakePlatform, path: str) -> None:
    location = send(query=f"projectId={PROJECT}", path=path)["headers"]["Location"]
    assert re.fullmatch(r"/([!-.0-\[\]-~][!-\[\]-~]*)?\?projectId=maze&userId=[0-9a-f]{24}", location)
    page = send(path=path)["body"]
    assert re.search(r'action="(/[^"]*)"', page)  # `check_answer` has checked the address


def test_a_link_with_half_a_surrogate_pair_is_refused(platform: FakePlatform) -> None:
    """One half of a surrogate pair can be neither stored nor sent back."""
    before = dict(platform.documents.kept)
    for query in (f"{LINK}&note=\ud800", f"projectId={PROJECT}&note=\ud800", f"{LINK}&note=%ed%a0%80"):
        assert send(query=query)["statusCode"] == 400
    assert platform.documents.kept == before


# Bodies


def nested(depth: int, inside: str = "1") -> str:
    """Return a JSON object with so many levels, including itself."""
    return '{"a":' + "[" * (depth - 1) + inside + "]" * (depth - 1) + "}"


def test_answers_nested_too_deeply_are_refused(platform: FakePlatform) -> None:
    send()
    for depth in (MAX_DEPTH + 1, 500, 990, 2_000, 100_000):
        assert send("POST", body=nested(depth), content_type=JSON)["statusCode"] == 400
    assert send("POST", body=nested(MAX_DEPTH), content_type=JSON)["statusCode"] == 303
    assert send()["statusCode"] == 200  # the page that shows them


def test_a_small_body_does_not_become_a_huge_document(platform: FakePlatform) -> None:
    """Documents are indented: each of these numbers has its own line, with a space for each level."""
    send()
    body = nested(MAX_DEPTH, "1" + ",1" * 120_000)
    assert len(body) < 256 * 1024
    assert send("POST", body=body, content_type=JSON)["statusCode"] == 303
    assert len(platform.documents.kept[f"{PROJECT}/users/{MINE}/answers/1.json"][0]) < 4_000_000


def test_a_number_that_cannot_be_stored_is_refused(platform: FakePlatform) -> None:
    send()
    for number in ("1e999", "-1e999", "NaN", "Infinity", "9" * 5_000):
        assert send("POST", body=f'{{"a": [{number}]}}', content_type=JSON)["statusCode"] == 400
    assert send("POST", body='{"a": 1e308}', content_type=JSON)["statusCode"] == 303


def test_a_compressed_body_is_never_unpacked(platform: FakePlatform) -> None:
    """So a zip bomb is only a few bytes that are no form."""
    send()
    bomb = gzip.compress(b"a=" + b"0" * 30_000_000)
    for kind in (FORM, JSON):
        event = http_event("POST", LINK, bomb, headers={"content-type": kind, "content-encoding": "gzip"})
        assert next_step.handler(event, None)["statusCode"] == 400


# Files


@pytest.mark.parametrize(
    "path",
    [
        "/steps/maze/../../project_master_list.json",
        "/steps/maze/..%2fmirror.html",
        "/steps/maze/mirror.html",
        "/steps/../_servers/x.json",
        "/steps/maze/.svg",
        "/steps/maze/a/b.svg",
        "/steps/maze//picture.svg",
        "/steps/maze\0/picture.svg",
        "/steps/maze/\0.svg",
        "/steps/maze/\r\n.svg",
        "/steps/maze/\ud800.svg",
        "/steps/maze/" + "a" * 1_000 + ".svg",
        "/steps/SSL/privkey.pem",
        "/steps/maze/..",
        "/steps/maze/",
    ],
)
def test_no_path_leads_to_another_document(platform: FakePlatform, path: str) -> None:
    """Nor are keys requested that S3 would refuse (longer than 1,024 bytes): that would be an error in the function."""
    platform.documents.put("SSL/privkey.pem", b"secret")
    platform.documents.put(f"{PROJECT}/steps/.svg", b"<svg/>")
    asked = []
    get = platform.documents.get
    platform.documents.get = lambda key, known=None: asked.append(key) or get(key, known)  # type: ignore[method-assign]
    assert send(path=path, query="")["statusCode"] == 404
    for key in asked:
        assert key in ("project_master_list.json", "_secret.json") or re.fullmatch(
            r"maze/steps/[^/\\.\0][^/\0]{0,200}", key
        )


def test_a_picture_with_a_script_in_it_is_sandboxed(platform: FakePlatform) -> None:
    answer = send(path=f"/steps/{PROJECT}/picture.svg", query="")
    assert answer["statusCode"] == 200
    assert answer["headers"]["Content-Security-Policy"] == "default-src 'none'; style-src 'unsafe-inline'; sandbox"
    assert answer["headers"]["X-Content-Type-Options"] == "nosniff"


# Identity


def test_no_cookie_is_set_or_accepted(platform: FakePlatform) -> None:
    """A request that another site makes a browser send contains nothing that the other site does not know."""
    send()
    cookie = f"userId={MINE}; projectId={PROJECT}"
    before = dict(platform.documents.kept)
    for query in ("", f"projectId={PROJECT}"):
        answer = send("POST", query, "consent=no", cookie=cookie, origin="https://xss.example")
        assert answer["statusCode"] in (200, 400, 404)
        assert "set-cookie" not in {name.lower() for name in answer["headers"]}
        assert "cookies" not in answer
    assert platform.documents.kept == before


def test_another_sites_form_answers_only_the_step_that_is_due(platform: FakePlatform) -> None:
    """It has no ticket. Without an id it reaches no participant; with one it can do only what that participant could do now."""
    send()
    other = {"origin": "https://xss.example", "referer": "https://xss.example/"}
    for forged in ("", "0" * 32, ids.ticket("guessed", MINE, "4"), ids.ticket(hostile.study().secret, "bob", "4")):
        send("POST", body=f"q=xss&hippodrome-step=4&hippodrome-ticket={forged}", **other)
    assert not [key for key in platform.documents.kept if "/answers/" in key]


def test_a_form_sent_again_later_changes_nothing(platform: FakePlatform) -> None:
    ticket = ids.ticket(hostile.study().secret, MINE, "1")
    body = f"consent={{}}&hippodrome-step=1&hippodrome-ticket={ticket}"
    send()
    send("POST", body=body.format("yes"))
    first = dict(platform.documents.kept)
    for _ in range(3):
        assert send("POST", body=body.format("no"))["statusCode"] == 303
    assert platform.documents.kept == first


def test_a_stop_sent_again_does_not_reach_the_next_server(platform: FakePlatform) -> None:
    """A repeated request to the relay has the token of an ended server, which is no proof any more, and its message names the attempt."""
    keys = SecretCache(platform.documents)
    keys.get_or_create()
    earlier, claim = (
        server.new_attempt(hostile.study(), MINE, n, nonce=f"nonce-{n}", settings=platform.settings, now=platform.now())
        for n in (1, 2)
    )
    platform.documents.put(server.key(claim.label), json.dumps(_plain(claim)).encode())
    for token in (keys.token(earlier), "", f"{keys.token(claim)} ", claim.nonce):
        event = http_event("POST", LINK, json.dumps({"token": token}), headers={"content-type": JSON})
        assert send_stop_server_message.handler(event, None)["statusCode"] == 403
    event["body"] = json.dumps({"token": keys.token(claim)})
    assert send_stop_server_message.handler(event, None)["statusCode"] == 202
    [(topic, message)] = platform.bus.sent
    assert (topic, message["attempt"]) == (Topic.STOP, 2)


def _plain(record: Server) -> Any:
    import msgspec

    return msgspec.to_builtins(record)


def test_tokens_tickets_ids_and_codes_are_long_and_never_repeat(platform: FakePlatform) -> None:
    """Tokens have 192 bits, tickets 128, generated ids 96, completion codes 50 of an HMAC."""
    tokens, made_up = set(), set()
    for number in range(20):
        batch = aws_events.sqs_event(
            [{"projectId": PROJECT, "userId": f"u{number}"}], "arn:aws:sqs:us-east-1:1:q", "us-east-1"
        )
        start_server.handler(batch, None)
        label = ids.server_label(PROJECT, f"u{number}")
        record = from_json(platform.documents.kept[server.key(label)][0], Server)
        tokens.add(SecretCache(platform.documents).token(record))
        made_up.add(send(query=f"projectId={PROJECT}")["headers"]["Location"].rpartition("=")[2])
    assert len(tokens) == len(made_up) == 20
    assert all(len(bytes.fromhex(token)) == 24 for token in tokens)
    assert all(len(bytes.fromhex(user)) == 12 for user in made_up)
    assert len(bytes.fromhex(ids.ticket("s", "u", "1"))) == 16
    assert len(ids.completion_code("s", "u")) == 10


def test_a_page_may_not_be_framed_by_another_site(platform: FakePlatform) -> None:
    """So no other site can make participants click on something that they do not see."""
    assert "frame-ancestors 'none'" in send()["headers"]["Content-Security-Policy"]


# Costs that strangers could cause


def test_a_signed_link_lets_in_only_its_own_participant() -> None:
    platform = hostile.installed(signed_links=True)
    installed.use(platform)
    before = dict(platform.documents.kept)
    good = ids.link_signature(hostile.study().secret, PROJECT, MINE)
    for query in (
        LINK,
        f"{LINK}&signature=",
        f"{LINK}&signature={good[:-1]}",
        f"{LINK}&signature={good.upper()}",
        f"{LINK}&signature={good}&signature=x",
        f"{LINK}&signature={ids.link_signature('guessed', PROJECT, MINE)}",
        f"projectId={PROJECT}&userId=bob&signature={good}",
        f"projectId={PROJECT}&signature={good}",
    ):
        assert send(query=query)["statusCode"] == 403
        assert send("POST", query, "consent=yes", accept=JSON)["statusCode"] in (400, 403)
        assert send("GET", f"{query}&poll=3")["statusCode"] == 403
    assert platform.documents.kept == before
    assert send(query=f"{LINK}&signature={good}")["statusCode"] == 200
    installed.use(None)


def test_a_thousand_invented_ids_do_not_exceed_the_limit() -> None:
    platform = hostile.installed(max_participants=5)
    installed.use(platform)
    for number in range(1_000):
        send(query=f"projectId={PROJECT}&userId=stranger-{number}")
    known = [key for key in platform.documents.kept if key.endswith("/participant.json")]
    assert len(known) == 5
    installed.use(None)


def test_visitors_who_only_look_cost_nothing(platform: FakePlatform) -> None:
    """Crawlers, prefetching browsers, HEAD, and Mechanical Turk's previews: nothing is written or started."""
    before = dict(platform.documents.kept)
    send("HEAD")
    send(sec_purpose="prefetch;prerender")
    send(user_agent="WhatsApp/2.2")
    send(query=f"projectId={PROJECT}&workerId=A1&assignmentId=ASSIGNMENT_ID_NOT_AVAILABLE")
    assert platform.documents.kept == before
    assert not platform.bus.sent


# Logs and metrics


def test_metrics_hold_no_id(
    platform: FakePlatform, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STACK", "hippodrome")
    batch = aws_events.sqs_event([{"projectId": PROJECT, "userId": MINE}], "arn:aws:sqs:us-east-1:1:q", "us-east-1")
    start_server.handler(batch, None)
    capsys.readouterr()
    sweep.handler({}, None)
    [line] = [line for line in capsys.readouterr().out.splitlines() if "_aws" in line]
    assert json.loads(line)["Servers"] == [1.0]
    assert MINE not in line
    assert PROJECT not in line
    assert ids.server_label(PROJECT, MINE) not in line


def test_an_internal_error_shows_no_id_no_answer_and_no_path(platform: FakePlatform, log: io.StringIO) -> None:
    def broken(*args: Any, **kwargs: Any) -> Any:
        raise RuntimeError(f"{MINE} answered xss-answer")

    for name in ("get", "list", "create"):
        setattr(platform.documents, name, broken)
    for handler in (next_step.handler, send_start_server_message.handler, send_stop_server_message.handler):
        for accept in ("text/html", JSON):
            event = http_event("POST", LINK, "q=xss-answer", headers={"accept": accept, "content-type": FORM})
            answer = handler(event, None)
            assert answer["statusCode"] == 500
            for private in (MINE, "xss-answer", "Traceback", "hippodrome/control/", "RuntimeError"):
                assert private not in json.dumps(answer)
    assert "RuntimeError" in log.getvalue()
    assert MINE not in log.getvalue()
    assert "xss-answer" not in log.getvalue()
