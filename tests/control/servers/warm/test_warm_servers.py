"""Warm servers for participants (`warmServers`), on a platform in memory."""

from __future__ import annotations

import json
from datetime import timedelta

import msgspec
import pytest

from hippodrome.control import registry
from hippodrome.control.limits import rules as limits
from hippodrome.control.limits.rules import ServerSlots
from hippodrome.control.model import ids, messages, server, warm_pool
from hippodrome.control.model.messages import KeepWarm, StartServer, StopServer
from hippodrome.control.model.project import MASTER_LIST, MasterList, Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.model.warm_pool import Pool
from hippodrome.control.ports import NoCapacity, Refused, RetryLater, Topic
from hippodrome.control.servers.sweep import Sweep
from hippodrome.control.servers.warm.pools import Pools
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache
from hippodrome.protocol import handover
from hippodrome.protocol.handover import Handover
from hippodrome.protocol.keys import handovers_folder
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import installed, study
from tests.control.servers import delivery
from tests.control.servers.delivery import events

LABEL = ids.server_label("maze", "alice")
START = StartServer("maze", "alice")
STOP = StopServer("maze", "alice")
KEEP = KeepWarm("maze")


def warm(number: int = 2, **changes: object) -> Project:
    return study(warm_servers=number, version="v1", **changes)


def register(platform: FakePlatform, project: Project) -> None:
    """Replace the registered project, and let the functions see the new one."""
    platform.documents.put(MASTER_LIST, to_json(MasterList([project])))
    platform.wait(seconds=11)


def deliver(platform: FakePlatform) -> None:
    """Deliver all messages, and all that follow from them."""
    delivery.deliver(platform, Servers(platform))


def keep(platform: FakePlatform) -> None:
    """Send the message that keeps warm servers, and deliver all that follows."""
    platform.bus.publish(Topic.START, messages.to_message(KEEP))
    deliver(platform)


def sweep(platform: FakePlatform) -> None:
    """Sweep, and deliver all that follows."""
    Sweep(platform).run()
    deliver(platform)


def warmed(number: int = 2, **changes: object) -> FakePlatform:
    """Return an installation with so many warm servers that are ready."""
    platform = installed(warm(number, **changes))
    keep(platform)
    return platform


def pool(platform: FakePlatform) -> Pool:
    found = platform.documents.get(warm_pool.pool_key("maze"))
    return from_json(found.body, Pool) if found else Pool()


def token(platform: FakePlatform, server: Server) -> str:
    """Return the token that the page of this server's participant gets."""
    return SecretCache(platform.documents).token(server)


def record(platform: FakePlatform, label: str = LABEL) -> Server:
    return from_json(platform.documents.kept[server.key(label)][0], Server)


def warm_server_records(platform: FakePlatform) -> list[Server]:
    bodies = [body for key, (body, _, _) in platform.documents.kept.items() if key.startswith("_servers/")]
    return [found for found in (from_json(body, Server) for body in bodies) if found.is_warm_server]


def handovers(platform: FakePlatform) -> dict[str, Handover]:
    kept = platform.documents.kept
    return {key: handover.parse(kept[key][0]) for key in kept if key.startswith("maze/handovers/")}


def nothing_left(platform: FakePlatform) -> bool:
    things = platform.tasks.running or platform.dns.records or platform.timers.due or platform.tasks.own_clusters
    return not (things or handovers(platform) or pool(platform).warm_servers)


# Warm servers that wait


def test_as_many_warm_servers_as_wanted_are_started_and_named() -> None:
    platform = warmed(3)
    assert [warm_server.ready for warm_server in pool(platform).warm_servers.values()] == [True, True, True]
    assert len(platform.tasks.running) == len(platform.dns.records) == len(platform.timers.due) == 3


def test_a_warm_server_gets_no_participants_id_and_has_max_runtime_after_its_wait() -> None:
    platform = warmed(1)
    ((_, request),) = platform.tasks.running.items()
    ((at, message),) = platform.timers.due.values()
    (warm_server,) = warm_server_records(platform)
    assert request.environment["WARM_SERVER"] == "on"
    assert "USER_ID" not in request.environment
    assert "GROUP" not in request.environment
    assert at == warm_server.deadline
    longest = timedelta(minutes=120 - 30)  # what the installation allows, less what the project may play
    assert longest * 0.75 <= at - warm_server.requested <= longest
    assert int(request.environment["DEADLINE"]) == int(at.timestamp()) + 30 * 60
    assert message["userId"] == warm_server.user_id


