"""A master list that HIPPO's update_project_master_list wrote: read entry by entry, and kept as it is."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.model import hippo_entry
from hippodrome.control.model.project import MASTER_LIST, Events, MasterList, Project, read_list, step_key, write_list
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.secret import SecretCache
from hippodrome.functions import update_project_master_list
from testing.fake_platform import FakePlatform
from testing.studies import study
from testing.visitors import Browser
from tests.control.test_registry import registration

ENTRY: dict[str, Any] = {
    "id": "flight", "name": "Flight", "live": True, "researcher": None, "team_members": None, "ecsTask": "flight",
    "steps": {"1": "consent.html", "2": "game", "3": "thank.html", "4": None, "finalStep": "thank.html"},
    "events": {"startServerStep": 1, "stopServerStep": 3}, "maxRuntime": "30", "bucket": "a-lab",
}  # fmt: skip


def read(*entries: Any) -> MasterList:
    return read_list(json.dumps({"projects": entries}).encode())


def project(**changes: Any) -> Project:
    (found,) = read({**ENTRY, **changes}).projects
    return found


def test_an_entry_is_read_as_a_project() -> None:
    found = project()
    assert [(step.key, step.page) for step in found.steps] == [("1", "consent"), ("2", "game"), ("3", "thank")]
    assert (found.live, found.max_runtime, found.events, found.page_folder) == (True, 30, Events("1", "3"), "")


@pytest.mark.parametrize(
    ("given_events", "events"),
    [
        ({"startServerStep": None, "stopServerStep": ""}, ("2", "3")),
        ({"startServerStep": "1", "stopServerStep": "finalStep"}, ("1", "3")),
        ({"startServerStep": 3, "stopServerStep": 1}, ("2", "3")),
        ({"startServerStep": 2, "stopServerStep": 12}, ("2", "3")),
        (None, ("2", "3")),
    ],
)
def test_events_that_leave_the_game_without_a_server_are_replaced(given_events: Any, events: tuple[str, str]) -> None:
    assert project(events=given_events).events == Events(*events)


def test_steps_without_a_page_are_left_out_and_events_are_renumbered() -> None:
    steps = {"1": "a.html", "2": "", "3": "b.html", "4": "game", "5": "c.html", "finalStep": "d.html"}
    found = project(steps=steps, events={"startServerStep": 3, "stopServerStep": 5})
    assert [step.key for step in found.steps] == ["1", "2", "3", "4", "finalStep"]
    assert found.events == Events("2", "4")


@pytest.mark.parametrize("page", ["StepFiles/consent.html", "../../consent", "C:\\study\\consent.html"])
def test_a_page_is_a_file_in_the_folder_of_the_project(page: str) -> None:
    assert [step.page for step in project(steps={"1": page}).steps] == ["consent"]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"steps": {}}, "none of its steps has a page"),
        ({"steps": {"1": "a.html", "3": "b.html"}}, "it has no step 2, but later ones"),
        ({"steps": {"2": "b.html"}}, "it has no step 1, but later ones"),
        ({"steps": {"1": "a.html", "2": "game"}}, "last step is the game"),
        ({"steps": {"1": "a\n.html"}}, "page"),
        ({"steps": {"1": ["a"]}}, "page"),
        ({"maxRuntime": "soon"}, "maxRuntime"),
        ({"maxRuntime": {}}, "maxRuntime"),
        ({"id": None}, ""),
        ({"id": "../x"}, "id"),
    ],
)
def test_an_entry_that_is_no_study_is_kept_and_affects_no_other(changes: dict[str, Any], why: str) -> None:
    raw = {**ENTRY, **changes}
    listed = read(raw, {**ENTRY, "id": "other"})
    assert [found.id for found in listed.projects] == ["other"]
    (unread,) = listed.unreadable
    assert why in unread.why
    assert json.loads(write_list(listed))["projects"] == [{**ENTRY, "id": "other"}, raw]


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=4,
)
STEPS = st.dictionaries(
    st.sampled_from([*map(str, range(7)), "finalStep", "x"]), JSON | st.sampled_from(["game", "a.html"])
)


@given(st.fixed_dictionaries({"steps": STEPS}, optional={key: JSON for key in ENTRY if key != "steps"}))
def test_any_entry_is_kept_and_affects_no_other(entry: dict[str, Any]) -> None:
    listed = read(entry, {**ENTRY, "id": "other"})
    assert "other" in [found.id for found in listed.projects]
    again = json.loads(write_list(listed))["projects"]
    assert sorted(map(json.dumps, again)) == sorted(map(json.dumps, [entry, {**ENTRY, "id": "other"}]))


def test_of_two_entries_with_one_id_hippodromes_counts_and_both_are_kept() -> None:
    ours = json.loads(write_list(MasterList([study(id="flight")])))["projects"][0]
    listed = read(ENTRY, ours)
    assert [len(found.steps) for found in listed.projects] == [5]
    assert json.loads(write_list(listed))["projects"] == [ours, ENTRY]


@pytest.fixture
def platform(platform: FakePlatform) -> FakePlatform:
    listed = json.loads(platform.documents.kept[MASTER_LIST][0])
    listed["projects"].append(ENTRY)
    platform.documents.put(MASTER_LIST, json.dumps(listed).encode())
    SecretCache(platform.documents).get_or_create()
    for file in ("consent", "thank"):
        platform.documents.put(step_key("flight", file, ""), f"<p>page {file}".encode())
    return platform


def test_the_pages_of_an_entry_are_shown(platform: FakePlatform) -> None:
    answer = Browser(platform, "projectId=flight&userId=u1").send()
    assert answer["statusCode"] == 200
    assert "page consent" in answer["body"]


def test_registering_another_project_keeps_the_entry(platform: FakePlatform) -> None:
    for file in ("consent-0", "consent-1", "bye"):
        platform.documents.put(step_key("other", file), b"x")
    assert update_project_master_list.handler({"project": registration("other")}, None)["registered"] == "other"
    assert ENTRY in json.loads(platform.documents.kept[MASTER_LIST][0])["projects"]


def test_registering_the_project_replaces_the_entry_and_tickets_stay_valid(platform: FakePlatform) -> None:
    before = ProjectCache(platform, SecretCache(platform.documents)).project("flight")
    answer = update_project_master_list.handler({**ENTRY, "bucket": None}, None)
    assert answer["statusCode"] == 200, answer
    after = ProjectCache(platform, SecretCache(platform.documents)).project("flight")
    assert before
    assert after
    assert after.secret == before.secret
    assert after.salt == hippo_entry.SALT
    assert [one["id"] for one in json.loads(platform.documents.kept[MASTER_LIST][0])["projects"]] == ["flight", "maze"]
