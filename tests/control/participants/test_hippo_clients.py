"""Programs that ask for JSON, such as HIPPO's front end: its statuses, its texts, and always a page."""

from __future__ import annotations

import json
from typing import Any

import pytest

from hippodrome.control.model.project import step_key
from hippodrome.functions import installed as place
from hippodrome.functions import next_step
from testing.aws_events import JSON, http_event
from testing.fake_platform import FakePlatform
from testing.studies import installed, study
from testing.visitors import hidden

AXIOS = "application/json, text/plain, */*"  # the Accept header of axios (1.x, and 0.x as HIPPO has it)
ALICE = "projectId=maze&userId=alice"


def ask(platform: FakePlatform, query: str = ALICE, form: Any = None, **headers: str) -> tuple[int, dict[str, Any]]:
    """Status and JSON of the answer; with a form, of a POST."""
    place.use(platform)
    named = {"accept": AXIOS, "content-type": JSON, "origin": "https://hippogym.irll.net", **headers}
    body = None if form is None else json.dumps(form)
    answer = next_step.handler(http_event("GET" if form is None else "POST", query, body, headers=named), None)
    assert answer["headers"]["Access-Control-Allow-Origin"] == "*"
    return answer["statusCode"], json.loads(answer["body"])


@pytest.mark.parametrize("query", [
    "", "userId=alice", "projectId=&userId=alice", "projectId=nobody&userId=alice", "projectId=../maze&userId=alice",
    "projectId=maze&projectId=other&userId=alice", "projectId=nobody",
])  # fmt: skip
@pytest.mark.parametrize("form", [None, {"age": "3"}])
def test_an_unknown_project_is_not_found(platform: FakePlatform, query: str, form: Any) -> None:
    """HIPPO's front end shows its error page for status 400, and waits forever after 404."""
    before = dict(platform.documents.kept)
    status, answer = ask(platform, query, form)
    assert (status, answer["page"]) == (400, "Project ID Not Found")
    assert platform.documents.kept == before


def test_a_closed_project_is_not_found() -> None:
    status, answer = ask(installed(study(live=False)))
    assert (status, answer["page"]) == (400, "Project ID Not Found")


def test_a_browser_gets_the_statuses_of_the_web() -> None:
    place.use(platform := installed(study(live=False)))
    event = http_event("GET", ALICE, headers={"accept": "text/html"})
    assert next_step.handler(event, None)["statusCode"] == 404
    place.use(installed())
    assert next_step.handler(http_event("GET", "", headers={"accept": "text/html"}), None)["statusCode"] == 200
    assert platform.documents.calls


def test_a_full_study_is_a_page() -> None:
    platform = installed(study(max_participants=1))
    assert "step" in ask(platform)[1]
    status, answer = ask(platform, "projectId=maze&userId=bob")
    assert status == 200
    assert "This study is full" in answer["page"]


def test_the_button_under_a_message_answers_no_step_of_the_study() -> None:
    """HIPPO's front end puts a button under every page; the fields that it sends with this one name no step."""
    platform = installed(study(max_participants=1))
    bob = "projectId=maze&userId=bob"
    ask(platform)
    page = ask(platform, bob)[1]["page"]
    del platform.documents.kept["maze/slots/0.json"]
    assert ask(platform, bob)[1]["step"] == "1"
    assert ask(platform, bob, hidden(page))[1]["step"] == "1"
    assert "maze/users/bob/answers/1.json" not in platform.documents.kept


def test_a_page_that_was_not_uploaded_is_content_not_found(platform: FakePlatform) -> None:
    """HIPPO answers 200 then."""
    for n in (0, 1):
        del platform.documents.kept[step_key("maze", f"consent-{n}")]
    status, answer = ask(platform)
    assert (status, answer["page"]) == (200, "Content Not Found")
    assert "not uploaded" in answer["message"]


def test_a_study_by_invitation_is_refused_with_a_page() -> None:
    platform = installed(study(signed_links=True))
    for query in (ALICE, f"{ALICE}&signature={'0' * 32}"):
        status, answer = ask(platform, query)
        assert status == 400
        assert "<p>" in answer["page"]


@pytest.mark.parametrize(("query", "form", "status"), [
    ("projectId=maze&userId=a/b", None, 400), ("projectId=maze&userId=%ff", None, 400), ("projectId=maze", {}, 400),
    (ALICE, [1], 400), (ALICE, {"a": "x" * 300_000}, 200),
])  # fmt: skip
def test_every_refusal_has_a_page(platform: FakePlatform, query: str, form: Any, status: int) -> None:
    found, answer = ask(platform, query, form)
    assert found == status
    assert answer["message"]
    assert "</p>" in answer["page"]


@pytest.mark.parametrize(("method", "content_type", "body", "status"), [
    ("POST", JSON, json.dumps({"a": "x" * 300_000}), 413), ("POST", "text/plain", "a=1", 415), ("DELETE", JSON, "", 405),
])  # fmt: skip
def test_a_front_end_gets_a_status_with_which_it_shows_the_message(
    platform: FakePlatform, method: str, content_type: str, body: str, status: int
) -> None:
    """It acts on statuses 200 and 400 only. Its button then gets the page that is due; other programs get the real status."""
    step = ask(platform)[1]["step"]
    for origin, expected in ({"origin": "https://hippogym.irll.net"}, 200), ({}, status):
        event = http_event(method, ALICE, body, headers={"accept": AXIOS, "content-type": content_type, **origin})
        answer = next_step.handler(event, None)
        assert answer["statusCode"] == expected
        assert "go back" not in answer["body"]
        assert ask(platform, ALICE, hidden(json.loads(answer["body"])["page"]))[1]["step"] == step


def test_without_an_id_a_program_gets_hippos_answer_and_a_browser_gets_an_id(platform: FakePlatform) -> None:
    status, answer = ask(platform, "projectId=maze")
    assert (status, answer["page"]) == (400, "Project ID Not Found")
    assert "userId" in answer["message"]
    browser = next_step.handler(http_event("GET", "projectId=maze", headers={"accept": "text/html"}), None)
    assert browser["statusCode"] == 302


def test_a_preview_and_an_internal_failure_have_a_page(platform: FakePlatform) -> None:
    status, answer = ask(platform, ALICE + "&assignmentId=ASSIGNMENT_ID_NOT_AVAILABLE")
    assert (status, "preview" in answer["page"]) == (200, True)
    working = platform.documents.get
    for origin, expected in ({"origin": "https://hippogym.irll.net"}, 200), ({}, 500):
        platform.documents.get = None  # type: ignore[method-assign,assignment]
        place.use(platform)
        found = next_step.handler(http_event("GET", ALICE, headers={"accept": AXIOS, **origin}), None)
        page = json.loads(found["body"])["page"]
        assert (found["statusCode"], "try again" in page) == (expected, True)
        platform.documents.get = working  # type: ignore[method-assign]
        assert ask(platform, ALICE, hidden(page))[1]["step"] == "1"
    assert "maze/users/alice/answers/1.json" not in platform.documents.kept


def test_names_in_a_message_are_escaped(platform: FakePlatform) -> None:
    place.use(platform := installed(study(name="<script>alert(1)</script>")))
    _, answer = ask(platform, ALICE + "&assignmentId=ASSIGNMENT_ID_NOT_AVAILABLE")
    assert "<script>" not in answer["page"]
    assert "&lt;script&gt;" in answer["page"]
