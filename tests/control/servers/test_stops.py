"""A stop message that names a participant and no project, as HIPPO sends it: it stops their servers of all projects."""

from __future__ import annotations

import msgspec
import pytest

from hippodrome.control.model import ids, messages, server
from hippodrome.control.model.messages import StartServer, StopServer, StopUser
from hippodrome.control.model.project import MASTER_LIST, MasterList, write_list
from hippodrome.control.model.records import to_json
from hippodrome.control.servers import stops as stops_module
from hippodrome.control.servers.services import ServerServices
from hippodrome.control.servers.termination import STOP_TRIES
from hippodrome.functions import stop_server
from testing.aws_events import queue_event
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import study

PROJECTS = ("atari", "gone", "maze")
ALICE = server.key(ids.server_label("maze", "alice"))


@pytest.fixture
def platform(platform: FakePlatform) -> FakePlatform:
    list_projects(platform, *PROJECTS)
    return platform


def list_projects(platform: FakePlatform, *names: str) -> None:
    platform.documents.put(MASTER_LIST, write_list(MasterList([study(id=name) for name in names])))


def started(platform: FakePlatform, *pairs: tuple[str, str]) -> Servers:
    servers = Servers(platform)
    for project, user in pairs:
        servers.start(StartServer(project, user))
    return servers


def running(platform: FakePlatform) -> set[str]:
    return {request.name for request in platform.tasks.running.values()}


def name(project: str, user: str) -> str:
    return ids.server_name(ids.server_label(project, user), 1)


def test_a_stop_without_a_project_stops_the_participants_servers_of_all_projects_and_no_others(
    platform: FakePlatform,
) -> None:
    servers = started(platform, ("maze", "alice"), ("atari", "alice"), ("maze", "bob"))
    assert servers.stop([StopUser("alice")]) == []
    assert running(platform) == {name("maze", "bob")}
    assert list(platform.timers.due) == [name("maze", "bob")]


def test_a_stop_without_a_project_stops_servers_of_closed_and_unreadable_projects(platform: FakePlatform) -> None:
    servers = started(platform, ("maze", "alice"), ("gone", "alice"))
    body = write_list(MasterList([study(live=False)]))
    platform.documents.put(MASTER_LIST, body.replace(b'"projects": [', b'"projects": [{"id": "gone", "steps": []},'))
    assert Servers(platform).stop([StopUser("alice")]) == []
    assert running(platform) == set()
    assert servers


def test_a_stop_without_a_project_writes_nothing_where_the_participant_has_no_server(platform: FakePlatform) -> None:
    """A message that names its project leaves a record, since the start message may be late; this one does not."""
    before = dict(platform.documents.kept)
    assert Servers(platform).stop([StopUser("alice")]) == []
    assert platform.documents.kept == before


def test_a_stop_without_a_project_reads_the_list_and_one_record_per_project(platform: FakePlatform) -> None:
    before = len(platform.documents.calls)
    Servers(platform).stop([StopUser("alice")])
    assert platform.documents.calls[before:] == ["get"] * (1 + len(PROJECTS))


def test_a_stop_of_a_single_server_reads_no_list(platform: FakePlatform) -> None:
    servers = started(platform, ("maze", "alice"))
    asked: list[str] = []
    get = platform.documents.get
    platform.documents.get = lambda key, known=None: asked.append(key) or get(key, known)  # type: ignore[method-assign,func-returns-value]
    servers.stop([StopServer("maze", "alice")])
    assert asked == [server.key(ids.server_label("maze", "alice"))]


def test_a_closed_server_is_not_changed(platform: FakePlatform) -> None:
    servers = started(platform, ("maze", "alice"))
    servers.stop([StopServer("maze", "alice")])
    before = dict(platform.documents.kept)
    assert servers.stop([StopUser("alice")]) == []
    assert platform.documents.kept == before


def test_a_message_whose_server_could_not_be_stopped_comes_again(platform: FakePlatform) -> None:
    servers = started(platform, ("maze", "alice"), ("atari", "bob"))
    platform.tasks.fail_stops = [ConnectionError()]
    again = servers.stop([StopUser("alice"), StopUser("bob")])
    assert again == [StopUser("alice")]
    assert servers.stop(again) == []
    assert running(platform) == set()


