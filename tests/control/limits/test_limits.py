"""A project's limits are never exceeded, however many participants come at once; without limits no AWS call is made for them."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control import registry
from hippodrome.control.limits import rules as limits
from hippodrome.control.limits.rules import SHARDS, ParticipantSlots, ServerSlot, ServerSlots
from hippodrome.control.limits.slots import Slots
from hippodrome.control.log import logger
from hippodrome.control.model import ids, server
from hippodrome.control.model.messages import StartServer, StopServer, TaskChanged
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.ports import Conflict, Documents, NoCapacity, Refused, RetryLater, Topic
from hippodrome.control.servers.sweep import Sweep
from hippodrome.local.backend.documents import FolderDocuments
from testing.fake_platform import FakePlatform
from testing.moto_world import MotoWorld
from testing.servers import Servers
from testing.simulation.people import SimulatedParticipant
from testing.simulation.world import PROJECT as SIMULATED
from testing.simulation.world import SimulatedWorld
from testing.slots import release_participant
from testing.studies import PAGES, installed, study
from testing.visitors import Browser
from tests.control.participants.test_journey import to_game

USERS = tuple(f"u{n}" for n in range(40))


def claimed(project: Project, user: str, attempt: int = 1) -> Server:
    platform = FakePlatform()
    return server.new_attempt(project, user, attempt, nonce="t", settings=platform.settings, now=platform.clock)


def server_slots(platform: FakePlatform) -> ServerSlots:
    found = platform.documents.kept.get("_slots/maze.json")
    return from_json(found[0], ServerSlots) if found else ServerSlots()


def labels_with_slots(platform: FakePlatform) -> list[str]:
    kept = platform.documents.kept
    return [
        label
        for key in kept
        if key.startswith("maze/slots/")
        for label in from_json(kept[key][0], ParticipantSlots).labels
    ]


def record(platform: FakePlatform, user: str = "alice") -> Server:
    return from_json(platform.documents.kept[server.key(ids.server_label("maze", user))][0], Server)


def start_and_run(platform: FakePlatform, user: str) -> str:
    """Start the user's server and let it run; its task, or "" if there was no slot."""
    servers = Servers(platform)
    servers.start(StartServer("maze", user))
    for task, request in platform.tasks.running.items():
        if request.environment["USER_ID"] == user:
            servers.tasks_changed([TaskChanged(task, "hippodrome", request.name, "RUNNING", "eni-1", None, "", None)])
            return task
    return ""


def lost_event(platform: FakePlatform, task: str, attempt: int = 1, user: str = "alice") -> TaskChanged:
    name = ids.server_name(ids.server_label("maze", user), attempt)
    platform.tasks.running.pop(task, None)
    return TaskChanged(task, "hippodrome", name, "STOPPED", None, "SpotInterruption", "", None)


# The records


@given(
    st.lists(
        st.tuples(st.sampled_from(["take", "leave", "keep", "free", "next"]), st.integers(0, 5), st.integers(0, 4000)),
        max_size=60,
    ),
    st.integers(1, 4),
    st.integers(1, 6),
)
def test_servers_and_hours_never_exceed_their_limits(steps: list[tuple[str, int, int]], most: int, hours: int) -> None:
    project = study(max_servers=most, max_server_hours=hours, max_runtime=45)
    now, attempts = ServerSlots(), dict.fromkeys(range(6), 1)
    for what, who, seconds in steps:
        record = claimed(project, f"u{who}", attempts[who])
        if what == "take":
            now = now.with_server(project, record) or now
        elif what == "free":
            now = now.without(record.label)
        elif what == "next":
            attempts[who] += 1
        else:
            now = now.released(record, seconds, keep=what == "keep")
            assert now.released(record, 2700, keep=what == "keep") == now  # done twice, counted once
        assert len(now.slots) <= most
        assert now.used + sum(held.reserved for held in now.slots.values()) <= hours * 3600


def test_a_server_counts_the_time_it_used_and_no_more_than_it_reserved() -> None:
    project = study(max_server_hours=1)
    record = claimed(project, "alice")
    taken = ServerSlots().with_server(project, record)
    assert taken is not None
    assert taken.with_server(project, record) is taken
    assert taken.released(record, 700).used == 700
    assert taken.released(record, 99999).used == 1800
    assert taken.released(claimed(project, "alice", 2), 700) is taken
    late = record.requested + timedelta(seconds=90)
    assert limits.seconds_used(record, Reason.LOST, late) == 90
    assert limits.seconds_used(record, Reason.STOPPED, record.requested) == limits.MIN_BILLED_SECONDS
    assert (
        limits.seconds_used(record, Reason.NO_CAPACITY, late) == limits.seconds_used(record, Reason.REFUSED, late) == 0
    )


