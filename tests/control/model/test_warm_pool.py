"""The rules of a pool of warm servers, one by one, without a platform."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import msgspec
import pytest

from hippodrome.control.model import ids, warm_pool
from hippodrome.control.model.project import Project
from hippodrome.control.model.warm_pool import Pool, WarmServer
from hippodrome.control.ports import Settings
from hippodrome.protocol.keys import handover_key, handovers_folder
from testing.studies import study

NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)


def settings(max_runtime: int) -> Settings:
    return Settings(max_runtime=max_runtime)


def project(**changes: object) -> Project:
    return study(warm_servers=2, version="v1", **changes)


def warm_server(minutes: int, *, ready: bool = False, version: str = "v1") -> WarmServer:
    return WarmServer(version, NOW + timedelta(minutes=minutes), ready)


def test_the_keys_of_pools_and_handovers() -> None:
    assert warm_pool.pool_key("maze") == "_warm/maze.json"
    assert handovers_folder("maze") == "maze/handovers/"
    assert handover_key("maze", "s1-1") == "maze/handovers/s1-1.json"


@pytest.mark.parametrize(
    ("installation", "hours", "waits"),
    [
        (30 + 24 * 60, None, timedelta(hours=12)),
        (30 + 24 * 60, 100, timedelta(hours=1)),
        (30 + 40, None, timedelta(minutes=40)),
        (30 + 40, 100, timedelta(minutes=40)),
        (20, None, timedelta(0)),
    ],
)
def test_a_warm_server_waits_as_long_as_max_runtime_still_fits_after_the_wait(
    installation: int, hours: int | None, waits: timedelta
) -> None:
    assert warm_pool.longest_wait(project(max_server_hours=hours), settings(installation)) == waits


def test_the_deadlines_of_warm_servers_are_spread_over_the_last_quarter_of_the_wait() -> None:
    place, usual = settings(30 + 100), project()
    ends = [warm_pool.deadline(usual, place, f"label {number}", NOW) for number in range(200)]
    assert min(ends) < NOW + timedelta(minutes=76)
    assert max(ends) > NOW + timedelta(minutes=99)
    assert all(timedelta(minutes=75) < end - NOW <= timedelta(minutes=100) for end in ends)
    assert warm_pool.deadline(usual, place, "label 0", NOW) == ends[0]


@pytest.mark.parametrize(
    ("changes", "installation", "waiting", "room", "wanted"),
    [
        ({}, 120, 0, None, 2),
        ({}, 120, 5, None, 2),
        ({}, 120, 0, 5, 2),
        ({}, 120, 0, 1, 1),
        ({}, 120, 1, 0, 1),
        ({}, 120, 2, -1, 1),
        ({}, 120, 1, -3, 0),
        ({}, 40, 0, None, 2),
        ({}, 39, 0, None, 0),
        ({"live": False}, 120, 0, None, 0),
        ({"warm_servers": 0}, 120, 0, None, 0),
    ],
)
def test_how_many_warm_servers_a_project_should_have(
    changes: dict[str, object], installation: int, waiting: int, room: int | None, wanted: int
) -> None:
    changed = msgspec.structs.replace(project(), **changes)
    assert warm_pool.target_size(changed, settings(installation), waiting, room) == wanted
    assert warm_pool.target_size(None, settings(installation), waiting, room) == 0


def test_the_first_warm_server_is_ready_of_this_version_and_has_waited_longest() -> None:
    pool = Pool(
        {
            "a": warm_server(3, ready=True),
            "b": warm_server(2, ready=True),
            "c": warm_server(0),
            "d": warm_server(1, ready=True, version="v0"),
        },
        9,
    )
    assert (pool.first("v1"), pool.first("v0"), pool.first("v2")) == ("b", "d", None)
    assert pool.without_first("v1") == Pool(
        {"a": warm_server(3, ready=True), "c": warm_server(0), "d": warm_server(1, ready=True, version="v0")}, 9
    )
    assert pool.without_first("v2") is pool


def test_a_pool_changes_only_the_named_servers_and_keeps_its_counter() -> None:
    pool = Pool({"a": warm_server(0), "b": warm_server(1)}, 7)
    assert pool.without(["a", "x"]) == Pool({"b": warm_server(1)}, 7)
    assert pool.with_ready(["b", "x"]) == Pool({"a": warm_server(0), "b": warm_server(1, ready=True)}, 7)
    assert pool.with_returned("c", warm_server(2)) == Pool(
        {"a": warm_server(0), "b": warm_server(1), "c": warm_server(2)}, 7
    )


def test_new_warm_servers_get_ids_that_were_never_used() -> None:
    pool = Pool({"a": warm_server(0)}, 7)
    grown = pool.with_new(project(), 2, NOW)
    new = [ids.warm_id("maze", NOW, number) for number in (7, 8)]
    assert grown == Pool({"a": warm_server(0), new[0]: WarmServer("v1", NOW), new[1]: WarmServer("v1", NOW)}, 9)
    assert pool.with_new(project(), 0, NOW) == pool.with_new(project(), -1, NOW) == pool


def test_a_pool_is_resized_to_its_number() -> None:
    old, young, unready = warm_server(0, ready=True), warm_server(1, ready=True), warm_server(5)
    pool = Pool({"old": old, "young": young, "unready": unready, "other": warm_server(0, ready=True, version="v0")}, 4)
    assert pool.resized(None, 3, NOW) == Pool({}, 4)
    assert pool.resized(project(), 3, NOW) == Pool({"old": old, "young": young, "unready": unready}, 4)
    assert pool.resized(project(), 2, NOW) == Pool({"old": old, "young": young}, 4)
    assert pool.resized(project(), 1, NOW) == Pool({"young": young}, 4)
    assert pool.resized(project(), 0, NOW) == Pool({}, 4)
    assert len(pool.resized(project(), 5, NOW).warm_servers) == 5
    assert pool.of_registration(project()) == {"old": old, "young": young, "unready": unready}
    assert pool.of_registration(None) == {}
