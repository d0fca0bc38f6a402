"""The servers' resources: all kinds are listed or none, and each belongs to one server."""

from __future__ import annotations

import pytest

from hippodrome.control.model import ids
from hippodrome.control.ports import DnsRecord, RunningTask
from hippodrome.control.servers import resources
from hippodrome.control.servers.resources import Resources
from testing.fake_platform import FakePlatform

ALICE, BOB = (ids.server_name(ids.server_label("maze", user), 1) for user in ("alice", "bob"))
FOUND = Resources(
    tasks=[RunningTask("task/1", "hippodrome", ALICE), RunningTask("task/2", BOB, BOB)],
    dns_records=[DnsRecord(f"{ALICE}.example.org", "203.0.113.1"), DnsRecord(f"{BOB}.example.org", "203.0.113.2")],
    timers=[ALICE, ids.delayed_timer(ALICE), BOB],
    clusters=[BOB],
    cluster="hippodrome",
)


def test_all_kinds_are_listed() -> None:
    platform = FakePlatform()
    platform.dns.change(add=[DnsRecord(f"{ALICE}.example.org", "203.0.113.1")])
    platform.timers.set(ids.delayed_timer(ALICE), platform.now(), {})
    platform.tasks.create_cluster(BOB)
    found = resources.list_resources(platform)
    assert sorted(found.names()) == sorted([ALICE, ALICE, BOB])
    assert found.kinds() == ["timer", "name", "cluster"]
    assert found.cluster == platform.settings.cluster


def test_a_failed_listing_raises_and_is_not_empty(monkeypatch: pytest.MonkeyPatch) -> None:
    platform = FakePlatform()

    def refused() -> None:
        raise PermissionError("scheduler:ListSchedules")

    monkeypatch.setattr(platform.timers, "list", refused)
    with pytest.raises(PermissionError, match="ListSchedules"):
        resources.list_resources(platform)


def test_both_timers_belong_to_their_server() -> None:
    assert FOUND.only(lambda name: name == ALICE).timers == [ALICE, f"{ALICE}-delay"]


def test_resources_that_only_this_installation_can_have_made_have_a_condition_of_their_own() -> None:
    """Tasks in its cluster and timers are its own; the zone and the account's other clusters may hold another installation's."""
    kept = FOUND.only(lambda _: False, ours=lambda _: True)
    assert [task.task for task in kept.tasks] == ["task/1"]
    assert kept.timers == FOUND.timers
    assert (kept.dns_records, kept.clusters) == ([], [])


def test_empty_resources_are_false() -> None:
    assert FOUND
    assert not FOUND.only(lambda _: False)