@given(st.integers(1, 100_000))
def test_the_shares_of_all_shards_are_the_limit(limit: int) -> None:
    assert sum(limits.shard_share(limit, shard) for shard in range(SHARDS)) == limit
    assert limits.shard_share(limit, limits.first_shard("sabc", limit)) > 0


# Participants


@given(
    st.lists(st.one_of(st.sampled_from(USERS), st.integers(1, 40)), max_size=80),
    st.sets(st.sampled_from(USERS), max_size=15),
)
def test_whatever_the_limit_becomes_no_newcomer_exceeds_it(steps: list[str | int], before: set[str]) -> None:
    """Numbers are new limits; `before` are participants who came before there was a limit."""
    platform, inside, limit = installed(), set(before), 0
    came: set[str] = set()  # under the present limit
    for step in [5, *steps]:
        if isinstance(step, int):
            limit, came = step, set()
            Slots(platform).set_limit(study(max_participants=limit), before)
        elif step in came or step not in inside:
            room = step in came or len(inside) < limit
            assert Slots(platform).admit(study(max_participants=limit), step) is room
            if room:
                inside.add(step)
                came.add(step)
        assert sorted(labels_with_slots(platform)) == sorted(ids.server_label("maze", user) for user in inside)


def test_a_function_remembers_for_ten_seconds_that_a_study_is_full() -> None:
    platform = installed()
    slots, project = Slots(platform), study(max_participants=1)
    assert slots.admit(project, "alice")
    assert not slots.admit(project, "bob")
    platform.documents.calls.clear()
    platform.wait(seconds=9)
    assert not slots.admit(project, "carol")
    assert platform.documents.calls == []
    release_participant(platform.documents, "maze", "alice")
    platform.wait(seconds=1)
    assert slots.admit(project, "carol")


def test_a_newcomer_to_a_full_study_sees_that_it_is_full_and_nothing_is_stored() -> None:
    platform = installed(study(max_participants=1, events=study().events))
    Browser(platform, "projectId=maze&userId=alice").get()
    keys, sent = set(platform.documents.kept), len(platform.bus.sent)
    page = Browser(platform, "projectId=maze&userId=bob").get()
    assert "This study is full" in page
    assert "<form" not in page
    told = json.loads(Browser(platform, "projectId=maze&userId=bob").get(accept="application/json"))
    assert told["message"].startswith("This study is full")
    assert (set(platform.documents.kept), len(platform.bus.sent)) == (keys, sent)
    assert "This study is full" not in Browser(platform, "projectId=maze&userId=alice").get()


def test_a_crash_between_slot_and_record_takes_no_second_slot() -> None:
    platform = installed(study(max_participants=2))
    platform.documents.before_write = [lambda: None, _crash]
    alice = Browser(platform)
    assert alice.send()["statusCode"] == 500
    assert not any("users/" in key for key in platform.documents.kept)
    alice.get()
    assert len(labels_with_slots(platform)) == 1


def _crash() -> None:
    raise ConnectionError


def test_participants_who_came_before_the_limit_count() -> None:
    platform = installed()
    for user in ("alice", "bob"):
        Browser(platform, f"projectId=maze&userId={user}").get()
    for file in PAGES:
        platform.documents.put(f"maze/steps/{file}.html", b"x")
    for limit, carol in ((2, False), (3, True), (1, True)):
        answer = registry.register(platform, _registration(maxParticipants=limit))
        assert answer.max_participants == limit
        assert Slots(platform).admit(answer, "carol") is carol
    assert sorted(labels_with_slots(platform)) == sorted(
        ids.server_label("maze", user) for user in ("alice", "bob", "carol")
    )
    assert not Slots(platform).admit(answer, "dave")


def _registration(**changes: object) -> dict[str, Any]:
    steps = [("1", "consent", 2), ("2", "questionnaire", 0), ("3", "game", 0), ("finalStep", "debrief", 0)]
    return {
        "id": "maze",
        "steps": [{"key": key, "page": page, "variants": n} for key, page, n in steps],
        "trial": {"game": "ALE/MsPacman-v5"},
        **changes,
    }


# Servers


