"""The sweep removes resources that no open record owns, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from msgspec.structs import replace

from hippodrome.control.model import ids, messages, server
from hippodrome.control.model.messages import StartServer, StopServer, TaskChanged
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.ports import DnsRecord, TaskRequest, Topic
from hippodrome.control.servers.overdue import RULES
from hippodrome.control.storage.repository import Repository
from hippodrome.functions import installed as place
from hippodrome.functions import sweep
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import installed, study

LABEL = ids.server_label("maze", "alice")
NAME = ids.server_name(LABEL, 1)


def ready(platform: FakePlatform, user: str = "alice") -> None:
    servers = Servers(platform)
    servers.start(StartServer("maze", user))
    task, request = next((t, r) for t, r in platform.tasks.running.items() if r.environment["USER_ID"] == user)
    servers.tasks_changed([TaskChanged(task, "hippodrome", request.name, "RUNNING", "eni-1", None, "", None)])


def leftovers(platform: FakePlatform) -> None:
    """A closed server all of whose resources are still there."""
    ready(platform)
    request = next(iter(platform.tasks.running.values()))
    name = DnsRecord(f"{NAME}.example.org", "203.0.113.1")
    Servers(platform).stop([StopServer("maze", "alice")])
    platform.tasks.by_name.clear()
    platform.tasks.run(request)
    platform.dns.change(add=[name])
    platform.timers.set(NAME, platform.now(), {})
    platform.timers.set(f"{NAME}-delay", platform.now(), {})
    platform.tasks.create_cluster(NAME)


def test_leftovers_of_a_closed_server_are_removed(platform: FakePlatform) -> None:
    leftovers(platform)
    swept = sweep.handler({}, None)
    assert (swept["tasks"], swept["names"], swept["timers"], swept["failed"]) == (1, 1, 2, 0)
    assert not platform.tasks.running
    assert not platform.dns.records
    assert not platform.timers.due
    assert not platform.tasks.own_clusters


def test_resources_of_a_server_that_is_closed_during_the_sweep_are_left_to_the_function_that_closed_it(
    platform: FakePlatform,
) -> None:
    leftovers(platform)
    listed = platform.timers.list

    def meanwhile() -> Iterator[str]:
        platform.wait(seconds=20)
        stored = Repository(platform.documents).server(LABEL)
        assert stored
        platform.documents.put(server.key(LABEL), to_json(replace(stored.server, closed=platform.now())))
        return listed()

    platform.timers.list = meanwhile  # type: ignore[method-assign]
    swept = sweep.handler({}, None)
    assert (swept["tasks"], swept["names"], swept["timers"], swept["clusters"]) == (0, 0, 0, 0)
    platform.timers.list = listed  # type: ignore[method-assign]
    swept = sweep.handler({}, None)
    assert (swept["tasks"], swept["names"], swept["timers"], swept["clusters"]) == (1, 1, 2, 1), "the next sweep knows"


def test_if_a_listing_fails_the_sweep_changes_nothing(platform: FakePlatform) -> None:
    """Without the list of tasks, every server would count as lost."""
    leftovers(platform)
    ready(platform, "bob")
    platform.wait(minutes=11)
    platform.tasks.list = None  # type: ignore[assignment,method-assign]
    with pytest.raises(TypeError):
        sweep.handler({}, None)
    assert len(platform.dns.records) == 2
    assert not Repository(platform.documents).server(ids.server_label("maze", "bob")).server.is_closed  # type: ignore[union-attr]


def test_resources_of_open_servers_are_not_touched(platform: FakePlatform) -> None:
    for user in ("alice", "bob"):
        ready(platform, user)
    platform.wait(minutes=18)
    Servers(platform).start(StartServer("maze", "carol"))
    before = (dict(platform.tasks.running), dict(platform.dns.records), dict(platform.timers.due))
    platform.wait(minutes=2)
    swept = sweep.handler({}, None)
    assert sum(swept.values()) == 0
    assert (platform.tasks.running, platform.dns.records, platform.timers.due) == before


def test_resources_of_others_are_not_touched(platform: FakePlatform) -> None:
    other = ids.server_name(ids.server_label("maze", "somebody-elses"), 1)
    platform.tasks.run(TaskRequest(other, "d", "hippodrome", 1, 2, {}))
    platform.dns.change(add=[DnsRecord(f"{other}.example.org", "192.0.2.1"), DnsRecord("www.example.org", "1.1.1.1")])
    platform.timers.set("backup-nightly", platform.now(), {})
    platform.tasks.create_cluster("production")
    assert sum(sweep.handler({}, None).values()) == 0
    assert len(platform.dns.records) == 2
    assert len(platform.tasks.running) == 1


def test_a_server_whose_end_was_not_reported_is_cleaned_up_and_replaced(platform: FakePlatform) -> None:
    ready(platform)
    platform.tasks.running.clear()
    assert sweep.handler({}, None)["lost"] == 0  # it may be starting
    platform.wait(minutes=11)
    assert sweep.handler({}, None)["lost"] == 1
    assert not platform.dns.records
    assert platform.bus.sent[-1][1]["attempt"] == 2


@pytest.mark.parametrize("port", ["documents.replace", "bus.publish", "timers.cancel"])
def test_the_next_sweep_finishes_what_a_failed_one_has_begun(
    platform: FakePlatform, monkeypatch: pytest.MonkeyPatch, port: str
) -> None:
    ready(platform)
    platform.tasks.running.clear()
    platform.wait(minutes=11)

    def broken(*_: object) -> None:
        raise ConnectionError

    kind, _, method = port.partition(".")
    with monkeypatch.context() as patch:
        patch.setattr(getattr(platform, kind), method, broken)
        assert sweep.handler({}, None)["failed"] == 1
    platform.bus.sent.clear()
    platform.wait(seconds=1)
    assert sweep.handler({}, None)["failed"] == 0
    assert platform.bus.sent[-1][1]["attempt"] == 2
    assert from_json(platform.documents.kept[server.key(LABEL)][0], Server).is_closed
    assert (platform.dns.records, platform.timers.due) == ({}, {})


def test_a_new_server_in_its_own_cluster_keeps_its_resources_before_its_task_is_listed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    platform = installed(study(cluster="participant"))
    place.use(platform)
    platform.tasks.fail = [ConnectionError()]
    with pytest.raises(ConnectionError):
        Servers(platform).start(StartServer("maze", "alice"))
    platform.wait(minutes=11)
    Servers(platform).start(StartServer("maze", "alice"))
    monkeypatch.setattr(platform.tasks, "list", lambda: iter(()))
    assert sweep.handler({}, None)["failed"] == 1
    assert list(platform.timers.due) == [NAME]
    assert not from_json(platform.documents.kept[server.key(LABEL)][0], Server).is_closed


def test_a_server_that_outlived_its_deadline_is_stopped(platform: FakePlatform) -> None:
    ready(platform)
    platform.wait(minutes=36)
    assert sweep.handler({}, None)["overdue"] == 1
    ((topic, message),) = platform.bus.sent
    stop = messages.parse_stop_server(dict(message))
    assert topic is Topic.STOP
    assert stop
    assert Servers(platform).stop([stop]) == []
    assert not platform.tasks.running
    assert from_json(platform.documents.kept[server.key(LABEL)][0], Server).reason is Reason.DEADLINE


def test_the_task_of_an_earlier_attempt_is_removed_and_the_present_one_stays(platform: FakePlatform) -> None:
    ready(platform)
    old = next(iter(platform.tasks.running.values()))
    stored = from_json(platform.documents.kept[server.key(LABEL)][0], Server)
    Servers(platform).stop([StopServer("maze", "alice")])
    Servers(platform).start(StartServer("maze", "alice", 2))
    platform.tasks.by_name.clear()
    platform.tasks.run(old)
    assert sweep.handler({}, None)["tasks"] == 1
    assert [r.name for r in platform.tasks.running.values()] == [ids.server_name(stored.label, 2)]


def test_a_resource_that_cannot_be_removed_does_not_prevent_the_others(platform: FakePlatform) -> None:
    leftovers(platform)
    platform.tasks.stop = None  # type: ignore[assignment,method-assign]
    swept = sweep.handler({}, None)
    assert (swept["failed"], swept["tasks"], swept["names"], swept["timers"]) == (1, 0, 1, 2)


def test_a_server_may_take_five_minutes_to_end_after_its_deadline(platform: FakePlatform) -> None:
    ready(platform)
    platform.wait(minutes=35)
    assert sweep.handler({}, None)["overdue"] == 0
    platform.wait(seconds=1)
    assert sweep.handler({}, None)["overdue"] == 1


def test_a_server_whose_task_is_not_listed_is_lost_after_ten_minutes(platform: FakePlatform) -> None:
    ready(platform)
    platform.tasks.running.clear()
    platform.wait(minutes=10)
    assert sweep.handler({}, None)["lost"] == 0
    platform.wait(seconds=1)
    assert sweep.handler({}, None)["lost"] == 1


def test_a_record_that_cannot_be_read_is_counted_as_failed_and_its_resources_stay(platform: FakePlatform) -> None:
    leftovers(platform)
    platform.documents.kept[server.key(LABEL)] = (b"{", "1", platform.now())
    swept = sweep.handler({}, None)
    assert (swept["failed"], swept["tasks"], swept["names"], swept["timers"]) == (1, 0, 0, 0)


def test_a_pool_that_cannot_be_read_is_one_failure_and_the_rest_is_swept(platform: FakePlatform) -> None:
    leftovers(platform)
    platform.documents.put("_warm/maze.json", b"{")
    swept = sweep.handler({}, None)
    assert (swept["failed"], swept["warm_servers"], swept["tasks"], swept["names"]) == (1, 0, 1, 1)


def test_a_sweep_without_findings_counts_nothing(platform: FakePlatform) -> None:
    assert set(sweep.handler({}, None).values()) == {0}


# Servers that stay in a state for too long


def record_of(platform: FakePlatform, user: str = "alice") -> Server:
    return from_json(platform.documents.kept[server.key(ids.server_label("maze", user))][0], Server)


def deliver(platform: FakePlatform) -> None:
    """Deliver all messages, and all that follow from them."""
    while platform.bus.sent or platform.bus.delayed:
        sent = [(topic, dict(message)) for topic, message in platform.bus.sent]
        later = [dict(message) for _, message in platform.bus.delayed]
        platform.bus.sent.clear()
        platform.bus.delayed.clear()
        servers = Servers(platform)
        for topic, message in sent:
            start, stop = messages.parse_start_server(message), messages.parse_stop_server(message)
            if topic is Topic.START and start:
                servers.start(start)
            elif stop:
                assert servers.stop([stop]) == []
        for message in later:
            names, task = messages.parse_dns_changed(message), messages.parse_task_changed(message)
            assert (servers.dns_changed(names) if names else servers.tasks_changed([task] if task else [])) == []


def sweeps(platform: FakePlatform, minutes: int) -> None:
    """Run the sweeps of so many minutes, and deliver the messages that follow."""
    for _ in range(minutes // 5):
        platform.wait(minutes=5)
        assert sweep.handler({}, None)["failed"] == 0
        deliver(platform)


def start_is_cut_off(platform: FakePlatform) -> None:
    """The start message becomes a dead letter when only the record is written."""
    platform.timers.set = None  # type: ignore[method-assign,assignment]
    with pytest.raises(TypeError):
        Servers(platform).start(StartServer("maze", "alice"))
    del platform.timers.set


def running_is_not_told(platform: FakePlatform) -> None:
    """ECS's event is lost."""
    Servers(platform).start(StartServer("maze", "alice"))