def test_a_repeated_message_starts_no_more_warm_servers_than_wanted() -> None:
    platform = warmed(2)
    for _ in range(3):
        platform.bus.publish(Topic.START, messages.to_message(KEEP))
    deliver(platform)
    assert len(platform.tasks.by_name) == 2


def test_a_project_without_warm_servers_makes_no_calls_for_them() -> None:
    platform = installed()
    Servers(platform).start(START)
    platform.documents.calls.clear()
    Servers(platform).start(START)  # again: the record is there
    # The master list, the record, and the installation's secret, once for each container.
    assert platform.documents.calls.count("get") == 3


def test_no_link_can_name_a_warm_server() -> None:
    (warm_server,) = pool(warmed(1)).warm_servers
    assert ids.is_warm_id(warm_server)
    assert not ids.is_user_id(warm_server)


# A warm server is assigned


def test_a_participant_gets_a_warm_server_and_is_ready_at_once() -> None:
    platform = warmed(2)
    tasks = dict(platform.tasks.running)
    Servers(platform).start(START)
    mine = record(platform)
    assert mine.state is ServerState.READY
    assert platform.tasks.running == tasks
    assert tasks[str(mine.task)].environment["TOKEN"] == token(platform, mine)
    assert mine.dns_record
    assert platform.dns.records[mine.dns] == mine.dns_record.host
    assert platform.timers.due[mine.name] == (
        mine.deadline,
        {"projectId": "maze", "userId": "alice", "attempt": 1, "reason": "deadline"},
    )
    assert (mine.deadline - platform.now()).total_seconds() == 30 * 60


def test_the_handover_is_written_before_the_page_gets_the_address() -> None:
    platform = warmed(1)
    Servers(platform).start(START)
    (key,) = handovers(platform)
    assert key == f"maze/handovers/{record(platform).name}.json"
    assert handovers(platform)[key] == Handover("alice", ids.group("maze", "alice", 2), f"{LABEL}-1")
    versions = {key: int(etag.strip('"').rpartition("-")[2]) for key, (_, etag, _) in platform.documents.kept.items()}
    assert versions[key] < versions[server.key(LABEL)]


def test_an_assigned_warm_server_is_replaced_in_the_pool() -> None:
    platform = warmed(2)
    Servers(platform).start(START)
    assert platform.bus.sent == [(Topic.START, {"keepWarm": "maze"})]
    deliver(platform)
    assert [warm_server.ready for warm_server in pool(platform).warm_servers.values()] == [True, True]
    assert len(platform.tasks.running) == 3


def test_the_warm_server_that_has_waited_longest_is_assigned_first() -> None:
    platform = warmed(1)
    first = record(platform, next(iter(warm_server_records(platform))).label).name
    platform.wait(minutes=5)
    register(platform, warm(2))
    keep(platform)
    Servers(platform).start(START)
    assert record(platform).name == first


def test_without_a_ready_warm_server_an_own_server_is_started() -> None:
    platform = installed(warm(2))
    Servers(platform).start(START)
    assert record(platform).state is ServerState.STARTING
    (request,) = platform.tasks.running.values()
    assert request.environment["USER_ID"] == "alice"


def test_a_repeated_start_message_takes_one_warm_server() -> None:
    platform = warmed(2)
    for _ in range(3):
        Servers(platform).start(START)
    assert sum(warm_server.assigned_to == LABEL for warm_server in warm_server_records(platform)) == 1
    assert len(pool(platform).warm_servers) == 1


def test_a_crowd_takes_each_warm_server_once() -> None:
    platform = warmed(3)
    users = [f"user{n}" for n in range(5)]
    platform.documents.before_write = [lambda: Servers(platform).start(StartServer("maze", users[1]))]
    for user in users:
        Servers(platform).start(StartServer("maze", user))
    records = [record(platform, ids.server_label("maze", user)) for user in users]
    assert len({found.name for found in records}) == 5
    assert sum(found.warm_server_name is not None for found in records) == 3