def test_beyond_max_servers_no_server_starts_and_the_page_says_so_until_there_is_room() -> None:
    platform = installed(study(max_servers=1))
    assert start_and_run(platform, "bob")
    alice = Browser(platform)
    to_game(alice)
    platform.bus.sent.clear()
    assert start_and_run(platform, "alice") == ""
    assert (record(platform).state, record(platform).reason) == (ServerState.CLOSED, Reason.FULL)
    assert set(platform.timers.due) == {ids.server_name(ids.server_label("maze", "bob"), 1)}
    page = alice.get()
    assert "The study is full right now" in page
    state = json.loads(alice.get(accept="application/json"))
    assert (state["state"], state["reason"], state["again"], state["attempt"]) == ("failed", "full", True, 1)
    assert platform.bus.sent == []  # a moment ago there was no room

    platform.wait(seconds=31)
    alice.get()  # they come back
    assert platform.bus.sent.pop() == (Topic.START, {"projectId": "maze", "userId": "alice"})
    alice.answer(page, **{"hippodrome-action": "restart"})  # or press the button
    assert platform.bus.sent.pop(0) == (Topic.START, {"projectId": "maze", "userId": "alice"})
    assert start_and_run(platform, "alice") == ""
    Servers(platform).stop([StopServer("maze", "bob")])
    assert start_and_run(platform, "alice")
    assert record(platform).attempt == 1
    assert list(server_slots(platform).slots) == [ids.server_label("maze", "alice")]


def test_a_lost_server_keeps_its_slot_for_the_next_attempt() -> None:
    platform = installed(study(max_servers=1, max_server_hours=2))
    task = start_and_run(platform, "alice")
    platform.wait(minutes=10)
    Servers(platform).tasks_changed([lost_event(platform, task)])
    assert server_slots(platform) == ServerSlots({record(platform).label: ServerSlot(1)}, 600)
    assert start_and_run(platform, "bob") == ""
    Servers(platform).start(StartServer("maze", "alice", 2))
    assert record(platform).state is ServerState.STARTING
    assert server_slots(platform) == ServerSlots({record(platform).label: ServerSlot(2, 1800)}, 600)


def test_the_sweep_gives_back_a_slot_that_no_next_attempt_takes() -> None:
    platform = installed(study(max_servers=1))
    Servers(platform).tasks_changed([lost_event(platform, start_and_run(platform, "alice"))])
    assert Sweep(platform).run().slots == 0
    platform.wait(minutes=11)
    assert Sweep(platform).run().slots == 1
    assert start_and_run(platform, "bob")
    assert Sweep(platform).run().slots == 0


def test_the_sweep_frees_a_slot_only_if_its_server_is_known_to_be_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    platform = installed(study(max_servers=3))
    start_and_run(platform, "alice")
    platform.wait(minutes=11)
    get = platform.documents.get

    def broken(key: str, known: Any = None) -> Any:
        if key.startswith("_servers/"):
            raise ConnectionError
        return get(key, known)

    platform.documents.get = broken  # type: ignore[method-assign]
    assert Sweep(platform).run().slots == 0
    platform.documents.get = get  # type: ignore[method-assign]
    assert Sweep(platform).run().slots == 0
    platform.documents.delete(server.key(ids.server_label("maze", "alice")))  # erased
    assert Sweep(platform).run().slots == 1
    assert server_slots(platform) == ServerSlots(used=1800)  # the time that it used is not known
    platform.documents.put("_slots/other.json", b"what is this")
    Sweep(platform).run()


def test_no_server_starts_when_the_hours_are_used_up() -> None:
    platform = installed(study(max_server_hours=1))
    for user in ("alice", "bob"):
        assert start_and_run(platform, user)
    assert start_and_run(platform, "carol") == ""  # two servers reserve all of the hour
    platform.wait(minutes=20)
    Servers(platform).stop([StopServer("maze", "alice"), StopServer("maze", "bob")])
    assert server_slots(platform) == ServerSlots(used=2400)
    assert start_and_run(platform, "carol") == ""  # 20 minutes are left, and a server reserves 30
    assert start_and_run(platform, "dave") == ""
    assert server_slots(platform).slots == {}


def test_a_server_that_aws_refuses_uses_no_hours() -> None:
    platform = installed(study(max_server_hours=1))
    platform.tasks.fail = [Refused("no such task definition")]
    assert start_and_run(platform, "alice") == ""
    assert server_slots(platform) == ServerSlots()
    platform.tasks.fail = [NoCapacity(), NoCapacity()]
    assert start_and_run(platform, "bob") == ""
    assert server_slots(platform) == ServerSlots({ids.server_label("maze", "bob"): ServerSlot(1)})