def changes_before(platform: FakePlatform, times: int) -> None:
    """Another function writes alice's record just before each of the next writes."""

    def change() -> None:
        body = platform.documents.kept[ALICE][0]
        platform.documents.keep(ALICE, body)

    platform.documents.before_write.extend([change] * times)


def state(platform: FakePlatform) -> str:
    found = ServerServices(platform).repository.server_of("maze", "alice")
    assert found
    return str(found.state)


def test_a_record_that_changes_while_its_server_is_stopped_is_closed_at_once(platform: FakePlatform) -> None:
    """Otherwise the queue would deliver the message again after 90 seconds, for which the participant would wait."""
    servers = started(platform, ("maze", "alice"))
    changes_before(platform, 1)
    assert servers.stop([StopServer("maze", "alice")]) == []
    assert state(platform) == "closed"
    assert running(platform) == set()


def test_a_task_that_starts_while_its_server_is_stopped_is_also_stopped(platform: FakePlatform) -> None:
    servers = started(platform, ("maze", "alice"))
    late = "late"
    (task,) = platform.tasks.running
    request = platform.tasks.running[task]

    def starts() -> None:
        platform.tasks.running[late] = request
        stored = ServerServices(platform).repository.server(ids.server_label("maze", "alice"))
        assert stored
        platform.documents.keep(ALICE, to_json(msgspec.structs.replace(stored.server, task=late)))

    platform.documents.before_write.append(starts)
    assert servers.stop([StopServer("maze", "alice")]) == []
    assert (state(platform), running(platform)) == ("closed", set())


def test_a_message_whose_record_keeps_changing_comes_again(platform: FakePlatform) -> None:
    servers = started(platform, ("maze", "alice"))
    changes_before(platform, STOP_TRIES)
    assert servers.stop([StopServer("maze", "alice")]) == [StopServer("maze", "alice")]
    assert state(platform) != "closed"


def test_the_next_attempts_server_is_not_stopped_by_a_stop_that_came_before_it(platform: FakePlatform) -> None:
    servers = started(platform, ("maze", "alice"))

    def next_attempt() -> None:
        Servers(platform).stop([StopServer("maze", "alice")])
        Servers(platform).start(StartServer("maze", "alice", 2))

    platform.documents.before_write.append(next_attempt)
    assert servers.stop([StopServer("maze", "alice")]) == []
    assert running(platform) == {ids.server_name(ids.server_label("maze", "alice"), 2)}


def test_an_unreadable_list_does_not_affect_stops_of_single_servers(platform: FakePlatform) -> None:
    started(platform, ("maze", "alice"))
    platform.documents.put(MASTER_LIST, b"{")
    stops = [StopUser("alice"), StopServer("maze", "alice")]
    assert Servers(platform).stop(stops) == [StopUser("alice")]
    assert running(platform) == set()


def test_a_call_reads_a_bounded_number_of_records(platform: FakePlatform, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stops_module, "MAX_READS", 7)
    batch = [StopUser(f"user{n}") for n in range(5)]
    assert Servers(platform).stop(batch) == batch[2:]
    monkeypatch.setattr(stops_module, "MAX_READS", 1)
    assert Servers(platform).stop(batch) == batch[1:], "at least one is handled"


@pytest.mark.parametrize("body", [{"userId": "alice"}, {"projectId": None, "userId": "alice"}])
def test_a_message_without_a_project_is_read(body: dict[str, object]) -> None:
    assert messages.parse_stop_server(body) == StopUser("alice")


@pytest.mark.parametrize("body", [
    {"userId": "a/b"}, {"userId": "../maze"}, {"userId": ""}, {"userId": None}, {"userId": ["alice"]}, {"userId": {}},
    {"userId": "~" + "0" * 20}, {"projectId": "", "userId": "alice"}, {"projectId": [], "userId": "alice"},
    {"projectId": "../x", "userId": "alice"}, {}, {"projectId": None}, {"userId": "a" * 65}, {"userId": "*"},
])  # fmt: skip
def test_other_messages_stop_nothing(platform: FakePlatform, body: dict[str, object]) -> None:
    started(platform, ("maze", "alice"))
    assert messages.parse_stop_server(body) is None
    assert stop_server.handler(queue_event([body]), None) == {"batchItemFailures": []}
    assert len(platform.tasks.running) == 1
