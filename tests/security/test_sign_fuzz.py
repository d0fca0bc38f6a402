"""Thousands of hostile bodies to `sign_requests`, from a server that has a credential and from those who have none."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hippodrome.functions import installed, sign_requests
from testing import aws_events, exploration
from tests.security.hostile import TEXTS
from tests.security.test_servers_without_rights import MALLORY, Site

BODIES = exploration.examples(1_000)
TOWN = Site()
OWN, CREDENTIAL = TOWN.mallory.name, TOWN.credential
ANSWER = f"maze/users/{MALLORY}/answers/3.json"
RECORDING = f"maze/users/{MALLORY}/trials/{OWN}/3-trial.jsonl.gz"
READ = {ANSWER, *(f"SSL/servers.example.org/{file}.pem" for file in ("fullchain", "privkey"))}
CREATED = {ANSWER, RECORDING}

odd = st.sampled_from([*TEXTS, None, 0, 1, -1, True, 2**63, 10**400, 1e308, [], {}]) | st.text(max_size=20)


def disguised(text: str) -> list[str]:
    """Variants of the text that a less strict reader might take for it."""
    return [
        text, f"{text}\n", f"{text}\0", f" {text}", f"/{text}", f"{text}/", f"./{text}", text.upper(), text.replace("/", "//"), text.replace("/", "%2F"),
        text.replace("/", "\\"), text.replace("3", "\uff13"), text.replace("1", "01"), text.replace("-", "_"), f"{text}#", f"{text}?x", f"{text}/../{text}",
    ]  # fmt: skip


NEAR = sorted({one for text in [OWN, *sorted(READ | CREATED), *TOWN.others] for one in disguised(text)})
near = st.sampled_from(NEAR)
keys = st.sampled_from(sorted(READ | CREATED)) | near | odd
wishes = st.fixed_dictionaries(
    {"method": st.sampled_from(["GET", "PUT", "GET", "PUT", "get", "DELETE", "HEAD"]) | odd, "key": keys},
    optional={"size": st.sampled_from([0, 1, 64 * 1024, 64 * 1024 + 1, 5 * 1024**3, 5 * 1024**3 + 1]) | odd},
)
asked = st.fixed_dictionaries(
    {
        "server": st.just(OWN) | st.just(OWN) | near | odd,
        "credential": st.just(CREDENTIAL) | st.just(CREDENTIAL) | odd,
        "requests": st.lists(wishes, min_size=1, max_size=3) | st.lists(wishes, max_size=22) | odd,
    }
)


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


bodies = asked.map(_json) | asked.map(json.dumps) | st.text() | asked.map(lambda all_: _json(all_)[:-9])


@pytest.fixture(scope="module", autouse=True)
def site() -> Iterator[None]:
    installed.use(TOWN)  # type: ignore[arg-type] - it has what this function needs
    yield
    installed.use(None)


def send(body: str) -> dict[str, Any]:
    event = aws_events.load("http_post_json")
    event |= {"rawPath": "/sign", "rawQueryString": "", "body": body, "isBase64Encoded": False}
    answer: dict[str, Any] = sign_requests.handler(event, None)
    return answer


def check(body: str) -> int:
    """Send the body, and check that only the server's own documents were signed; returns the status."""
    answer = send(body)
    assert answer["statusCode"] in (200, 400, 403, 413)
    if answer["statusCode"] != 200:
        assert json.loads(answer["body"]).keys() == {"message"}
        assert "xss" not in answer["body"]
        return answer["statusCode"]
    asked = json.loads(body)
    assert (asked["server"], asked["credential"]) == (OWN, CREDENTIAL)
    for wish, request in zip(asked["requests"], json.loads(answer["body"])["requests"], strict=True):
        assert wish["key"] in (READ if wish["method"] == "GET" else CREATED)
        assert request["method"] == wish["method"]
        assert f"/{wish['key']}?" in request["url"]
        if wish["method"] == "PUT":
            assert request["headers"]["Content-Length"] == str(wish["size"])
            assert request["headers"]["If-None-Match"] == "*"
    return 200


@settings(max_examples=BODIES, deadline=None)
@given(bodies)
def test_no_body_gets_a_request_for_another_document(body: str) -> None:
    check(body)


def test_a_key_that_only_looks_like_the_servers_own_is_refused() -> None:
    wishes = [{"method": method, "key": key, "size": 1} for method in ("GET", "PUT") for key in NEAR]
    statuses = [check(_json({"server": OWN, "credential": CREDENTIAL, "requests": [wish]})) for wish in wishes]
    assert statuses.count(200) == len(READ) + len(CREATED)
    assert set(statuses) == {200, 403}


@pytest.mark.parametrize("name", [one for one in disguised(OWN) if one != OWN])
def test_a_name_that_only_looks_like_the_servers_own_is_refused(name: str) -> None:
    wish = {"method": "GET", "key": ANSWER}
    assert check(_json({"server": name, "credential": CREDENTIAL, "requests": [wish]})) == 403