def test_a_slot_is_given_back_once_and_before_the_record_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    platform = installed(study(max_server_hours=1))
    start_and_run(platform, "alice")
    platform.wait(minutes=5)
    stop = StopServer("maze", "alice")
    platform.documents.before_write = [lambda: None, _crash]
    assert Servers(platform).stop([stop]) == [stop]
    assert not record(platform).is_closed
    platform.wait(minutes=5)
    assert Servers(platform).stop([stop]) == []
    assert record(platform).is_closed
    assert server_slots(platform) == ServerSlots(used=300)
    monkeypatch.setattr("hippodrome.control.storage.compare_and_swap.TRIES", 0)
    with pytest.raises(RetryLater):
        Slots(platform).acquire(study(max_servers=1), claimed(study(max_servers=1), "bob"))


def test_a_lost_server_whose_slot_is_not_freed_stays_open_until_the_next_sweep_frees_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    platform = installed(study(max_servers=1))
    platform.tasks.running.pop(start_and_run(platform, "alice"))
    platform.wait(minutes=11)
    with monkeypatch.context() as patch:
        patch.setattr("hippodrome.control.storage.compare_and_swap.TRIES", 0)
        Sweep(platform).run()
    assert not record(platform).is_closed
    Sweep(platform).run()
    assert record(platform).is_closed


def test_the_slots_of_many_servers_are_given_back_with_one_write() -> None:
    platform = installed(study(max_servers=20))
    for user in USERS[:20]:
        assert start_and_run(platform, user)
    assert start_and_run(platform, USERS[20]) == ""
    before = dict(platform.documents.kept)
    writes: list[str] = []
    replace = platform.documents.replace
    platform.documents.replace = lambda key, body, etag: writes.append(key) or replace(key, body, etag)  # type: ignore
    Servers(platform).stop([StopServer("maze", user) for user in USERS[:20]])
    assert writes.count("_slots/maze.json") == 1
    assert set(platform.documents.kept) == set(before)
    assert server_slots(platform).slots == {}


ENDED = server.close(claimed(study(), "alice"), Reason.LOST, FakePlatform().clock + timedelta(seconds=200))


@pytest.mark.parametrize(
    ("known", "counted"),
    [
        (ENDED, 200),
        (msgspec.structs.replace(ENDED, attempt=2), 30 * 60),
        (msgspec.structs.replace(ENDED, reason=None), 30 * 60),
        (claimed(study(), "alice"), 30 * 60),
        (None, 30 * 60),
    ],
)
def test_a_forgotten_slot_counts_the_time_of_its_attempt_or_all_that_it_reserved_if_that_is_unknown(
    known: Server | None, counted: int
) -> None:
    project = study(max_server_hours=10, max_runtime=30)
    platform = installed(project)
    assert Slots(platform).acquire(project, claimed(project, "alice"))
    Slots(platform).release_forgotten("maze", {ENDED.name: known, "the-name-of-no-server": None})
    assert server_slots(platform) == ServerSlots(used=counted)


def test_without_limits_no_document_of_slots_is_read_or_written() -> None:
    platform = installed()
    touched: list[str] = []
    for name in ("get", "create", "replace", "list"):
        act = getattr(platform.documents, name)
        setattr(platform.documents, name, lambda key, *rest, act=act: touched.append(key) or act(key, *rest))
    alice = Browser(platform)
    to_game(alice)
    Servers(platform).tasks_changed([lost_event(platform, start_and_run(platform, "alice"))])
    Servers(platform).start(StartServer("maze", "alice", 2))
    Servers(platform).stop([StopServer("maze", "alice")])
    Sweep(platform).run()
    assert not [key for key in touched if "slots" in key]


# At the same time


def at_once(acts: list[Callable[[], bool]]) -> list[bool]:
    """Return what each function returns; all of them run at the same time, each in a thread."""
    with ThreadPoolExecutor(len(acts)) as pool:
        return [each.result() for each in [pool.submit(act) for act in acts]]


@pytest.fixture(params=["S3", "folder"])
def documents(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Documents]:
    if request.param == "folder":
        yield FolderDocuments(tmp_path / "data", tmp_path / "state")
        return
    with MotoWorld() as world:
        yield world.platform.documents