def test_a_warm_server_of_an_older_registration_is_never_assigned_and_is_replaced() -> None:
    platform = warmed(1)
    (old,) = warm_server_records(platform)
    register(platform, msgspec.structs.replace(warm(1), version="v2"))
    Servers(platform).start(START)
    assert record(platform).warm_server_name is None
    keep(platform)
    assert record(platform, old.label).reason is Reason.STOPPED
    assert [warm_server.version for warm_server in pool(platform).warm_servers.values()] == ["v2"]


def test_after_two_lost_spot_servers_a_participant_gets_one_on_demand_and_no_warm_server() -> None:
    platform = warmed(1)
    servers = Servers(platform)
    for attempt in (1, 2):
        servers.start(StartServer("maze", "alice", attempt))
        name = record(platform).name
        (gone,) = [e for e in events(platform, "STOPPED", stop_code="SpotInterruption") if e.name == name]
        del platform.tasks.running[gone.task]
        servers.tasks_changed([gone])
        platform.bus.sent = [(topic, m) for topic, m in platform.bus.sent if "keepWarm" in m]
        deliver(platform)
    servers.start(StartServer("maze", "alice", 3))
    assert [(run.warm_server_name is None, run.reason) for run in record(platform).earlier] == [
        (False, Reason.LOST)
    ] * 2
    assert record(platform).warm_server_name is None
    assert not record(platform).spot


# Crashes during the assignment


def crash_at_write(platform: FakePlatform, number: int) -> None:
    """The function crashes at the write of this number."""

    def crash() -> None:
        raise ConnectionError

    platform.documents.before_write = [*[lambda: None] * (number - 1), crash]


WRITES = 6  # record, pool, record, warm server, handover, record


@pytest.mark.parametrize("number", range(1, WRITES + 1))
def test_after_a_crash_at_any_write_the_next_delivery_finishes_the_assignment(number: int) -> None:
    platform = warmed(2)
    crash_at_write(platform, number)
    with pytest.raises(ConnectionError):
        Servers(platform).start(START)
    Servers(platform).start(START)
    assert record(platform).state is ServerState.READY
    assert len(handovers(platform)) == 1
    assert len(platform.tasks.running) == 2
    deliver(platform)
    sweep(platform)
    assert len(platform.tasks.running) == 3
    assert Servers(platform).stop([STOP]) == []
    register(platform, warm(2, live=False))
    keep(platform)
    assert nothing_left(platform)
    assert all(found.is_closed for found in warm_server_records(platform))


@pytest.mark.parametrize("number", range(1, WRITES + 1))
def test_a_stop_at_any_write_of_the_assignment_leaves_nothing(number: int) -> None:
    platform = warmed(1)

    def stop() -> None:
        platform.documents.before_write = []
        Servers(platform).stop([STOP])

    platform.documents.before_write = [*[lambda: None] * (number - 1), stop]
    try:
        Servers(platform).start(START)
    except RetryLater:
        Servers(platform).start(START)
    deliver(platform)
    assert record(platform).is_closed
    Sweep(platform).run()
    register(platform, warm(1, live=False))
    sweep(platform)
    assert nothing_left(platform)
    assert all(found.is_closed for found in warm_server_records(platform))


def test_a_warm_server_that_is_drained_while_it_is_assigned_is_not_assigned() -> None:
    platform = warmed(1)
    (warm_server,) = warm_server_records(platform)

    def go() -> None:
        platform.documents.before_write = []
        Servers(platform).stop([StopServer("maze", warm_server.user_id, 1)])

    platform.documents.before_write = [*[lambda: None] * 3, go]
    Servers(platform).start(START)
    mine = record(platform)
    assert (mine.state, mine.warm_server_name) == (ServerState.STARTING, None)
    (request,) = platform.tasks.running.values()
    assert request.environment["USER_ID"] == "alice"
    assert request.environment["TOKEN"] == token(platform, mine) != token(platform, warm_server)
    deliver(platform)
    assert record(platform).state is ServerState.READY


# Ending


