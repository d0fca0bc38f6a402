"""A form that names no step and comes many times at once answers one step, with the documents of every backend."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import urlencode

import pytest

from hippodrome.control.http import Request
from hippodrome.control.model import ids
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import MASTER_LIST, Events, MasterList, step_key
from hippodrome.control.model.records import to_json
from hippodrome.control.participants.journey import Journey
from hippodrome.control.ports import Platform
from hippodrome.control.storage.secret import KEY
from testing.studies import INSTALLATION_SECRET, SECRET, study
from tests.contract.backends import concurrent

AT_ONCE = 20
STEPS = ["1", "2", "3", "4", "5"]
QUERY = (("projectId", "maze"), ("userId", "alice"))


@pytest.fixture
def journey(platform: Platform) -> Iterator[Journey]:
    """A study of pages only, which alice has opened."""
    project = study(steps=[Step(key, "survey") for key in STEPS], events=Events())
    platform.documents.create(KEY, to_json(INSTALLATION_SECRET))
    platform.documents.create(MASTER_LIST, to_json(MasterList([project])))
    platform.documents.create(step_key("maze", "survey"), b"<input name='words'>")
    journey = Journey(platform)
    assert journey.respond(Request("GET", "/next", QUERY, {"accept": "application/json"})).status == 200
    return journey


def post(journey: Journey, body: str, kind: str = "application/json") -> int:
    headers = {"accept": "application/json", "content-type": kind}
    return journey.respond(Request("POST", "/next", QUERY, headers, body.encode())).status


def answered(platform: Platform) -> list[str]:
    return [entry.key.rpartition("/")[2] for entry in platform.documents.list("maze/users/alice/answers/")]


def at_once(journey: Journey, bodies: list[tuple[str, str]]) -> None:
    ready = threading.Barrier(len(bodies))

    def send(body: str, kind: str) -> int:
        ready.wait()
        return post(journey, body, kind)

    with ThreadPoolExecutor(len(bodies)) as threads:
        assert {one.result() for one in [threads.submit(send, *each) for each in bodies]} == {200}


@concurrent
def test_of_many_equal_forms_at_once_one_is_stored(journey: Journey, platform: Platform) -> None:
    for number, step in enumerate(STEPS[:3]):
        at_once(journey, [(json.dumps({"words": str(number)}), "application/json")] * AT_ONCE)
        assert answered(platform) == [f"{key}.json" for key in STEPS[: int(step)]]


@concurrent
def test_a_form_with_a_ticket_and_programs_that_repeat_it_at_once_answer_one_step(
    journey: Journey, platform: Platform
) -> None:
    proof = {"hippodrome-step": "1", "hippodrome-ticket": ids.ticket(SECRET, "alice", "1")}
    form = (urlencode({"words": "fun", **proof}), "application/x-www-form-urlencoded")
    at_once(journey, [form, *[('{"words": "fun"}', "application/json")] * (AT_ONCE - 1)])
    assert answered(platform) == ["1.json"]


def test_a_form_that_is_sent_again_at_once_is_recognized(journey: Journey, platform: Platform) -> None:
    for body in ('{"words": "fun"}', '{"words": "fun"}', '{"words": "none"}', '{"words": "fun"}'):
        post(journey, body)
    assert answered(platform) == ["1.json", "2.json"]
