"""Warm servers (`warmServers`) when two functions run at once, a reply is lost, or a cache is old."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import msgspec
import pytest

from hippodrome.control.model import messages, server, warm_pool
from hippodrome.control.model.messages import StartServer, StopServer
from hippodrome.control.model.project import MASTER_LIST, MasterList
from hippodrome.control.model.records import to_json
from hippodrome.control.model.server import ServerState
from hippodrome.control.model.warm_pool import Pool
from hippodrome.control.ports import NoCapacity, Topic
from hippodrome.control.servers.sweep import Sweep
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import installed
from tests.control.servers.warm.test_warm_servers import (
    KEEP,
    LABEL,
    START,
    STOP,
    crash_at_write,
    deliver,
    events,
    pool,
    record,
    running,
    warm,
    warm_server_records,
    warmed,
)


def before_write(platform: FakePlatform, number: int, act: Callable[[], object]) -> None:
    """Do this once, just before the write of this number."""

    def once() -> None:
        platform.documents.before_write = []
        act()

    platform.documents.before_write = [*[lambda: None] * (number - 1), once]


def cold_start_and_a_warm_server() -> FakePlatform:
    """Alice's own server is started; then a warm server becomes ready."""
    platform = installed(warm(1))
    Servers(platform).start(START)
    own = dict(platform.tasks.running)
    platform.tasks.running.clear()
    platform.bus.publish(Topic.START, messages.to_message(KEEP))
    deliver(platform)
    platform.tasks.running.update(own)
    return platform


def plays_on_what_the_record_says(platform: FakePlatform) -> bool:
    """Return whether the address that the page gets leads to a server that accepts the token that the page gets."""
    mine = record(platform)
    request = platform.tasks.running.get(mine.task or "")
    named = platform.dns.records.get(mine.dns) == mine.host
    told = SecretCache(platform.documents).token(mine)
    return mine.state is ServerState.READY and request is not None and request.environment["TOKEN"] == told and named


def test_an_own_server_that_runs_while_a_warm_server_is_assigned_is_removed() -> None:
    platform = cold_start_and_a_warm_server()
    own = [e for e in events(platform, "RUNNING", interface="eni-9") if e.name == f"{LABEL}-1"]

    def given_in_part() -> None:
        crash_at_write(platform, 4)  # before the warm server is reserved
        with pytest.raises(ConnectionError):
            Servers(platform).start(START)

    before_write(platform, 1, given_in_part)
    Servers(platform).tasks_changed(own)
    Servers(platform).start(START)
    deliver(platform)
    assert record(platform).warm_server_name
    assert plays_on_what_the_record_says(platform)
    assert f"{LABEL}-1" not in [request.name for request in platform.tasks.running.values()]


def test_a_participant_keeps_an_assigned_warm_server_even_if_their_own_cannot_be_started() -> None:
    platform = warmed(1)
    entry = platform.documents.kept.pop(warm_pool.pool_key("maze"))
    real = platform.tasks.run

    def run(request: object) -> str:
        platform.tasks.run = real  # type: ignore[method-assign]
        platform.documents.kept[warm_pool.pool_key("maze")] = entry
        Servers(platform).start(START)
        raise NoCapacity

    platform.tasks.run = run  # type: ignore[method-assign, assignment]
    platform.tasks.fail = [NoCapacity()]
    Servers(platform).start(START)
    deliver(platform)
    assert (record(platform).attempt, record(platform).spot) == (1, True)
    assert plays_on_what_the_record_says(platform)


def test_a_warm_server_that_ends_while_it_is_assigned_is_replaced_for_its_participant() -> None:
    platform = warmed(1)
    (gone,) = events(platform, "STOPPED", stop_code="SpotInterruption")
    platform.tasks.running.clear()
    servers = Servers(platform)
    before_write(platform, 1, lambda: servers.start(START))
    again = servers.tasks_changed([gone])
    assert servers.tasks_changed(again) == []
    deliver(platform)
    assert record(platform).attempt == 2
    assert plays_on_what_the_record_says(platform)


def test_a_lost_warm_server_holds_no_slot() -> None:
    platform = warmed(1, max_servers=1)
    (gone,) = events(platform, "STOPPED", stop_code="SpotInterruption")
    platform.tasks.running.clear()
    Servers(platform).tasks_changed([gone])
    assert not running(platform).slots


def test_a_warm_server_that_a_record_names_is_assigned_to_no_other_even_after_a_lost_reply() -> None:
    platform = warmed(1)

    def written() -> None:
        stored = Repository(platform.documents).server(LABEL)
        (warm_server,) = warm_server_records(platform)
        assert stored
        Repository(platform.documents).save(server.reserving(stored.server, warm_server), stored.etag)

    before_write(platform, 3, written)  # after the writes of the record and the pool
    Servers(platform).start(START)
    assert not pool(platform).warm_servers
    assert plays_on_what_the_record_says(platform)


