"""Messages about DNS changes come in batches: all are checked together, and one failure does not affect the rest."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest

from hippodrome.control.model import ids, messages, server
from hippodrome.control.model.design import Step
from hippodrome.control.model.messages import DnsChanged, ServerAttempt, StartServer, StopServer, TaskChanged
from hippodrome.control.model.project import MASTER_LIST, MasterList, Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.ports import DnsRecord, RefusedDnsRecords, ServiceBusy
from hippodrome.control.servers.dns import MAX_ADDRESS_CHECKS, MAX_CHECKS, PAUSES, RETRY_PAUSE, pause
from testing import template
from testing.fake_platform import FakePlatform
from testing.servers import Servers

PEOPLE = ("alice", "bob")


def installation() -> FakePlatform:
    """Return an installation with a study of one game."""
    platform = FakePlatform()
    project = Project(id="maze", steps=[Step(key="1", page="game"), Step(key="2", page="end")], live=True, secret="0")
    platform.documents.put(MASTER_LIST, to_json(MasterList(projects=[project])))
    return platform


@pytest.fixture
def platform() -> FakePlatform:
    """An installation with the running servers of two participants, each with a pending DNS change of its own."""
    platform = installation()
    platform.dns.slow = True
    servers = Servers(platform)
    for number, user in enumerate(PEOPLE):
        servers.start(StartServer("maze", user))
        (task,) = (t for t, request in platform.tasks.running.items() if request.name == name(user))
        event = TaskChanged(task, "hippodrome", name(user), "RUNNING", f"eni-{number}", None, "", None)
        assert servers.tasks_changed([event]) == []
    return platform


def name(user: str) -> str:
    return ids.server_name(ids.server_label("maze", user), 1)


def states(platform: FakePlatform) -> list[ServerState]:
    kept = platform.documents.kept
    return [from_json(kept[server.key(ids.server_label("maze", user))][0], Server).state for user in PEOPLE]


def follow_ups(platform: FakePlatform) -> list[DnsChanged]:
    found = [messages.parse_dns_changed(json.loads(json.dumps(message))) for _, message in platform.bus.delayed]
    platform.bus.delayed.clear()
    return [message for message in found if message]


def test_a_server_is_ready_when_its_change_is_in_sync_and_other_changes_are_checked_again(
    platform: FakePlatform,
) -> None:
    assert [seconds for seconds, _ in platform.bus.delayed] == [PAUSES[0]] * 2
    first, second = follow_ups(platform)
    platform.dns.pending.remove(first.change)
    assert Servers(platform).dns_changed(first, second) == []
    assert states(platform) == [ServerState.READY, ServerState.NAMING]
    assert [seconds for seconds, _ in platform.bus.delayed] == [PAUSES[1]]
    assert [message.servers for message in follow_ups(platform)] == [second.servers]


def test_a_server_that_becomes_ready_in_the_process_that_named_it_is_read_once() -> None:
    platform = installation()
    servers = Servers(platform)
    servers.start(StartServer("maze", "alice"))
    platform.documents.calls.clear()
    assert servers.tasks_changed([running(platform, "alice", "eni")]) == []
    assert from_json(platform.documents.kept[server.key(ids.server_label("maze", "alice"))][0], Server).ready
    assert platform.documents.calls.count("get") == 1


def test_all_changes_are_checked_at_the_same_time(platform: FakePlatform) -> None:
    batches: list[int] = []
    together = platform.run_all

    def counted(acts: Sequence[object]) -> list[object]:
        batches.append(len(acts))
        return together(acts)  # type: ignore[arg-type]

    platform.run_all = counted  # type: ignore[method-assign,assignment]
    platform.dns.settle()
    Servers(platform).dns_changed(*follow_ups(platform))
    assert batches == [2, 2], "the looks, and then the records of all that are ready"
    assert states(platform) == [ServerState.READY, ServerState.READY]


def test_only_the_message_of_a_failed_check_comes_again(platform: FakePlatform) -> None:
    first, second = follow_ups(platform)
    platform.dns.settle()
    in_sync = platform.dns.in_sync

    def throttled(change: str) -> bool:
        if change == first.change:
            raise TimeoutError
        return in_sync(change)

    platform.dns.in_sync = throttled  # type: ignore[method-assign]
    assert Servers(platform).dns_changed(first, second) == [first]
    assert states(platform) == [ServerState.NAMING, ServerState.READY]


def test_a_pending_change_is_not_checked_twice_because_another_failed(platform: FakePlatform) -> None:
    first, second = follow_ups(platform)
    platform.dns.pending.remove(first.change)
    Servers(platform).stop([StopServer("maze", PEOPLE[0], 1, Reason.STOPPED)])
    removed: list[DnsRecord] = []

    def busy(add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        removed.extend(remove)
        raise TimeoutError

    platform.dns.change = busy  # type: ignore[method-assign]
    assert Servers(platform).dns_changed(first, second) == [first]
    assert len(removed) == 1, "the name of a server that was stopped meanwhile"
    assert [message.servers for message in follow_ups(platform)] == [second.servers]


def busy(add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
    raise ServiceBusy


def test_names_that_a_busy_zone_did_not_take_are_made_soon_with_one_change(platform: FakePlatform) -> None:
    servers, change = Servers(platform), platform.dns.change
    for record in (platform.dns.records, platform.bus.delayed):
        record.clear()
    platform.dns.change = busy  # type: ignore[method-assign]
    for number, user in enumerate(PEOPLE):
        task = next(t for t, request in platform.tasks.running.items() if request.name == name(user))
        event = TaskChanged(task, "hippodrome", name(user), "RUNNING", f"eni-{number}", None, "", None)
        assert servers.tasks_changed([event]) == [], "the queue would bring it after its visibility timeout"
    assert [seconds for seconds, _ in platform.bus.delayed] == [RETRY_PAUSE] * 2
    waiting = follow_ups(platform)
    assert servers.dns_changed(*waiting) == []
    (together,) = follow_ups(platform)
    assert together.looked == 2
    platform.dns.change, before = change, platform.dns.changes  # type: ignore[method-assign]
    servers.dns_changed(together)
    assert platform.dns.changes == before + 1
    assert set(platform.dns.records) == {f"{name(user)}.servers.example.org" for user in PEOPLE}
    platform.dns.settle()
    servers.dns_changed(*follow_ups(platform))
    assert states(platform) == [ServerState.READY, ServerState.READY]


def test_the_name_of_a_stopped_server_is_not_made(platform: FakePlatform) -> None:
    platform.bus.delayed.clear()
    servers = Servers(platform)
    servers.stop([StopServer("maze", PEOPLE[0], 1, Reason.STOPPED)])
    platform.dns.records.clear()
    both = [ServerAttempt(ids.server_label("maze", user), 1) for user in PEOPLE]
    servers.dns_changed(DnsChanged("", both, 1, unmade=True))
    assert list(platform.dns.records) == [f"{name(PEOPLE[1])}.servers.example.org"]


def test_after_the_last_check_the_message_for_a_busy_zone_goes_back_to_the_queue(platform: FakePlatform) -> None:
    platform.bus.delayed.clear()
    platform.dns.change = busy  # type: ignore[method-assign]
    last = DnsChanged("", [ServerAttempt(ids.server_label("maze", PEOPLE[0]), 1)], MAX_CHECKS, unmade=True)
    assert Servers(platform).dns_changed(last) == [last]
    assert not platform.bus.delayed


def test_a_throttled_check_is_repeated_soon(platform: FakePlatform) -> None:
    first, second = follow_ups(platform)

    def throttled(change: str) -> bool:
        raise ServiceBusy

    platform.dns.in_sync = throttled  # type: ignore[method-assign]
    assert Servers(platform).dns_changed(first, second) == []
    assert [message.looked for message in follow_ups(platform)] == [2, 2]


def test_a_function_with_a_lost_attempt_in_its_cache_makes_the_next_one_ready(platform: FakePlatform) -> None:
    platform.bus.delayed.clear()
    user, one, other = "carol", Servers(platform), Servers(platform)

    def event(attempt: int, status: str) -> TaskChanged:
        server_name = ids.server_name(ids.server_label("maze", user), attempt)
        task = next(t for t, request in platform.tasks.running.items() if request.name == server_name)
        code = "SpotInterruption" if status == "STOPPED" else None
        return TaskChanged(task, "hippodrome", server_name, status, f"eni-{attempt}", code, "", None)

    one.start(StartServer("maze", user))
    one.tasks_changed([event(1, "RUNNING")])
    other.tasks_changed([event(1, "STOPPED")])
    other.start(StartServer("maze", user, 2))
    other.tasks_changed([event(2, "RUNNING")])
    second = follow_ups(platform)[-1]
    platform.dns.settle()
    one.dns_changed(second)
    kept = platform.documents.kept[server.key(ids.server_label("maze", user))]
    assert from_json(kept[0], Server).state is ServerState.READY


def test_a_message_about_a_missing_server_is_dropped(platform: FakePlatform) -> None:
    gone = DnsChanged("", [ServerAttempt(ids.server_label("maze", "carol"), 1)])
    assert Servers(platform).dns_changed(gone) == []


# Slow names


CHAIN = 16  # after so many invocations of a chain Lambda, by default, drops the next one (Lambda Developer Guide)


def test_two_slow_minutes_are_a_chain_that_lambda_would_stop_without_the_templates_permission() -> None:
    usual = next(looks for looks in range(MAX_CHECKS) if sum(map(pause, range(looks))) >= 60)
    slow = next(looks for looks in range(MAX_CHECKS) if sum(map(pause, range(looks))) >= 120)
    assert usual < CHAIN < slow
    (function,) = (
        one for one in template.resources("AWS::Lambda::Function").values() if "task_changed" in one["Handler"]
    )
    assert function["RecursiveLoop"] == "Allow"


def test_the_checks_of_a_change_end_after_about_ten_minutes() -> None:
    assert 600 <= sum(pause(looked) for looked in range(MAX_CHECKS)) <= 720


def test_the_pause_before_a_check_is_short_compared_with_the_time_waited() -> None:
    waited = 0
    for looked in range(len(PAUSES)):
        assert pause(looked) <= max(PAUSES[0] if not looked else 3, waited / 5), looked
        waited += pause(looked)


def looks(platform: FakePlatform) -> list[int]:
    """Deliver the messages that the function sends itself until there are none. Returns the pause before each delivery."""
    pauses = []
    while platform.bus.delayed:
        pauses += [seconds for seconds, _ in platform.bus.delayed]
        assert Servers(platform).dns_changed(*follow_ups(platform)) == []
        assert len(pauses) < 1000
    return pauses


def test_a_change_that_stays_pending_is_left_to_the_sweep(platform: FakePlatform) -> None:
    platform.bus.delayed.pop()
    assert len(looks(platform)) == MAX_CHECKS
    assert states(platform) == [ServerState.NAMING] * 2


def test_a_server_that_cannot_be_made_ready_is_tried_a_limited_number_of_times(platform: FakePlatform) -> None:
    """The template allows this function's loop, so Lambda would not end it."""
    platform.documents.put(server.key(ids.server_label("maze", PEOPLE[0])), b"{")
    platform.dns.settle()
    assert len(looks(platform)) <= MAX_CHECKS + 1
    assert from_json(platform.documents.kept[server.key(ids.server_label("maze", PEOPLE[1]))][0], Server).ready