def test_an_assigned_warm_server_ends_like_any_other() -> None:
    platform = warmed(1)
    Servers(platform).start(START)
    (warm_server,) = [found for found in warm_server_records(platform) if found.assigned_to]
    assert Servers(platform).stop([STOP]) == []
    assert nothing_left(platform)
    assert record(platform).reason is Reason.STOPPED
    assert warm_server.reason is Reason.ASSIGNED


def test_a_lost_assigned_server_is_replaced_by_another_warm_server() -> None:
    platform = warmed(2)
    servers = Servers(platform)
    servers.start(START)
    name = record(platform).name
    (gone,) = [e for e in events(platform, "STOPPED", stop_code="SpotInterruption") if e.name == name]
    del platform.tasks.running[gone.task]
    servers.tasks_changed([gone])
    deliver(platform)
    mine = record(platform)
    assert (mine.attempt, mine.state) == (2, ServerState.READY)
    assert mine.warm_server_name
    assert mine.name != name
    assert [run.warm_server_name for run in mine.earlier] == [name]


def test_an_assigned_server_whose_trial_ends_closes_the_participants_record() -> None:
    platform = warmed(1)
    Servers(platform).start(START)
    (gone,) = events(platform, "STOPPED", stop_code="EssentialContainerExited", exit_code=0)
    platform.tasks.running.clear()
    Servers(platform).tasks_changed([gone])
    assert record(platform).reason is Reason.ENDED
    assert nothing_left(platform)


def test_a_repeated_follow_up_does_not_remove_the_name_of_an_assigned_server() -> None:
    platform = warmed(1)
    (warm_server,) = warm_server_records(platform)
    Servers(platform).start(START)
    Servers(platform).dns_changed(messages.DnsChanged("", [messages.ServerAttempt(warm_server.label, 1)]))
    Servers(platform).tasks_changed(events(platform, "RUNNING"))
    assert list(platform.dns.records) == [record(platform).dns]
    assert record(platform).state is ServerState.READY


def test_a_warm_servers_own_timer_does_not_end_the_participants_game() -> None:
    platform = warmed(1)
    ((_, message),) = platform.timers.due.values()
    Servers(platform).start(START)
    late = messages.parse_stop_server(dict(message))
    assert late
    assert Servers(platform).stop([late]) == []
    assert len(platform.tasks.running) == 1
    assert record(platform).state is ServerState.READY


def test_a_warm_server_that_has_waited_long_enough_is_replaced() -> None:
    platform = warmed(1)
    ((name, (at, message)),) = platform.timers.due.items()
    platform.clock = at
    del platform.timers.due[name]
    platform.bus.publish(Topic.STOP, message)
    deliver(platform)
    assert list(platform.timers.due) != [name]
    assert [warm_server.ready for warm_server in pool(platform).warm_servers.values()] == [True]


def test_warm_servers_that_were_started_together_have_different_deadlines() -> None:
    platform = warmed(4)
    assert len({at for at, _ in platform.timers.due.values()}) == 4


def test_a_warm_server_that_can_never_run_is_not_restarted_endlessly() -> None:
    platform = installed(warm(1))
    platform.tasks.fail = [Refused("no such image")]
    keep(platform)
    assert not platform.tasks.by_name
    assert nothing_left(platform)
    sweep(platform)
    assert len(platform.tasks.running) == 1


def test_a_warm_server_without_spot_capacity_runs_on_demand() -> None:
    platform = installed(warm(1))
    platform.tasks.fail = [NoCapacity()]
    keep(platform)
    assert [request.spot for request in platform.tasks.running.values()] == [False]
    Servers(platform).start(START)
    assert not record(platform).spot


def test_when_the_study_closes_warm_servers_end_and_games_go_on() -> None:
    platform = warmed(3)
    Servers(platform).start(START)
    deliver(platform)
    register(platform, warm(3, live=False))
    keep(platform)
    assert [request.name for request in platform.tasks.running.values()] == [record(platform).name]
    assert not pool(platform).warm_servers


def test_if_fewer_warm_servers_are_wanted_the_others_end() -> None:
    platform = warmed(3)
    register(platform, warm(1))
    keep(platform)
    assert len(pool(platform).warm_servers) == len(platform.tasks.running) == 1


# The sweep


