"""Files beside the step pages, and the few addresses and methods that `next_step` knows besides."""

from __future__ import annotations

import base64
import json
import unicodedata
from typing import Any

import msgspec
import pytest

from hippodrome.control.model.project import MASTER_LIST, Events, MasterList
from hippodrome.control.model.records import to_json
from hippodrome.control.participants.files import MAX_BYTES
from hippodrome.control.participants.links import OUR_FIELDS, RECRUITER_IDS
from hippodrome.functions import next_step
from testing.aws_events import http_event
from testing.fake_platform import FakePlatform
from testing.studies import installed, study
from testing.visitors import Browser
from tests.control.participants.test_journey import stored, to_game

KINDS = {
    "png": "image/png",
    "jpg": "image/jpeg",
    "jpeg": "image/jpeg",
    "gif": "image/gif",
    "webp": "image/webp",
    "svg": "image/svg+xml",
    "mp4": "video/mp4",
    "webm": "video/webm",
    "mp3": "audio/mpeg",
    "ogg": "audio/ogg",
    "wav": "audio/wav",
    "css": "text/css",
    "js": "text/javascript",
    "vtt": "text/vtt",
    "woff2": "font/woff2",
    "txt": "text/plain; charset=utf-8",
    "ics": "text/calendar; charset=utf-8",
    "odt": "application/vnd.oasis.opendocument.text",
    "docx": "application/vnd.openxmlformats-officedocument.wordprocessingml.document",
}


def ask(path: str, method: str = "GET") -> dict[str, Any]:
    return next_step.handler(http_event(method, path=path), None)


def keep(platform: FakePlatform, *names: str) -> None:
    for name in names:
        platform.documents.put(f"maze/steps/{name}", b"x")


@pytest.mark.parametrize("ending", KINDS)
def test_each_kind_of_file_is_served_with_its_content_type_in_a_sandbox(platform: FakePlatform, ending: str) -> None:
    keep(platform, f"a.b.{ending}", f"A.{ending.upper()}")
    for name in (f"a.b.{ending}", f"A.{ending.upper()}"):
        headers = ask(f"/steps/maze/{name}")["headers"]
        assert headers["Content-Type"] == KINDS[ending]
        assert headers["Cache-Control"] == "public, max-age=300"
        assert headers["Content-Security-Policy"] == "default-src 'none'; style-src 'unsafe-inline'; sandbox"


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_a_files_name_may_come_in_either_form(platform: FakePlatform, form: Any) -> None:
    keep(platform, "Übung.png")
    assert ask(f"/steps/maze/{unicodedata.normalize(form, 'Übung.png')}")["statusCode"] == 200


def test_a_pdf_is_served_to_be_shown_and_cannot_be_read_as_a_page(platform: FakePlatform) -> None:
    """Browsers show no PDF in a sandbox. `nosniff` keeps what is no PDF from being run as HTML."""
    keep(platform, "sheet.pdf")
    response = ask("/steps/maze/sheet.pdf")
    headers = response["headers"]
    assert (headers["Content-Type"], headers["X-Content-Type-Options"]) == ("application/pdf", "nosniff")
    assert not headers.keys() & {"Content-Security-Policy", "Content-Disposition"}
    assert response["isBase64Encoded"]
    assert base64.b64decode(response["body"]) == b"x"


@pytest.mark.parametrize(("ending", "saved"), [("ics", 1), ("odt", 1), ("docx", 1), ("txt", 0), ("svg", 0)])
def test_a_file_that_browsers_cannot_show_is_saved(platform: FakePlatform, ending: str, saved: int) -> None:
    keep(platform, f"a.{ending}")
    assert ask(f"/steps/maze/a.{ending}")["headers"].get("Content-Disposition") == ("attachment" if saved else None)


@pytest.mark.parametrize(
    ("asked", "status", "body", "content_range"),
    [
        ("bytes=0-1", 206, b"01", "bytes 0-1/10"),  # Safari's first request for a film
        ("bytes=0-", 206, b"0123456789", "bytes 0-9/10"),
        ("bytes=8-99", 206, b"89", "bytes 8-9/10"),
        ("bytes=-3", 206, b"789", "bytes 7-9/10"),
        ("bytes=10-", 416, b"", "bytes */10"),
        ("bytes=0-1,4-5", 200, b"0123456789", None),
        ("bytes=-", 200, b"0123456789", None),
        ("steps=1-2", 200, b"0123456789", None),
    ],
)
def test_a_part_of_a_file_is_served_without_which_safari_plays_no_film(
    platform: FakePlatform, asked: str, status: int, body: bytes, content_range: str | None
) -> None:
    platform.documents.put("maze/steps/film.mp4", b"0123456789")
    response = next_step.handler(http_event("GET", path="/steps/maze/film.mp4", headers={"Range": asked}), None)
    sent = base64.b64decode(response["body"]) if response["isBase64Encoded"] else response["body"].encode()
    assert (response["statusCode"], sent) == (status, body)
    assert response["headers"].get("Content-Range") == content_range
    assert ask("/steps/maze/film.mp4")["headers"]["Accept-Ranges"] == "bytes"


def test_the_largest_file_fits_into_a_functions_answer(platform: FakePlatform) -> None:
    platform.documents.put("maze/steps/sheet.pdf", b"x" * MAX_BYTES)
    assert len(json.dumps(ask("/steps/maze/sheet.pdf"))) < 6 * 1024 * 1024  # Lambda's quota