def running(platform: FakePlatform, user: str, interface: str) -> TaskChanged:
    task = next(t for t, request in platform.tasks.running.items() if request.name == name(user))
    return TaskChanged(task, "hippodrome", name(user), "RUNNING", interface, None, "", None)


def test_an_unknown_address_is_asked_for_a_limited_number_of_times() -> None:
    platform = installation()
    servers = Servers(platform)
    servers.start(StartServer("maze", "alice"))
    asked = running(platform, "alice", "eni-bare")
    for _ in range(MAX_ADDRESS_CHECKS):
        assert servers.tasks_changed([asked]) == [], "the queue would bring it after its visibility timeout"
        ((seconds, message),) = platform.bus.delayed
        platform.bus.delayed.clear()
        assert seconds == RETRY_PAUSE
        seen = messages.parse_task_changed(json.loads(json.dumps(message)))
        assert seen
        assert (seen.task, seen.name, seen.interface, seen.status) == (asked.task, asked.name, "eni-bare", "RUNNING")
        asked = seen
    assert servers.tasks_changed([asked]) == [asked]
    servers.tasks_changed([asked._replace(interface="eni-1")])
    record = from_json(platform.documents.kept[server.key(ids.server_label("maze", "alice"))][0], Server)
    assert record.state is ServerState.READY