def test_a_warm_server_is_started_by_the_last_registration() -> None:
    platform = installed(warm(1, task_definition="old:1"))
    one, other = Servers(platform), Servers(platform)
    one.start(StartServer("maze", "bob"))  # so it has just read the list of projects
    anew = msgspec.structs.replace(warm(1, task_definition="new:2"), version="v2")
    platform.documents.put(MASTER_LIST, to_json(MasterList([anew])))
    other.start(KEEP)
    ((_, message),) = [sent for sent in platform.bus.sent if "userId" in sent[1]]
    start = messages.parse_start_server(dict(message))
    assert start
    one.start(start)
    (warm_server,) = warm_server_records(platform)
    (request,) = [r for r in platform.tasks.running.values() if r.name == warm_server.name]
    assert request.definition == "new:2"


def test_with_all_hours_used_up_no_sweep_starts_a_warm_server() -> None:
    platform = warmed(3, max_server_hours=2)
    before = len(warm_server_records(platform))
    for _ in range(4):
        platform.wait(minutes=5)
        Sweep(platform).run()
        deliver(platform)
    assert len(warm_server_records(platform)) == before == 2


def test_a_name_that_is_made_while_its_warm_server_is_drained_is_removed() -> None:
    platform = installed(warm(1))
    platform.dns.slow = True
    servers = Servers(platform)
    servers.start(KEEP)
    ((_, message),) = platform.bus.sent
    start = messages.parse_start_server(dict(message))
    assert start
    servers.start(start)
    servers.tasks_changed(events(platform, "RUNNING"))
    (warm_server,) = warm_server_records(platform)
    ((_, follow),) = platform.bus.delayed
    changed = messages.parse_dns_changed(follow)
    assert changed
    platform.dns.settle()
    # a stop has removed what it saw, and has not closed the record yet
    platform.documents.put(server.key(warm_server.label), to_json(server.draining(warm_server)))
    servers.dns_changed(changed)
    assert not platform.dns.records


def test_the_sweep_replaces_a_warm_server_whose_start_was_never_finished() -> None:
    platform = installed(warm(1))
    servers = Servers(platform)
    servers.start(KEEP)
    ((_, message),) = platform.bus.sent
    start = messages.parse_start_server(dict(message))
    assert start

    def set_(*_: object) -> None:
        raise ConnectionError

    real, platform.timers.set = platform.timers.set, set_  # type: ignore[method-assign, assignment]
    with pytest.raises(ConnectionError):
        servers.start(start)
    platform.timers.set = real  # type: ignore[method-assign]
    platform.bus.sent.clear()
    platform.wait(minutes=21)
    for _ in range(2):  # the first sweep ends it, the second sees that one is missing
        Sweep(platform).run()
        deliver(platform)
    assert [warm_server.ready for warm_server in pool(platform).warm_servers.values()] == [True]


def test_a_warm_server_whose_program_fails_after_it_was_ready_is_not_restarted_endlessly() -> None:
    platform = warmed(1)
    servers = Servers(platform)
    (gone,) = events(platform, "STOPPED", stop_code="EssentialContainerExited", exit_code=4)
    platform.tasks.running.clear()
    servers.tasks_changed([gone])
    deliver(platform)
    assert not platform.tasks.running


def test_there_are_no_warm_servers_if_the_installation_allows_no_time_for_them() -> None:
    platform = installed(warm(1))
    platform.settings = replace(platform.settings, max_runtime=30)  # lowered to the project's own limit
    platform.bus.publish(Topic.START, messages.to_message(KEEP))
    deliver(platform)
    assert not platform.tasks.running


def test_a_stop_before_the_warm_server_is_assigned_gives_its_slot_back() -> None:
    platform = warmed(1, max_servers=1)
    crash_at_write(platform, 5)
    with pytest.raises(ConnectionError):
        Servers(platform).start(START)
    assert Servers(platform).stop([STOP]) == []
    assert record(platform).is_closed
    assert not running(platform).slots


def test_a_participant_whose_warm_server_is_refused_plays_on_their_own_started_server() -> None:
    platform = cold_start_and_a_warm_server()
    (warm_server,) = warm_server_records(platform)
    go = StopServer("maze", warm_server.user_id, 1)
    before_write(platform, 4, lambda: Servers(platform).stop([go]))  # the record names it, and it is not assigned yet
    Servers(platform).start(START)
    assert record(platform).warm_server_name is None
    deliver(platform)
    assert plays_on_what_the_record_says(platform)


def test_of_too_many_warm_servers_the_ready_one_stays() -> None:
    project, noon = warm(2), datetime(2026, 11, 21, 12, tzinfo=UTC)
    both = Pool().with_new(project, 1, noon)
    both = both.with_ready(list(both.warm_servers)).with_new(project, 1, noon + timedelta(minutes=1))
    assert [warm_server.ready for warm_server in both.resized(project, 1, noon).warm_servers.values()] == [True]