def looks_are_lost(platform: FakePlatform) -> None:
    """The message that the function sends itself becomes a dead letter."""
    platform.dns.slow = True
    ready(platform)
    platform.bus.delayed.clear()
    platform.dns.slow = False
    platform.dns.settle()


def deadline_is_not_told(platform: FakePlatform) -> None:
    ready(platform)
    platform.timers.due.clear()
    platform.wait(minutes=30)


def stop_of_a_warm_server_is_lost(platform: FakePlatform) -> None:
    warm_server = ids.warm_id("maze", platform.now(), 0)
    ready_warm_server = Servers(platform)
    ready_warm_server.start(StartServer("maze", warm_server))
    stored = Repository(platform.documents).server(ids.server_label("maze", warm_server))
    assert stored
    platform.documents.put(server.key(stored.server.label), to_json(server.draining(stored.server)))


def replacement_is_lost(platform: FakePlatform) -> None:
    ready(platform)
    stored = Repository(platform.documents).server(LABEL)
    assert stored
    platform.tasks.running.clear()
    Servers(platform).clean_up_lost(stored, Reason.LOST)
    platform.bus.sent.clear()


STAYS = {
    ServerState.STARTING: (start_is_cut_off, running_is_not_told),
    ServerState.NAMING: (looks_are_lost,),
    ServerState.READY: (deadline_is_not_told,),
    ServerState.DRAINING: (stop_of_a_warm_server_is_lost,),
    ServerState.CLOSED: (replacement_is_lost, leftovers),
}
UNRECORDED = {ServerState.QUEUED}  # there is no record, so no sweep can find it; the participant's page asks again


