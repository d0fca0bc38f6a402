"""An entry, a record or a page that cannot be read affects no other participant or project."""

from __future__ import annotations

import json
from typing import Any

import pytest

from hippodrome.control.model import ids, server
from hippodrome.control.model.messages import StartServer, StopServer
from hippodrome.control.model.participant import participant_key
from hippodrome.control.model.project import MASTER_LIST, MasterList, read_list, step_key, write_list
from hippodrome.control.model.records import to_json
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache
from hippodrome.functions import start_server, sweep, update_project_master_list
from testing.aws_events import queue_event
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import INSTALLATION_SECRET, study
from testing.visitors import Browser
from tests.control.test_registry import registration

BROKEN = {
    "steps as HIPPO writes them": {"id": "broken", "live": True, "steps": {"1": "consent.html"}},
    "no steps": {"id": "broken", "steps": []},
    "a number for the name": {"id": "broken", "steps": [{"key": "1", "page": "a"}], "name": 7},
    "an id that is none": {"id": "../broken", "steps": [{"key": "1", "page": "a"}]},
    "a list": [1, 2, 3],
    "nothing": None,
    "a text": "broken",
}


def page(platform: FakePlatform, user: str, project: str = "maze") -> tuple[int, str]:
    """Return the status and body of the answer to a participant's link."""
    answer = Browser(platform, f"projectId={project}&userId={user}").send()
    return answer["statusCode"], str(answer["body"])


def spoil(platform: FakePlatform, entry: Any) -> None:
    """Put an entry into the master list that cannot be read, beside the good one."""
    listed = json.loads(platform.documents.kept[MASTER_LIST][0])
    listed["projects"].insert(0, entry)
    platform.documents.put(MASTER_LIST, json.dumps(listed).encode())


def entries(platform: FakePlatform) -> list[Any]:
    found: list[Any] = json.loads(platform.documents.kept[MASTER_LIST][0])["projects"]
    return found


@pytest.mark.parametrize("entry", BROKEN.values(), ids=BROKEN)
def test_participants_of_other_projects_go_on(platform: FakePlatform, entry: Any) -> None:
    spoil(platform, entry)
    assert page(platform, "alice")[0] == 200
    Servers(platform).start(StartServer("maze", "alice"))
    assert len(platform.tasks.running) == 1
    assert sweep.handler({}, None)["failed"] == 0


def test_participants_of_an_unreadable_entry_see_that_the_study_is_out_of_order(platform: FakePlatform) -> None:
    spoil(platform, BROKEN["no steps"])
    status, text = page(platform, "alice", "broken")
    assert (status, "temporarily unavailable" in text) == (500, True)
    assert page(platform, "alice", "never-was")[0] == 404


@pytest.mark.parametrize("entry", BROKEN.values(), ids=BROKEN)
def test_registering_another_project_does_not_change_the_unreadable_entry(platform: FakePlatform, entry: Any) -> None:
    spoil(platform, entry)
    for file in ("consent-0", "consent-1", "bye"):
        platform.documents.put(step_key("other", file), b"x")
    answer = update_project_master_list.handler({"project": registration("other")}, None)
    assert answer["registered"] == "other"
    assert entry in entries(platform)
    assert [one["id"] for one in entries(platform) if one != entry] == ["maze", "other"]


def test_registering_the_project_itself_replaces_the_unreadable_entry_and_keeps_its_secret(
    platform: FakePlatform,
) -> None:
    """The secret, which is derived from the salt, signs the links and codes that participants have."""
    spoil(platform, {**BROKEN["no steps"], "salt": "kept"})
    for file in ("consent-0", "consent-1", "bye"):
        platform.documents.put(step_key("broken", file), b"x")
    assert update_project_master_list.handler({"project": registration("broken")}, None)["registered"] == "broken"
    assert [one["id"] for one in entries(platform)] == ["broken", "maze"]
    mended = ProjectCache(platform, SecretCache(platform.documents)).project("broken")
    assert mended
    assert mended.secret == INSTALLATION_SECRET.project_secret(study(id="broken", salt="kept"))
    assert not ProjectCache(platform).is_unreadable("broken")