def test_the_sweep_fills_the_pool_when_every_message_was_lost() -> None:
    platform = installed(warm(2))
    sweep(platform)
    assert len(platform.tasks.running) == 2


def test_the_sweep_knows_the_warm_servers_of_a_study_that_was_registered_a_moment_ago() -> None:
    platform = installed(study(id="another"))
    cache = ProjectCache(platform)
    cache.projects()
    platform.documents.put(MASTER_LIST, to_json(MasterList([warm(1)])))
    Servers(platform).start(KEEP)
    assert Pools(platform, cache).repair(Repository(platform.documents)) == {ids.warm_id("maze", platform.now(), 0)}


def test_the_sweep_asks_again_for_a_warm_server_whose_start_was_lost() -> None:
    platform = installed(warm(1))
    Servers(platform).start(KEEP)
    platform.bus.sent.clear()
    platform.wait(minutes=6)
    sweep(platform)
    assert len(platform.tasks.running) == len(pool(platform).warm_servers) == 1


def test_the_sweep_corrects_the_pool_about_ready_and_closed_servers() -> None:
    platform = warmed(2)
    first, second = warm_server_records(platform)
    entries = {
        id: msgspec.structs.replace(warm_server, ready=False) for id, warm_server in pool(platform).warm_servers.items()
    }
    platform.documents.put(warm_pool.pool_key("maze"), to_json(Pool(entries)))
    closed = server.close(first, Reason.LOST, platform.now())
    platform.documents.put(server.key(first.label), to_json(closed))
    Sweep(platform).run()
    assert {id: warm_server.ready for id, warm_server in pool(platform).warm_servers.items()} == {second.user_id: True}


def test_the_sweep_ends_a_warm_server_that_no_pool_lists_and_no_game() -> None:
    platform = warmed(2)
    Servers(platform).start(START)
    deliver(platform)
    platform.documents.put(warm_pool.pool_key("maze"), to_json(Pool()))
    swept = Sweep(platform).run()
    assert swept.warm_servers == 2
    platform.bus.sent = [(topic, m) for topic, m in platform.bus.sent if topic is Topic.STOP]
    deliver(platform)
    assert [request.name for request in platform.tasks.running.values()] == [record(platform).name]
    assert record(platform).state is ServerState.READY


def test_the_sweep_removes_leftovers_of_an_assigned_server() -> None:
    platform = warmed(1)
    Servers(platform).start(START)
    register(platform, warm(1, live=False))
    closed = server.close(record(platform), Reason.STOPPED, platform.now())
    platform.documents.put(server.key(LABEL), to_json(closed))
    platform.bus.sent.clear()
    sweep(platform)
    assert nothing_left(platform)


# Registering


def test_registering_starts_warm_servers_and_registering_again_replaces_them() -> None:
    platform = installed()
    steps = [{"key": step.key, "page": step.page, "variants": step.variants} for step in study().steps]
    known = {"startServerStep": "2", "stopServerStep": "4"}
    config = {
        "id": "maze",
        "live": True,
        "maxRuntime": 30,
        "warmServers": 1,
        "useAWS": False,
        "trial": {"game": "x/Y-v0"},
    }
    registry.register(platform, {**config, "steps": steps, "events": known})
    deliver(platform)
    (first,) = pool(platform).warm_servers
    registry.register(platform, {**config, "steps": steps, "events": known})
    deliver(platform)
    (second,) = pool(platform).warm_servers
    assert first != second
    platform.wait(seconds=11)
    assert len(platform.tasks.running) == 1


# Limits


def running(platform: FakePlatform) -> ServerSlots:
    return from_json(platform.documents.kept[limits.server_slots_key("maze")][0], ServerSlots)


def test_there_are_no_more_warm_servers_than_slots() -> None:
    platform = warmed(5, max_servers=2)
    assert len(platform.tasks.running) == len(running(platform).slots) == 2


def test_a_participant_takes_over_the_slot_of_the_warm_server() -> None:
    platform = warmed(1, max_servers=1)
    Servers(platform).start(START)
    assert list(running(platform).slots) == [LABEL]
    deliver(platform)
    assert len(platform.tasks.running) == 1
    Servers(platform).stop([STOP])
    assert not running(platform).slots
    sweep(platform)
    assert len(platform.tasks.running) == 1


