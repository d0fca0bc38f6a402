"""The relays accept requests only from a participant who exists, has a server step, and proves who they are."""

from __future__ import annotations

import json
from typing import Any
from urllib.parse import urlencode

import pytest

from hippodrome.control.model import ids, server
from hippodrome.control.model.messages import StartServer
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import Server
from hippodrome.control.ports import Topic
from hippodrome.control.storage.secret import SecretCache
from hippodrome.functions import send_start_server_message, send_stop_server_message
from testing.aws_events import JSON, http_event
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import SECRET

PROOF = {"hippodrome-step": "1", "hippodrome-ticket": ids.ticket(SECRET, "alice", "1")}
START, STOP = send_start_server_message, send_stop_server_message


@pytest.fixture
def platform(platform: FakePlatform) -> FakePlatform:
    platform.documents.put("maze/users/alice/participant.json", b"{}")
    platform.documents.put("maze/users/alice/answers/1.json", b"{}")
    return platform


def ask(function: Any, query: str = "projectId=maze&userId=alice", **body: object) -> int:
    headers = {"content-type": JSON, "accept": JSON}
    event = http_event("POST", query, json.dumps(body), "/relay", headers)
    response = function.handler(event, None)
    assert "message" in json.loads(response["body"])
    return int(response["statusCode"])


def test_a_participant_may_ask_for_their_server(platform: FakePlatform) -> None:
    assert ask(START, **PROOF) == 202
    assert platform.bus.sent == [(Topic.START, {"projectId": "maze", "userId": "alice"})]


@pytest.mark.parametrize("proof", [
    {}, {"hippodrome-step": "1", "hippodrome-ticket": "0" * 32}, {"token": "guess"}, {"token": ""}, {"token": None},
    {"hippodrome-step": "1", "hippodrome-ticket": ids.ticket(SECRET, "bob", "1")},
    {"hippodrome-step": "nope", "hippodrome-ticket": ids.ticket(SECRET, "alice", "nope")},
])  # fmt: skip
def test_a_request_without_a_valid_proof_may_not_start_or_stop_a_server(
    platform: FakePlatform, proof: dict[str, object]
) -> None:
    Servers(platform).start(StartServer("maze", "alice"))
    assert ask(START, **proof) == 403
    assert ask(STOP, **proof) == 403
    assert platform.bus.sent == []


def test_a_server_can_be_asked_for_only_at_steps_that_have_one(platform: FakePlatform) -> None:
    for key in "23":
        platform.documents.put(f"maze/users/alice/answers/{key}.json", b"{}")
    assert ask(START, **PROOF) == 409
    bobs = {"hippodrome-step": "1", "hippodrome-ticket": ids.ticket(SECRET, "bob", "1")}
    assert ask(START, "projectId=maze&userId=bob", **bobs) == 409  # never opened the link
    assert platform.bus.sent == []


def test_a_running_server_is_stopped_at_once_or_after_a_delay(platform: FakePlatform) -> None:
    Servers(platform).start(StartServer("maze", "alice"))
    label = ids.server_label("maze", "alice")
    record = from_json(platform.documents.kept[server.key(label)][0], Server)
    token = SecretCache(platform.documents).token(record)
    assert ask(STOP, token=token) == 202
    assert platform.bus.sent == [(Topic.STOP, {"projectId": "maze", "userId": "alice", "attempt": 1})]
    assert ask(STOP, **PROOF, delay=90) == 202
    at, later = platform.timers.due[f"{label}-1-delay"]
    assert (at - platform.now()).total_seconds() == 90
    assert later["attempt"] == 1


# GET with a query, as HIPPO's scripts


def get(function: Any, platform: FakePlatform, query: str = "projectId=maze&userId=alice", **fields: str) -> Any:
    """Status and JSON of a GET with these fields in its query."""
    event = http_event("GET", "&".join([query, urlencode(fields)]), None, "/relay", {"accept": "*/*"})
    answer = function.handler(event, None)
    said = json.loads(answer["body"])
    assert said["page"] == said["message"]
    return answer["statusCode"], said["message"]


def test_a_get_starts_and_stops_a_server_as_with_hippo(platform: FakePlatform) -> None:
    assert get(START, platform, **PROOF) == (200, "Accepted.")
    Servers(platform).start(StartServer("maze", "alice"))
    assert get(STOP, platform, **PROOF) == (200, "Accepted.")
    assert get(STOP, platform, **PROOF, delay="90")[0] == 200
    assert [topic for topic, _ in platform.bus.sent] == [Topic.START, Topic.STOP]
    assert list(platform.timers.due) == [
        f"{ids.server_label('maze', 'alice')}-1",
        f"{ids.server_label('maze', 'alice')}-1-delay",
    ]