def test_a_crowd_gets_exactly_as_many_slots_as_there_are(documents: Documents) -> None:
    platform: Any = SimpleNamespace(documents=documents, now=FakePlatform().now)
    project = study(max_participants=11, max_servers=7, max_server_hours=5)
    crowd = [lambda user=user: Slots(platform).admit(project, user) for user in USERS[:24]]
    assert sum(at_once(crowd)) == 11
    assert sum(at_once(crowd)) == 11  # the same ones
    records = [claimed(project, user) for user in USERS[:16]]
    assert sum(at_once([lambda r=r: Slots(platform).acquire(project, r) for r in records])) == 7
    # While they leave, others come: every place is taken again, until the hours are used up.
    held = from_json(documents.get("_slots/maze.json").body, ServerSlots).slots  # type: ignore[union-attr]
    leaving = [r for r in records if r.label in held]
    acts: list[Callable[[], bool]] = [lambda r=r: _leave(platform, r) for r in leaving]
    at_once([*acts, *[lambda r=r: Slots(platform).acquire(project, r) for r in records if r not in leaving]])
    after = from_json(documents.get("_slots/maze.json").body, ServerSlots)  # type: ignore[union-attr]
    assert len(after.slots) <= 7
    assert after.used == 7 * limits.MIN_BILLED_SECONDS
    assert not set(after.slots) & {r.label for r in leaving}


def _leave(platform: Any, record: Server) -> bool:
    from hippodrome.control.limits.slots import Release

    Slots(platform).release("maze", [Release(record, Reason.STOPPED)])
    return True


def test_after_a_conflict_the_document_is_read_and_decided_again() -> None:
    platform = installed()
    project = study(max_servers=1)

    def other_function_writes() -> None:
        platform.documents.kept["_slots/maze.json"] = (b'{"slots": {"sother": {"attempt": 1}}}', '"x"', platform.clock)

    platform.documents.before_write = [other_function_writes]
    assert not Slots(platform).acquire(project, claimed(project, "alice"))
    with pytest.raises(Conflict):
        platform.documents.create("_slots/maze.json", b"")


@pytest.mark.parametrize("seed", [1, 2])
def test_a_crowd_that_is_larger_than_the_limits_never_exceeds_them(seed: int) -> None:
    """There are never more tasks than maxServers nor more hours than the limit; each participant is served or told why not."""
    level = logger.log_level
    logger.setLevel(logging.CRITICAL)
    project = msgspec.structs.replace(SIMULATED, max_participants=50, max_servers=8, max_server_hours=9)
    world = SimulatedWorld(seed, project=project)
    tasks, most = world.platform.tasks, 0
    run = tasks.run

    def counted(request: Any) -> str:
        nonlocal most
        arn = run(request)
        most = max(most, sum(1 for _ in tasks.living()))
        return arn

    tasks.run = counted  # type: ignore[method-assign]
    arrived = [SimulatedParticipant(world, number) for number in range(70)]
    for person in arrived:
        world.clock.spawn(person.walk, delay=world.clock.random.uniform(0, 240))
    world.run(2 * 3600)
    logger.setLevel(level)
    kept = world.platform.documents.kept
    visits = [person.visit for person in arrived]
    assert sum(key.endswith("participant.json") for key in kept) == 50
    assert sum(visit.reason.startswith("This study is full") for visit in visits) == 20
    told = {visit.reason.partition(".")[0] for visit in visits if visit.finished is None}
    assert told == {"This study is full", "failed: full"}
    assert most == 8
    assert sum(visit.finished is not None for visit in visits) >= 8
    assert not any(world.left().values()), world.left()
    total = from_json(kept["_slots/study.json"][0], ServerSlots)
    assert total.slots == {}
    assert 0 < total.used <= 9 * 3600
    ran = sum((task.closed or 0) - task.born for task in tasks.tasks.values())
    assert total.used == pytest.approx(ran, rel=0.25)


def test_an_attempt_of_unknown_use_counts_in_full_when_the_next_attempt_takes_its_slot() -> None:
    project = study(max_server_hours=1, max_runtime=15)
    first, second = claimed(project, "alice"), claimed(project, "alice", 2)
    now = ServerSlots().with_server(project, first)
    assert now is not None
    assert (now.used, now.slots[first.label]) == (0, ServerSlot(1, 15 * 60))
    after = now.with_server(project, second)
    assert after is not None
    assert (after.used, after.slots[first.label]) == (15 * 60, ServerSlot(2, 15 * 60))