def test_warm_servers_keep_no_participant_out() -> None:
    platform = installed(warm(1, max_servers=1))
    Servers(platform).start(KEEP)
    ((_, message),) = platform.bus.sent
    warm_server = messages.parse_start_server(dict(message))
    assert warm_server
    Servers(platform).start(warm_server)  # it holds the only slot, and is not ready
    Servers(platform).start(START)
    assert record(platform).state is ServerState.STARTING
    assert len(platform.tasks.running) == 2
    platform.bus.sent = [(Topic.START, messages.to_message(KEEP))]
    deliver(platform)
    assert [request.environment.get("USER_ID") for request in platform.tasks.running.values()] == ["alice"]


def test_after_a_new_registration_warm_servers_leave_their_slots_to_their_successors() -> None:
    platform = warmed(2, max_servers=2)
    register(platform, msgspec.structs.replace(warm(2, max_servers=2), version="v2"))
    keep(platform)
    assert [(warm_server.version, warm_server.ready) for warm_server in pool(platform).warm_servers.values()] == [
        ("v2", True)
    ] * 2
    assert len(platform.tasks.by_name) == 4, "none was started that had to be refused"


def test_the_wait_of_a_warm_server_counts_in_the_hours() -> None:
    platform = warmed(1, max_server_hours=2)
    (warm_server,) = warm_server_records(platform)
    assert timedelta(minutes=45) <= warm_server.deadline - warm_server.requested <= timedelta(hours=1)
    platform.wait(minutes=20)
    Servers(platform).start(START)
    assert running(platform).used == 20 * 60


def test_a_warm_server_that_finds_no_slot_leaves_the_pool() -> None:
    platform = installed(warm(1, max_servers=1))
    platform.bus.publish(Topic.START, messages.to_message(KEEP))
    kept, platform.bus.sent = platform.bus.sent, []
    assert kept
    servers = Servers(platform)
    servers.start(KEEP)
    ((_, asked),) = platform.bus.sent
    platform.bus.sent.clear()
    (warm_id,) = pool(platform).warm_servers
    other = limits.ServerSlots({ids.server_label("maze", "bob"): limits.ServerSlot(1, 60)})
    platform.documents.put(limits.server_slots_key("maze"), to_json(other))
    start = messages.parse_start_server(json.loads(json.dumps(asked)))
    assert start is not None
    servers.start(start)
    assert record(platform, ids.server_label("maze", warm_id)).reason is Reason.FULL
    assert pool(platform).warm_servers == {}


def waiting_writes(platform: FakePlatform, *acts: object) -> None:
    """Do these right before the next writes, in their order; None for nothing."""
    platform.documents.before_write += [act or (lambda: None) for act in acts]


def test_a_stop_during_a_handover_leaves_nothing() -> None:
    """The participant's server is stopped before the handover is written: the function undoes what it has done."""
    platform = warmed(1)
    # The participant's record, the pool, the warm server's name in the record, the warm server's record, its handover.
    waiting_writes(platform, None, None, None, None, lambda: Servers(platform).stop([STOP]))
    Servers(platform).start(START)
    assert record(platform).is_closed
    assert not [key for key in platform.documents.kept if key.startswith(handovers_folder("maze"))]
    assert not platform.timers.due
    assert not platform.tasks.running


def test_a_participant_who_is_stopped_while_a_warm_server_refuses_gets_no_server_of_their_own() -> None:
    platform = warmed(1)
    (warm_id,) = pool(platform).warm_servers
    key = server.key(ids.server_label("maze", warm_id))

    def leave() -> None:
        going = from_json(platform.documents.kept[key][0], Server)
        platform.documents.put(key, to_json(msgspec.structs.replace(going, state=ServerState.DRAINING)))

    # The participant's record, the pool, the warm server's name in the record; then the warm server's record and the participant's.
    waiting_writes(platform, None, None, None, leave, lambda: Servers(platform).stop([STOP]))
    Servers(platform).start(START)
    assert record(platform).is_closed
    # Neither the warm server's, which her record named when it was stopped, nor another.
    assert not platform.tasks.running
    assert not platform.timers.due.keys() - {ids.server_name(ids.server_label("maze", warm_id), 1)}