def test_a_stop_need_not_name_the_project_as_with_hippo(platform: FakePlatform) -> None:
    """The ticket determines the project."""
    Servers(platform).start(StartServer("maze", "alice"))
    assert get(STOP, platform, "userId=alice", **PROOF)[0] == 200
    assert ask(STOP, "userId=alice", **PROOF) == 202
    assert [message["projectId"] for _, message in platform.bus.sent] == ["maze", "maze"]


@pytest.mark.parametrize("query", ["userId=alice", "projectId=maze&userId=alice"])
def test_a_request_without_a_proof_is_refused_with_the_fields_to_send(platform: FakePlatform, query: str) -> None:
    Servers(platform).start(StartServer("maze", "alice"))
    for function in (START, STOP):
        status, text = get(function, platform, query)
        assert (status, "hippodrome-ticket" in text, "startServerStep" in text) == (403, True, True)
    assert platform.bus.sent == []


@pytest.mark.parametrize("fields", [
    {"hippodrome-step": "1", "hippodrome-ticket": ids.ticket(SECRET, "bob", "1")}, {"token": "guess"},
    {"hippodrome-step": "1", "hippodrome-ticket": ""}, {"hippodrome-step": "nope", "hippodrome-ticket": "0" * 32},
])  # fmt: skip
def test_a_false_proof_stops_nothing_in_any_project(platform: FakePlatform, fields: dict[str, str]) -> None:
    Servers(platform).start(StartServer("maze", "alice"))
    assert get(STOP, platform, "userId=alice", **fields)[0] == 403
    assert platform.bus.sent == []


def test_looking_for_the_project_of_a_ticket_reads_no_records(platform: FakePlatform) -> None:
    false = {"hippodrome-step": "1", "hippodrome-ticket": "0" * 32}
    get(STOP, platform, "userId=alice", **false)
    before = len(platform.documents.calls)
    get(STOP, platform, "userId=alice", **false)
    assert platform.documents.calls[before:] == []


@pytest.mark.parametrize(("query", "status"), [
    ("", 404), ("userId=a/b", 404), ("projectId=maze&userId=..%2Fbob", 400), ("projectId=maze&userId=a&userId=b", 400),
    ("projectId=maze&projectId=b&userId=alice", 404), ("projectId[]=maze&userId=alice", 403), ("userId=%ff", 400),
    ("&".join(f"a{n}=1" for n in range(100)), 400), ("projectId=nobody&userId=alice", 404),
])  # fmt: skip
def test_hostile_queries_are_refused(platform: FakePlatform, query: str, status: int) -> None:
    assert get(STOP, platform, query)[0] == status
    assert platform.bus.sent == []


@pytest.mark.parametrize("headers", [{"sec-purpose": "prefetch"}, {"user-agent": "Slackbot 1.0"}])
def test_the_preview_of_a_link_starts_nothing(platform: FakePlatform, headers: dict[str, str]) -> None:
    event = http_event("GET", f"projectId=maze&userId=alice&{urlencode(PROOF)}", None, "/start", headers)
    assert START.handler(event, None)["statusCode"] == 403
    assert platform.bus.sent == []


@pytest.mark.parametrize("method", ["PUT", "DELETE", "HEAD"])
def test_other_methods_are_refused(platform: FakePlatform, method: str) -> None:
    event = http_event(method, f"projectId=maze&userId=alice&{urlencode(PROOF)}")
    assert START.handler(event, None)["statusCode"] == 405
    assert platform.bus.sent == []


@pytest.mark.parametrize("delay", [-1, 86_401, "soon", None, True, [], 1e400, {}])
def test_an_invalid_delay_is_refused(platform: FakePlatform, delay: object) -> None:
    Servers(platform).start(StartServer("maze", "alice"))
    assert ask(STOP, **PROOF, delay=delay) == 400


def test_without_a_server_there_is_nothing_to_stop(platform: FakePlatform) -> None:
    assert ask(STOP, **PROOF) == 409


@pytest.mark.parametrize(("query", "status"), [
    ("projectId=nobody&userId=alice", 404), ("projectId=maze&userId=..", 400), ("", 404), ("projectId=maze", 400),
])  # fmt: skip
def test_broken_requests_are_refused_with_their_status(platform: FakePlatform, query: str, status: int) -> None:
    assert ask(START, query, **PROOF) == status
