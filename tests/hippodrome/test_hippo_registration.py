"""What HIPPO's updateProject.py sends to update_project_master_list, and what it reads of the answer."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from hippodrome.model.project import MASTER_LIST, read_list, step_key
from lambdas import installed as place
from lambdas import update_project_master_list
from testing.fake_platform import FakePlatform

PAYLOAD: dict[str, Any] = {
    "useAWS": True,
    "awsSetup": {"bucket": None, "region": None, "rootDomain": None, "cpu": 2, "memory": 10,
                 "containerName": "flight", "repository": "flight"},
    "events": {"startServerStep": 1, "stopServerStep": 12},
    "id": "flight", "live": True, "maxRuntime": 30, "name": "Flight", "researcher": "R",
    "ssl": {"fullchain": "SSL/fullchain.pem", "privkey": "SSL/privkey.pem", "sslBucket": None},
    "steps": {"1": "consent.html", "2": "game", "3": "thank.html", "finalStep": "thank.html"},
    "teamMembers": "T", "ecsTask": "flight", "bucket": None,
}  # fmt: skip


@pytest.fixture
def platform() -> Iterator[FakePlatform]:
    place.use(platform := FakePlatform())
    for file in ("consent", "thank"):
        platform.documents.put(step_key("flight", file), b"<p>")
    yield platform
    place.use(None)


def test_it_is_registered_with_remarks(platform: FakePlatform) -> None:
    answer = update_project_master_list.handler(PAYLOAD, None)
    assert answer["statusCode"] == 200, answer
    assert all(word in answer["body"] for word in ("ecsTask", "containerName", "stopServerStep", "trial"))
    (project,) = read_list(platform.documents.kept[MASTER_LIST][0]).projects
    assert [step.key for step in project.steps] == ["1", "2", "3"]
    assert (project.live, project.max_runtime, project.events.stop_server_step) == (True, 30, "3")


@pytest.mark.parametrize("change", [
    {"steps": {"1": "nowhere.html"}}, {"steps": {"1": ["a"]}}, {"steps": {"1": {"2": "a"}}}, {"steps": {}}, {"steps": 7},
    {"id": "../x"}, {"id": None}, {"id": {}}, {"steps": {"1": "x" * 300_000}}, {"events": []}, {"awsSetup": "a"},
])  # fmt: skip
def test_what_cannot_be_registered_is_a_sentence(platform: FakePlatform, change: dict[str, Any]) -> None:
    answer = update_project_master_list.handler({**PAYLOAD, **change}, None)
    assert answer["statusCode"] == 400
    assert 0 < len(answer["body"]) < 2_000
    assert MASTER_LIST not in platform.documents.kept


def test_the_game_of_an_earlier_registration_stays(platform: FakePlatform) -> None:
    ours = {k: v for k, v in PAYLOAD.items() if k in ("id", "live", "awsSetup", "useAWS")}
    ours["awsSetup"] = {"cpu": 1, "memory": 2}
    steps = [{"key": "1", "page": "consent"}, {"key": "2", "page": "game"}, {"key": "3", "page": "thank"}]
    event = {"project": {**ours, "steps": steps, "trial": {"game": "CartPole-v1"}, "taskDefinition": "t:1"}}
    assert update_project_master_list.handler(event, None) == {"registered": "flight", "live": True, "steps": 3}
    assert update_project_master_list.handler(PAYLOAD, None)["statusCode"] == 200
    (project,) = read_list(platform.documents.kept[MASTER_LIST][0]).projects
    assert (project.trial["game"], project.task_definition) == ("CartPole-v1", "t:1")