@pytest.mark.parametrize("name", [".png", ".hidden.png", "a\u200b.png", "x" * 197 + ".png", "a.html"])
def test_a_file_that_is_hidden_unprintable_too_long_or_of_another_kind_is_not_found(
    platform: FakePlatform, name: str
) -> None:
    keep(platform, name)
    assert ask(f"/steps/maze/{name}")["statusCode"] == 404


def test_a_name_may_have_200_characters(platform: FakePlatform) -> None:
    name = "x" * 196 + ".png"
    keep(platform, name)
    assert ask(f"/steps/maze/{name}")["statusCode"] == 200


@pytest.mark.parametrize("path", ["/steps/maze/a/b.png", "/steps/a b/b.png", "/steps/b.png", "/steps/"])
def test_only_files_of_a_live_study_are_served(platform: FakePlatform, path: str) -> None:
    keep(platform, "b.png", "a/b.png")
    assert ask(path)["statusCode"] == 404


def test_other_methods_are_refused_and_options_allows_all_origins(platform: FakePlatform) -> None:
    assert ask("/next", "DELETE")["statusCode"] == 405
    answer = ask("/next", "OPTIONS")
    assert (answer["statusCode"], answer["headers"]["Access-Control-Allow-Origin"]) == (204, "*")


@pytest.mark.parametrize(
    ("query", "status"), [("", 200), ("a=1", 404), ("projectId=none", 404), ("projectId=a%20b", 404)]
)
def test_a_link_without_a_study_gets_an_error(platform: FakePlatform, query: str, status: int) -> None:
    assert Browser(platform, query).send()["statusCode"] == status


def test_fields_of_the_recruiters_link_are_stored_within_limits(platform: FakePlatform) -> None:
    long = f"{'n' * 64}={'v' * 300}&{'m' * 65}=x"
    Browser(platform, f"projectId=maze&userId=alice&poll=1&SESSION=7&{long}").send()
    link = "projectId=maze&userId=alice&SESSION=7"
    Browser(platform, f"{link}&{long}").get()
    assert stored(platform, "participant.json")["link"] == {"SESSION": "7", "n" * 64: "v" * 256}
    assert sorted(OUR_FIELDS) == ["poll", "projectId", "signature", "userId"]
    assert RECRUITER_IDS == ("PROLIFIC_PID", "workerId", "survey_code", "participantId")


SENT = {
    "User-Agent": "Mozilla/5.0 " + "x" * 600,
    "Accept-Language": "de",
    "X-Forwarded-For": "203.0.113.7",
    "Cookie": "a",
}


@pytest.mark.parametrize(
    ("record_headers", "kept"),
    [
        ([], {}),
        (["user-agent", "accept-language", "dnt"], {"user-agent": "Mozilla/5.0 " + "x" * 500, "accept-language": "de"}),
        (["x-forwarded-for"], {"x-forwarded-for": "203.0.113.7"}),
    ],
)
def test_only_the_headers_that_the_study_names_are_kept_and_none_is_logged(
    platform: FakePlatform, caplog: pytest.LogCaptureFixture, record_headers: list[str], kept: dict[str, str]
) -> None:
    project = msgspec.structs.replace(study(), record_headers=record_headers)
    platform.documents.put(MASTER_LIST, to_json(MasterList([project])))
    next_step.handler(http_event("GET", "projectId=maze&userId=alice", headers=SENT), None)
    assert stored(platform, "participant.json").get("headers", {}) == kept
    assert not any(
        value in str(record.__dict__) for record in caplog.records for value in SENT.values() if len(value) > 2
    )


def test_the_answer_to_a_poll_names_the_step_that_was_asked_for(platform: FakePlatform) -> None:
    alice = Browser(platform)
    to_game(alice)
    for step, told in (("3", "3"), ("4", "4"), ("none", "3")):
        body = Browser(platform, f"{alice.query}&poll={step}").send()["body"]
        assert json.loads(body)["step"] == told


def test_a_start_message_without_effect_is_repeated_after_half_a_minute(platform: FakePlatform) -> None:
    alice = Browser(platform)
    to_game(alice)
    for seconds, repeated in ((30, 0), (1, 1)):
        platform.bus.sent.clear()
        platform.wait(seconds=seconds)
        alice.get()
        assert len(platform.bus.sent) == repeated


def test_a_game_at_the_first_step_sends_a_start_message_with_each_load() -> None:
    steps = study().steps
    platform = installed(study(steps=[steps[2], steps[4]], events=Events("3", "finalStep")))
    alice = Browser(platform)
    for loads in (1, 2, 3):
        alice.get()
        assert len(platform.bus.sent) == loads


def test_a_page_that_is_missing_or_broken_says_so(platform: FakePlatform) -> None:
    alice = Browser(platform)
    for file in ("consent-0", "consent-1"):
        platform.documents.put(f"maze/steps/{file}.html", b"{{ 1 / 0 }}")
    assert (alice.send()["statusCode"], "This page cannot be shown" in alice.send()["body"]) == (500, True)
    bob = Browser(installed_without_pages(), "projectId=maze&userId=bob")
    assert (bob.send()["statusCode"], "This page is missing" in bob.send()["body"]) == (500, True)


def installed_without_pages() -> FakePlatform:
    platform = installed()
    for key in [key for key in platform.documents.kept if "/steps/" in key]:
        del platform.documents.kept[key]
    return platform


def test_a_page_that_goes_through_all_answers_gets_them_all(platform: FakePlatform) -> None:
    platform.documents.put("maze/steps/questionnaire.html", b"{% for step in answers %}[{{ step }}]{% endfor %}")
    alice = Browser(platform)
    alice.answer(alice.get(), consent="yes")
    assert "[1]" in alice.get()