# Names that the zone refuses


@pytest.fixture
def by_id() -> FakePlatform:
    """An installation with two running servers whose names are their participants' ids."""
    platform = FakePlatform()
    platform.settings = replace(platform.settings, user_id_names=True)
    steps = [Step(key="1", page="game"), Step(key="2", page="end")]
    project = Project(id="maze", steps=steps, live=True, secret="0", subdomain="userId")
    platform.documents.put(MASTER_LIST, to_json(MasterList(projects=[project])))
    for user in PEOPLE:
        Servers(platform).start(StartServer("maze", user))
    return platform


def refuse(platform: FakePlatform, wrong: Callable[[str], bool]) -> None:
    change = platform.dns.change

    def judged(add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        refused = [record for record in add if wrong(record.name)]
        made = change([record for record in add if record not in refused], remove)
        if refused:
            raise RefusedDnsRecords(refused, made)
        return made

    platform.dns.change = judged  # type: ignore[method-assign]


def both(platform: FakePlatform) -> list[TaskChanged]:
    return [running(platform, user, f"eni-{number}") for number, user in enumerate(PEOPLE)]


def test_a_refused_name_is_replaced_by_the_default_name(by_id: FakePlatform) -> None:
    refuse(by_id, lambda wanted: wanted.startswith("alice."))
    assert Servers(by_id).tasks_changed(both(by_id)) == []
    assert states(by_id) == [ServerState.READY, ServerState.READY]
    assert sorted(by_id.dns.records) == ["bob.servers.example.org", f"{name('alice')}.servers.example.org"]


def test_only_the_event_of_a_server_whose_names_are_refused_comes_again(by_id: FakePlatform) -> None:
    refuse(by_id, lambda wanted: wanted.startswith(("alice.", name("alice"))))
    events = both(by_id)
    assert Servers(by_id).tasks_changed(events) == events[:1]
    assert states(by_id) == [ServerState.NAMING, ServerState.READY]


def test_only_the_follow_up_of_a_refused_name_comes_again(by_id: FakePlatform) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(by_id.dns, "change", busy)
        assert Servers(by_id).tasks_changed(both(by_id)) == []
    refuse(by_id, lambda wanted: wanted.startswith(("alice.", name("alice"))))
    named = [ServerAttempt(ids.server_label("maze", user), 1) for user in PEOPLE]
    first, second = (DnsChanged("", [one], 1, unmade=True) for one in named)
    assert Servers(by_id).dns_changed(first, second) == [first]
    assert states(by_id) == [ServerState.NAMING, ServerState.READY]