def test_there_is_a_test_for_every_state_in_which_a_server_may_stay() -> None:
    assert STAYS.keys() | UNRECORDED == set(ServerState)
    assert set(RULES) == set(ServerState)


@pytest.mark.parametrize(
    ("state", "trouble"), [(state, trouble) for state, troubles in STAYS.items() for trouble in troubles]
)
def test_the_sweep_repairs_a_server_that_stays_in_a_state_for_too_long(
    platform: FakePlatform, state: ServerState, trouble: Callable[[FakePlatform], None]
) -> None:
    trouble(platform)
    stuck = next(
        from_json(kept[0], Server) for key, kept in platform.documents.kept.items() if key.startswith("_servers/")
    )
    assert stuck.state is state
    sweeps(platform, 10)
    if state in (ServerState.STARTING, ServerState.NAMING):
        assert (record_of(platform).state, record_of(platform).attempt) == (ServerState.READY, 1)
    elif trouble is replacement_is_lost:
        assert (record_of(platform).state, record_of(platform).attempt) == (ServerState.READY, 2)
    else:
        assert all(
            from_json(kept[0], Server).is_closed
            for key, kept in platform.documents.kept.items()
            if key.startswith("_servers/")
        )
        assert (platform.tasks.running, platform.dns.records, platform.timers.due) == ({}, {}, {})