@pytest.mark.parametrize("body", [b"", b"{", b"[]", b'{"projects": {}}', b"\xff", b'{"projects": ' + b"[" * 100_000])
def test_an_unreadable_list_is_not_overwritten(platform: FakePlatform, body: bytes) -> None:
    platform.documents.put(MASTER_LIST, body)
    for file in ("consent-0", "consent-1", "bye"):
        platform.documents.put(step_key("other", file), b"x")
    (problem,) = update_project_master_list.handler({"project": registration("other")}, None)["problems"]
    assert problem.startswith(f"{MASTER_LIST} cannot be read")
    assert platform.documents.kept[MASTER_LIST][0] == body


def test_a_readable_list_is_written_as_it_was_read() -> None:
    listed = MasterList([study(), study(id="other")])
    assert read_list(write_list(listed)) == listed
    assert write_list(listed) == to_json(listed)


def test_an_entry_that_is_not_utf_8_is_written_back_unchanged() -> None:
    listed = read_list(b'{"projects": [{"id": "broken", "name": "\xff"}]}')
    assert [(entry.id, entry.raw) for entry in listed.unreadable] == [(None, b'{"id": "broken", "name": "\xff"}')]
    assert b"\xff" in write_list(listed)


def test_an_unreadable_record_of_a_server_affects_only_its_participant(platform: FakePlatform) -> None:
    for user in ("alice", "bob"):
        Servers(platform).start(StartServer("maze", user))
    platform.documents.put(server.key(ids.server_label("maze", "alice")), b"{")
    event = queue_event([{"projectId": "maze", "userId": user} for user in ("alice", "carol")], ["a", "c"])
    assert start_server.handler(event, None) == {"batchItemFailures": [{"itemIdentifier": "a"}]}
    stops = [StopServer("maze", user) for user in ("alice", "bob", "carol")]
    assert Servers(platform).stop(stops) == stops[:1]
    assert [request.environment["USER_ID"] for request in platform.tasks.running.values()] == ["alice"]
    assert page(platform, "bob")[0] == 200


def test_a_participant_without_a_readable_record_still_sees_their_page(platform: FakePlatform) -> None:
    platform.documents.put(step_key("maze", "consent-0"), b"<p>{{ participant.from }}, {{ participant.userId }}</p>")
    platform.documents.put(step_key("maze", "consent-1"), b"<p>{{ participant.from }}, {{ participant.userId }}</p>")
    platform.documents.put(participant_key("maze", "alice"), b"[]")
    status, text = page(platform, "alice")
    assert (status, ", alice" in text) == (200, True)
    assert Repository(platform.documents).participant("maze", "alice") is None


def test_a_page_that_does_not_render_affects_no_other_project(platform: FakePlatform) -> None:
    platform.documents.put(step_key("maze", "consent-0"), b"{{ 1 / 0 }}")
    platform.documents.put(step_key("maze", "consent-1"), b"{{ 1 / 0 }}")
    other = study(id="other")
    platform.documents.put(MASTER_LIST, to_json(MasterList([study(), other])))
    for file in ("consent-0", "consent-1"):
        platform.documents.put(step_key("other", file), b"<p>Welcome</p>")
    assert page(platform, "alice")[0] == 500
    assert page(platform, "alice", "other")[0] == 200


@pytest.mark.parametrize("document", ["_slots/maze.json", "_warm/maze.json", "maze/slots/0.json"])
def test_unreadable_slots_of_one_project_do_not_affect_another(platform: FakePlatform, document: str) -> None:
    limited = study(max_servers=2, max_participants=16, warm_servers=1)
    other = study(id="other", max_servers=2)
    platform.documents.put(MASTER_LIST, to_json(MasterList([limited, other])))
    platform.documents.put(document, b"{")
    Servers(platform).start(StartServer("other", "bob"))
    assert [request.environment["USER_ID"] for request in platform.tasks.running.values()] == ["bob"]
    platform.wait(minutes=5)
    swept = sweep.handler({}, None)
    assert (swept["asked"], swept["failed"] <= 1) == (1, True)


def test_without_a_readable_list_of_projects_the_sweep_still_stops_overdue_servers(platform: FakePlatform) -> None:
    Servers(platform).start(StartServer("maze", "alice"))
    Servers(platform).stop([StopServer("maze", "alice")])
    platform.timers.set(ids.server_name(ids.server_label("maze", "alice"), 1), platform.now(), {})
    Servers(platform).start(StartServer("maze", "bob"))
    platform.documents.put(MASTER_LIST, b"{")
    platform.wait(minutes=36)
    swept = sweep.handler({}, None)
    assert (swept["timers"], swept["overdue"], swept["failed"]) == (1, 1, 2)