@pytest.mark.parametrize("trouble", [looks_are_lost, running_is_not_told])
def test_no_message_is_sent_again_within_three_minutes(
    platform: FakePlatform, trouble: Callable[[FakePlatform], None]
) -> None:
    trouble(platform)
    platform.wait(minutes=3)
    assert sum(sweep.handler({}, None).values()) == 0
    platform.wait(seconds=1)
    assert sweep.handler({}, None)["asked"] == 1


def test_a_task_that_has_not_run_after_twenty_minutes_is_given_up_and_replaced(platform: FakePlatform) -> None:
    Servers(platform).start(StartServer("maze", "alice"))
    (task,) = platform.tasks.running
    platform.tasks.pending.add(task)
    platform.wait(minutes=20)
    assert sum(sweep.handler({}, None).values()) == 0
    platform.wait(seconds=1)
    assert sweep.handler({}, None)["lost"] == 1
    deliver(platform)
    assert task in platform.tasks.stopped
    assert [request.name for request in platform.tasks.running.values()] == [ids.server_name(LABEL, 2)]


def test_the_record_of_a_server_without_resources_is_closed_after_its_deadline(platform: FakePlatform) -> None:
    ready(platform)
    for things in (platform.tasks.running, platform.dns.records, platform.timers.due):
        things.clear()
    sweeps(platform, platform.settings.max_runtime + 20)
    assert record_of(platform).is_closed


def test_a_lost_server_of_hours_ago_is_not_replaced_any_more(platform: FakePlatform) -> None:
    replacement_is_lost(platform)
    platform.wait(minutes=21)
    assert sum(sweep.handler({}, None).values()) == 0


def test_only_a_few_sweeps_read_each_record(platform: FakePlatform) -> None:
    ready(platform)
    Servers(platform).stop([StopServer("maze", "alice")])
    reads = []
    for _ in range(60):
        platform.wait(minutes=5)
        platform.documents.calls.clear()
        sweep.handler({}, None)
        reads.append(platform.documents.calls.count("get"))
    quiet = reads[-1]
    assert sum(count - quiet for count in reads) <= 8


@pytest.mark.parametrize(("minutes", "seconds", "read"), [(3, 0, False), (3, 1, True), (18, 0, True), (18, 1, False)])
def test_a_record_without_resources_is_read_from_its_third_minute_for_a_quarter_of_an_hour(
    platform: FakePlatform, minutes: int, seconds: int, read: bool
) -> None:
    ready(platform)
    Servers(platform).stop([StopServer("maze", "alice")])
    platform.wait(minutes=minutes, seconds=seconds)
    read_keys: list[str] = []
    get = platform.documents.get
    platform.documents.get = lambda key, *kept: read_keys.append(key) or get(key, *kept)  # type: ignore
    sweep.handler({}, None)
    assert (server.key(LABEL) in read_keys) is read


def test_a_record_that_cannot_be_read_does_not_keep_the_sweep_from_other_records(platform: FakePlatform) -> None:
    running_is_not_told(platform)
    Servers(platform).start(StartServer("maze", "bob"))
    platform.documents.put(server.key(ids.server_label("maze", "bob")), b"{")
    platform.wait(minutes=5)
    swept = sweep.handler({}, None)
    assert (swept["failed"], swept["asked"]) == (1, 1)
