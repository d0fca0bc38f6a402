"""The servers of sessions: a session owns its server's record in the participant's place."""

from __future__ import annotations

import json
from datetime import timedelta
from typing import Any
from urllib.parse import urlencode

import msgspec
import pytest

from hippodrome.control.limits import rules as limits
from hippodrome.control.limits.rules import ServerSlots
from hippodrome.control.model import ids, messages, server, sessions
from hippodrome.control.model.messages import KeepWarm, StartServer, StopServer, StopUser
from hippodrome.control.model.project import MASTER_LIST, MasterList, Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.ports import Settings, Topic
from hippodrome.control.servers.sweep import Sweep
from hippodrome.control.storage.secret import SecretCache
from hippodrome.functions import installed as place
from hippodrome.functions import send_start_server_message, send_stop_server_message
from hippodrome.protocol import handover
from hippodrome.protocol.handover import Handover
from hippodrome.protocol.keys import answer_key, handovers_folder, membership_key, session_key
from hippodrome.protocol.session import Member, SessionDocument, member_token
from testing.aws_events import JSON, http_event
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import SECRET, installed, study
from tests.control.servers.delivery import deliver, events

SESSION = "s." + "0" * 19 + "1"
OTHER = "s." + "0" * 19 + "2"
LABEL = ids.server_label("maze", SESSION)
START, STOP = StartServer("maze", SESSION), StopServer("maze", SESSION)
MEMBERS = ("alice", "bob")


def pairs(**changes: object) -> Project:
    return study(**{"players": 2, "max_runtime": 60, **changes})


@pytest.fixture
def platform() -> FakePlatform:
    return installed(pairs())


@pytest.fixture
def servers(platform: FakePlatform) -> Servers:
    return Servers(platform)


def form(platform: FakePlatform, session: str = SESSION, users: tuple[str, ...] = MEMBERS) -> None:
    """What the lobby writes when a session is formed."""
    members = tuple(Member(user, None, seat) for seat, user in enumerate(users))
    platform.documents.put(session_key("maze", session), SessionDocument(session, 2, members).to_json())
    for seat, user in enumerate(users):
        seated = {"session": session, "seat": seat, "unmatched": False}
        platform.documents.put(membership_key("maze", user), json.dumps(seated).encode())


def start_formed(platform: FakePlatform, servers: Servers) -> None:
    """Form the session, and handle its start message."""
    form(platform)
    servers.start(START)


def sweep(platform: FakePlatform, servers: Servers) -> None:
    """Sweep, and deliver all that follows."""
    Sweep(platform).run()
    deliver(platform, servers)


def answer(platform: FakePlatform, user: str, *steps: str) -> None:
    platform.documents.put(f"maze/users/{user}/participant.json", b"{}")
    for step in steps:
        platform.documents.put(answer_key("maze", user, step), b"{}")


def record(platform: FakePlatform, session: str = SESSION) -> Server:
    return from_json(platform.documents.kept[server.key(ids.server_label("maze", session))][0], Server)


def runs(platform: FakePlatform, servers: Servers) -> None:
    """Let all started tasks run, get their names, and become ready."""
    servers.tasks_changed(events(platform, "RUNNING"))
    for _, message in platform.bus.delayed:
        changed = messages.parse_dns_changed(json.loads(json.dumps(message)))
        assert changed
        servers.dns_changed(changed)
    platform.bus.delayed.clear()


def lose(platform: FakePlatform, servers: Servers) -> None:
    """Spot takes every server back."""
    lost = events(platform, "STOPPED", stop_code="SpotInterruption")
    platform.tasks.running.clear()
    assert servers.tasks_changed(lost) == []


def nothing_left(platform: FakePlatform) -> bool:
    return not (platform.tasks.running or platform.dns.records or platform.timers.due)


# Start


def test_a_session_gets_one_server_of_its_own(platform: FakePlatform, servers: Servers) -> None:
    for _ in range(3):
        servers.start(START)
    (request,) = platform.tasks.running.values()
    assert request.name == f"{LABEL}-1"
    assert record(platform).is_of_session
    assert platform.timers.due[f"{LABEL}-1"][1] == {
        "projectId": "maze", "userId": SESSION, "attempt": 1, "reason": "deadline",
    }  # fmt: skip


def test_a_sessions_server_gets_the_session_and_no_participant(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    (request,) = platform.tasks.running.values()
    env = request.environment
    assert env["SESSION"] == SESSION
    assert env.keys().isdisjoint({"USER_ID", "GROUP", "WARM_SERVER"})
    assert env["DEADLINE"] == str(int(record(platform).deadline.timestamp()))


def test_servers_of_a_project_without_sessions_get_none() -> None:
    platform = installed()
    Servers(platform).start(StartServer("maze", "alice"))
    (request,) = platform.tasks.running.values()
    assert "SESSION" not in request.environment


@pytest.mark.parametrize(("limit", "waits", "lives"), [
    (24 * 60, 30, 90), (90, 30, 90), (75, 15, 75), (65, 10, 65), (60, 10, 60), (45, 10, 45),
])  # fmt: skip
def test_the_deadline_of_a_sessions_server_includes_the_wait_for_its_members(
    limit: int, waits: int, lives: int
) -> None:
    platform = installed(pairs())
    platform.settings = Settings(root_domain="example.org", max_runtime=limit)
    Servers(platform).start(START)
    assert record(platform).deadline - platform.now() == timedelta(minutes=lives)
    assert sessions.open_for(pairs(), platform.settings) == timedelta(minutes=waits)


def test_a_session_holds_one_slot(platform: FakePlatform) -> None:
    platform = installed(pairs(max_servers=1))
    servers = Servers(platform)
    servers.start(START)
    servers.start(StartServer("maze", OTHER))
    assert record(platform, OTHER).reason is Reason.FULL
    servers.stop([STOP])
    assert from_json(platform.documents.kept[limits.server_slots_key("maze")][0], ServerSlots).names == []
    servers.start(StartServer("maze", OTHER))
    assert record(platform, OTHER).state is ServerState.STARTING


def test_a_start_message_of_a_participant_starts_no_server_of_their_own(
    platform: FakePlatform, servers: Servers
) -> None:
    for _ in range(2):
        servers.start(StartServer("maze", "alice"))
    assert platform.tasks.running == {}
    assert server.key(ids.server_label("maze", "alice")) not in platform.documents.kept


def test_no_sessions_server_starts_in_a_project_that_has_no_sessions_any_more(platform: FakePlatform) -> None:
    servers = Servers(platform)
    servers.start(START)
    platform.documents.keep(MASTER_LIST, to_json(MasterList([study()])))
    platform.wait(seconds=11)
    servers.start(StartServer("maze", OTHER))
    assert [request.name for request in platform.tasks.running.values()] == [f"{LABEL}-1"]
    servers.start(START)
    deliver(platform, servers)
    assert nothing_left(platform)


def test_a_message_with_a_malformed_session_id_is_dropped() -> None:
    for forged in ("s.", "s.xyz", "s." + "0" * 19, "s." + "0" * 21, "s." + "A" * 20, SESSION + "/..", " " + SESSION):
        body = {"projectId": "maze", "userId": forged}
        assert messages.parse_start_server(body) is None, forged
        assert messages.parse_stop_server(body) is None, forged


# Warm servers


def test_a_warm_server_is_handed_over_to_a_session() -> None:
    platform = installed(pairs(warm_servers=1, version="v1"))
    servers = Servers(platform)
    servers.start(KeepWarm("maze"))
    ((_, first),) = platform.bus.sent
    platform.bus.sent.clear()
    start = messages.parse_start_server(json.loads(json.dumps(first)))
    assert start
    servers.start(start)
    runs(platform, servers)
    servers.start(START)
    assert record(platform).state is ServerState.READY
    (key,) = (key for key in platform.documents.kept if key.startswith(handovers_folder("maze")))
    assert handover.parse(platform.documents.kept[key][0]) == Handover(SESSION, None, f"{LABEL}-1")
    assert (record(platform).deadline - platform.now()) == timedelta(minutes=90)


def test_a_session_has_its_whole_time_on_a_warm_server_that_was_taken_at_the_last_moment() -> None:
    platform = installed(pairs(warm_servers=1, version="v1"))
    platform.settings = Settings(root_domain="example.org", max_runtime=150)
    servers = Servers(platform)
    servers.start(KeepWarm("maze"))
    deliver(platform, servers)
    (warm,) = open_sessions(platform)
    (request,) = platform.tasks.running.values()
    ends = int(request.environment["DEADLINE"])
    platform.clock = warm.deadline - timedelta(seconds=1)
    servers.start(START)
    assert record(platform).warm_server_name == warm.name
    assert ends >= int(record(platform).deadline.timestamp())
    assert ends <= int((warm.requested + timedelta(minutes=150)).timestamp()), "the installation's limit"


# Replacement


def test_a_lost_server_is_replaced_for_all_members(platform: FakePlatform, servers: Servers) -> None:
    start_formed(platform, servers)
    runs(platform, servers)
    lose(platform, servers)
    assert platform.bus.sent == [(Topic.START, {"projectId": "maze", "userId": SESSION, "attempt": 2})]
    servers.start(StartServer("maze", SESSION, 2))
    (request,) = platform.tasks.running.values()
    assert request.environment["SESSION"] == SESSION


@pytest.mark.parametrize(("played", "replaced"), [((), True), (("alice",), True), (MEMBERS, False)])
def test_a_sessions_server_is_replaced_until_all_members_have_finished_their_games(
    platform: FakePlatform, servers: Servers, played: tuple[str, ...], replaced: bool
) -> None:
    start_formed(platform, servers)
    for user in MEMBERS:
        answer(platform, user, "1", "2", *(["3"] if user in played else []))
    lose(platform, servers)
    assert bool(platform.bus.sent) == replaced


def test_a_server_that_was_started_ahead_is_replaced_too(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    lose(platform, servers)
    assert platform.bus.sent == [(Topic.START, {"projectId": "maze", "userId": SESSION, "attempt": 2})]


def test_the_game_of_an_erased_member_is_no_reason_to_replace_the_server(
    platform: FakePlatform, servers: Servers
) -> None:
    form(platform)
    one = SessionDocument(SESSION, 2, (Member("", None, 0), Member("bob", None, 1)))
    platform.documents.put(session_key("maze", SESSION), one.to_json())
    servers.start(START)
    answer(platform, "bob", "1", "2", "3")
    lose(platform, servers)
    assert platform.bus.sent == []


# Stop


def test_a_sessions_server_is_stopped_by_its_id(platform: FakePlatform, servers: Servers) -> None:
    start_formed(platform, servers)
    runs(platform, servers)
    assert servers.stop([STOP]) == []
    assert record(platform).reason is Reason.STOPPED
    assert nothing_left(platform)


def test_a_stop_that_overtakes_the_start_leaves_no_server(platform: FakePlatform, servers: Servers) -> None:
    assert servers.stop([STOP]) == []
    servers.start(START)
    assert nothing_left(platform)


@pytest.mark.parametrize("first", MEMBERS)
def test_a_sessions_server_is_stopped_when_the_last_member_reaches_the_stop_step(
    platform: FakePlatform, servers: Servers, first: str
) -> None:
    """The stop message of the last member comes before their answer is stored."""
    last = next(user for user in MEMBERS if user != first)
    start_formed(platform, servers)
    runs(platform, servers)
    answer(platform, first, "1", "2", "3")
    answer(platform, last, "1", "2")
    assert servers.stop([StopServer("maze", first)]) == []
    assert record(platform).state is ServerState.READY
    assert servers.stop([StopServer("maze", last)]) == []
    assert record(platform).reason is Reason.STOPPED
    assert nothing_left(platform)


def test_the_stop_messages_of_both_members_in_one_batch_stop_the_server_once(platform: FakePlatform) -> None:
    platform = installed(pairs(max_servers=3, max_server_hours=10))
    servers = Servers(platform)
    start_formed(platform, servers)
    servers.start(StartServer("maze", OTHER))
    runs(platform, servers)
    platform.wait(minutes=10)
    for user in MEMBERS:
        answer(platform, user, "1", "2", "3")
    assert servers.stop([StopServer("maze", user) for user in MEMBERS]) == []
    assert record(platform).reason is Reason.STOPPED
    slots = from_json(platform.documents.kept[limits.server_slots_key("maze")][0], ServerSlots)
    assert [*slots.names] == [f"{ids.server_label('maze', OTHER)}-1"]
    assert slots.used == 10 * 60


def test_a_members_stop_message_leaves_no_record_of_their_own(platform: FakePlatform, servers: Servers) -> None:
    """There is no record of a stopped server for a member, nor for a participant who was never matched."""
    form(platform)
    before = {key for key in platform.documents.kept if key.startswith(server.RECORDS)}
    for user in ("alice", "carol"):
        assert servers.stop([StopServer("maze", user)]) == []
    assert {key for key in platform.documents.kept if key.startswith(server.RECORDS)} == before


def test_a_stop_in_all_projects_ends_no_session_that_another_member_plays(
    platform: FakePlatform, servers: Servers
) -> None:
    start_formed(platform, servers)
    answer(platform, "alice", "1", "2", "3")
    answer(platform, "bob", "1", "2")
    assert servers.stop([StopUser("alice")]) == []
    assert record(platform).state is ServerState.STARTING
    assert servers.stop([StopUser("bob")]) == []
    assert record(platform).reason is Reason.STOPPED


def test_a_server_from_before_the_project_had_sessions_is_stopped_as_usual() -> None:
    platform = installed(study())
    Servers(platform).start(StartServer("maze", "alice"))
    platform.documents.put(MASTER_LIST, to_json(MasterList([pairs()])))
    assert Servers(platform).stop([StopServer("maze", "alice")]) == []
    assert nothing_left(platform)


# The relays


@pytest.fixture
def relays(platform: FakePlatform) -> Any:
    place.use(platform)
    return platform


def ask(function: Any, user: str, **body: object) -> int:
    query = urlencode({"projectId": "maze", "userId": user})
    event = http_event("POST", query, json.dumps(body), "/relay", {"content-type": JSON, "accept": JSON})
    return int(function.handler(event, None)["statusCode"])


def proof(user: str) -> dict[str, str]:
    return {"hippodrome-step": "1", "hippodrome-ticket": ids.ticket(SECRET, user, "1")}


def test_a_member_cannot_stop_the_server_of_the_others(relays: FakePlatform, servers: Servers) -> None:
    form(relays)
    servers.start(START)
    for user in MEMBERS:
        answer(relays, user, "1", "2")
    assert ask(send_stop_server_message, "alice", **proof("alice")) == 202
    ((topic, message),) = relays.bus.sent
    stop = messages.parse_stop_server(json.loads(json.dumps(message)))
    assert (topic, stop) == (Topic.STOP, StopServer("maze", "alice"))
    assert stop
    assert servers.stop([stop]) == []
    assert record(relays).state is ServerState.STARTING


def test_each_member_has_their_own_token(relays: FakePlatform, servers: Servers) -> None:
    form(relays)
    servers.start(START)
    for user in MEMBERS:
        answer(relays, user, "1", "2")
    token = SecretCache(relays.documents).token(record(relays))
    for stolen in (token, member_token(token, "bob"), member_token("", "alice")):
        assert ask(send_stop_server_message, "alice", token=stolen) == 403
    assert ask(send_stop_server_message, "alice", token=member_token(token, "alice")) == 202


def test_the_relays_do_not_take_a_sessions_id_for_a_participant(relays: FakePlatform, servers: Servers) -> None:
    form(relays)
    servers.start(START)
    token = SecretCache(relays.documents).token(record(relays))
    for function in (send_start_server_message, send_stop_server_message):
        assert ask(function, SESSION, token=token, **proof(SESSION)) == 400
    assert relays.bus.sent == []


def test_a_members_delayed_stop_does_not_replace_another_members(relays: FakePlatform, servers: Servers) -> None:
    form(relays)
    servers.start(START)
    for user in MEMBERS:
        assert ask(send_stop_server_message, user, **proof(user), delay=90) == 202
    delayed = {str(message["userId"]) for name, (_, message) in relays.timers.due.items() if name.endswith("-delay")}
    assert delayed == set(MEMBERS)


def test_a_member_asks_for_the_next_server_of_their_session(relays: FakePlatform, servers: Servers) -> None:
    form(relays)
    answer(relays, "alice", "1", "2")
    servers.start(START)
    closed = server.close(msgspec.structs.replace(record(relays), attempt=3), Reason.LOST, relays.now())
    relays.documents.put(server.key(LABEL), to_json(closed))
    assert ask(send_start_server_message, "alice", **proof("alice")) == 202
    assert relays.bus.sent == [(Topic.START, {"projectId": "maze", "userId": SESSION, "attempt": 4})]


def test_a_participant_in_the_lobby_may_leave_it_by_the_relay(relays: FakePlatform) -> None:
    answer(relays, "carol", "1", "2")
    assert ask(send_stop_server_message, "carol", **proof("carol")) == 202
    assert relays.bus.sent == [(Topic.STOP, {"projectId": "maze", "userId": "carol"})]


# The sweep


def test_the_sweep_stops_a_server_that_no_lobby_lists_and_no_formed_session_has(
    platform: FakePlatform, servers: Servers
) -> None:
    """It was started ahead and is not needed, a forged or late message started it, or the lobby's document was lost."""
    servers.start(START)
    runs(platform, servers)
    swept = Sweep(platform).run()
    assert (swept.sessions, swept.failed) == (1, 0)
    deliver_stops(platform, servers)
    assert record(platform).reason is Reason.STOPPED
    assert nothing_left(platform)


@pytest.mark.parametrize("body", [b"", b"{", b"[]", b'{"open": 3}'])
def test_the_sweep_stops_a_server_that_no_session_has_if_the_lobbys_document_cannot_be_read(
    platform: FakePlatform, servers: Servers, body: bytes
) -> None:
    servers.start(START)
    platform.documents.put("_lobbies/maze.json", body)
    for _ in range(2):
        Sweep(platform).run()
        deliver_stops(platform, servers)
    assert record(platform).reason is Reason.STOPPED


def test_the_sweep_does_not_stop_the_server_of_a_formed_session(platform: FakePlatform, servers: Servers) -> None:
    start_formed(platform, servers)
    runs(platform, servers)
    for user in MEMBERS:
        answer(platform, user, "1", "2")
    assert Sweep(platform).run().sessions == 0
    assert platform.bus.sent == []


def test_the_sweep_does_not_stop_a_formed_session_if_its_document_or_project_cannot_be_read(
    platform: FakePlatform, servers: Servers
) -> None:
    start_formed(platform, servers)
    platform.documents.put(session_key("maze", SESSION), b"{")
    swept = Sweep(platform).run()
    assert (swept.sessions, swept.failed) == (0, 1)
    form(platform)
    platform.documents.put(MASTER_LIST, to_json(MasterList([])))
    assert Sweep(platform).run().sessions == 0
    assert platform.bus.sent == []


def test_the_sweep_stops_a_server_whose_members_have_all_left(platform: FakePlatform, servers: Servers) -> None:
    """Their stop messages came at once: each was handled before the other's answer was stored."""
    start_formed(platform, servers)
    for user in MEMBERS:
        answer(platform, user, "1", "2")
        servers.stop([StopServer("maze", user)])
    for user in MEMBERS:
        answer(platform, user, "3")
    assert record(platform).state is ServerState.STARTING
    assert Sweep(platform).run().sessions == 1
    deliver_stops(platform, servers)
    assert record(platform).reason is Reason.STOPPED


@pytest.mark.parametrize("listed", [[pairs(live=False)], []], ids=["closed", "gone"])
def test_the_sweep_stops_an_unneeded_server_even_if_its_project_is_closed_or_gone(
    platform: FakePlatform, servers: Servers, listed: list[Project]
) -> None:
    servers.start(START)
    platform.documents.put(MASTER_LIST, to_json(MasterList(list(listed))))
    assert Sweep(platform).run().sessions == 1
    deliver_stops(platform, servers)
    assert record(platform).reason is Reason.STOPPED


def test_the_sweep_stops_no_server_if_the_lobby_cannot_be_repaired(
    platform: FakePlatform, servers: Servers, monkeypatch: pytest.MonkeyPatch
) -> None:
    servers.start(START)
    sweep = Sweep(platform)
    monkeypatch.setattr(sweep._lobby, "repair", lambda project: (_ for _ in ()).throw(ConnectionError()))
    swept = sweep.run()
    assert (swept.sessions, swept.failed) == (0, 1)
    assert platform.bus.sent == []


def deliver_stops(platform: FakePlatform, servers: Servers) -> None:
    sent, platform.bus.sent = platform.bus.sent, []
    stops = [messages.parse_stop_server(json.loads(json.dumps(m))) for topic, m in sent if topic is Topic.STOP]
    assert servers.stop([stop for stop in stops if stop]) == []


# Servers ahead and the lobby


def open_sessions(platform: FakePlatform) -> list[Server]:
    found = [from_json(kept[0], Server) for key, kept in platform.documents.kept.items() if key.startswith("_servers/")]
    return [one for one in found if not one.is_closed]


@pytest.mark.parametrize(("people", "wanted"), [(1, 1), (2, 1), (3, 2), (4, 2), (5, 3)])
def test_one_server_is_started_ahead_for_every_two_participants_who_are_under_way(
    platform: FakePlatform, servers: Servers, people: int, wanted: int
) -> None:
    for _ in range(2):
        for number in range(people):
            servers.start(StartServer("maze", f"user{number}"))
        deliver(platform, servers)
    found = open_sessions(platform)
    assert len(found) == wanted
    assert all(one.is_of_session and one.state is ServerState.READY for one in found)
    assert Sweep(platform).run().sessions == 0


def test_servers_ahead_are_stopped_when_their_participants_leave(platform: FakePlatform, servers: Servers) -> None:
    for user in ("alice", "bob", "carol"):
        servers.start(StartServer("maze", user))
    deliver(platform, servers)
    assert servers.stop([StopServer("maze", "carol")]) == []
    sweep(platform, servers)
    assert len(open_sessions(platform)) == 1
    assert servers.stop([StopUser("alice"), StopUser("bob")]) == []
    sweep(platform, servers)
    assert open_sessions(platform) == []
    assert nothing_left(platform)


def test_nothing_is_left_when_participants_who_are_under_way_never_arrive(
    platform: FakePlatform, servers: Servers
) -> None:
    servers.start(StartServer("maze", "alice"))
    deliver(platform, servers)
    started = set()
    for _ in range(24):  # two hours
        platform.wait(minutes=5)
        sweep(platform, servers)
        started |= {one.name for one in open_sessions(platform)}
        assert len(open_sessions(platform)) <= 1
    assert nothing_left(platform)
    assert len(started) <= 3, "a server is kept for half an hour, as long as the participant may come"
    assert [key for key in platform.documents.kept if key.startswith("_lobby/")] == []


def test_nothing_is_left_when_the_lobbys_document_is_lost(platform: FakePlatform, servers: Servers) -> None:
    servers.start(StartServer("maze", "alice"))
    deliver(platform, servers)
    platform.documents.delete("_lobbies/maze.json")
    sweep(platform, servers)
    assert len(open_sessions(platform)) == 1, "another one for who is under way"
    servers.stop([StopServer("maze", "alice")])
    sweep(platform, servers)
    assert nothing_left(platform)


def test_a_project_that_is_closed_keeps_no_server_ahead(platform: FakePlatform, servers: Servers) -> None:
    servers.start(StartServer("maze", "alice"))
    deliver(platform, servers)
    platform.documents.keep(MASTER_LIST, to_json(MasterList([pairs(live=False)])))
    platform.wait(seconds=60)
    for _ in range(2):
        sweep(platform, servers)
    assert nothing_left(platform)
    assert json.loads(platform.documents.kept["_lobbies/maze.json"][0]).get("open", []) == []


def test_a_project_that_is_gone_keeps_no_server_ahead(platform: FakePlatform, servers: Servers) -> None:
    servers.start(StartServer("maze", "alice"))
    deliver(platform, servers)
    platform.documents.keep(MASTER_LIST, to_json(MasterList([study(max_runtime=60)])))
    platform.wait(seconds=60)
    sweep(platform, servers)
    assert nothing_left(platform)


def test_a_start_message_that_comes_an_hour_late_leaves_no_server(platform: FakePlatform, servers: Servers) -> None:
    """The messages are of a participant who has played, of an unmatched one, and of a session that is over."""
    start_formed(platform, servers)
    runs(platform, servers)
    for user in MEMBERS:
        answer(platform, user, "1", "2", "3")
    servers.stop([StopServer("maze", user) for user in MEMBERS])
    unmatched = {"session": None, "seat": 0, "unmatched": True}
    platform.documents.keep(membership_key("maze", "carol"), json.dumps(unmatched).encode())
    platform.wait(hours=1)
    for user in (*MEMBERS, "carol", SESSION):
        servers.start(StartServer("maze", user))
    deliver(platform, servers)
    assert nothing_left(platform)
    assert not any(key.startswith("_lobby/") for key in platform.documents.kept)


# Another number of players is registered


THREE = {"players": 3, "trial": {"game": "three"}, "version": "v3", "task_definition": "three:1", "server_port": 5000}
TWO = {"trial": {"game": "two"}, "version": "v2", "task_definition": "two:1", "server_port": 443}


def register_as_well(platform: FakePlatform, project: Project) -> None:
    """Register the study again, as `registry.register` enters it; functions see it ten seconds later."""
    before = from_json(platform.documents.kept[MASTER_LIST][0], MasterList).find("maze")
    assert before
    platform.documents.keep(MASTER_LIST, to_json(MasterList([project.following(before)])))
    platform.wait(seconds=11)


def task(platform: FakePlatform) -> tuple[str, str | None, int]:
    """Return what the only task runs: the game of its trial, its task definition, and its port."""
    (request,) = platform.tasks.running.values()
    return json.loads(request.environment["TRIAL"])["game"], request.definition, request.port


@pytest.mark.parametrize("formed", [True, False], ids=["formed", "not formed yet"])
def test_a_lost_server_is_replaced_for_the_sessions_own_number_of_players(formed: bool) -> None:
    platform = installed(pairs(**TWO))
    servers = Servers(platform)
    if formed:
        form(platform)
    servers.start(StartServer("maze", SESSION, players=2))
    runs(platform, servers)
    register_as_well(platform, pairs(**THREE))
    register_as_well(platform, pairs(**{**THREE, "players": 4}))
    lose(platform, servers)
    deliver(platform, servers)
    assert task(platform) == ("two", "two:1", 443)
    assert (record(platform).attempt, record(platform).players) == (2, 2)


def test_the_last_registration_for_a_number_of_players_counts() -> None:
    platform = installed(pairs(**TWO))
    servers = Servers(platform)
    servers.start(StartServer("maze", SESSION, players=2))
    register_as_well(platform, pairs(**THREE))
    register_as_well(platform, pairs(**{**TWO, "trial": {"game": "two, mended"}}))
    lose(platform, servers)
    deliver(platform, servers)
    assert task(platform)[0] == "two, mended"


def test_a_late_first_start_message_starts_a_server_for_its_own_number_of_players() -> None:
    platform = installed(pairs(**TWO))
    servers = Servers(platform)
    register_as_well(platform, pairs(**THREE))
    servers.start(StartServer("maze", SESSION, players=2))
    assert task(platform)[0] == "two"


def test_a_function_with_an_old_registration_reads_the_new_one_for_a_session_of_its_number() -> None:
    platform = installed(pairs(**TWO))
    servers = Servers(platform)
    servers.start(StartServer("maze", OTHER, players=2))
    platform.tasks.running.clear()
    project = pairs(**THREE).following(pairs(**TWO))
    platform.documents.keep(MASTER_LIST, to_json(MasterList([project])))
    servers.start(StartServer("maze", SESSION, players=3))
    assert task(platform)[0] == "three"


def test_a_session_of_another_number_gets_no_warm_server() -> None:
    """Warm servers run the present registration."""
    platform = installed(pairs(**TWO))
    servers = Servers(platform)
    servers.start(StartServer("maze", SESSION, players=2))
    runs(platform, servers)
    lose(platform, servers)
    register_as_well(platform, pairs(**{**THREE, "warm_servers": 1}))
    platform.bus.sent.clear()
    servers.start(KeepWarm("maze"))
    deliver(platform, servers)
    runs(platform, servers)
    (warm,) = open_sessions(platform)
    servers.start(StartServer("maze", SESSION, 2))
    assert record(platform).warm_server_name is None
    assert record(platform).port == 443
    servers.start(StartServer("maze", OTHER, players=3))
    assert record(platform, OTHER).warm_server_name == warm.name


def test_a_participant_who_plays_alone_gets_the_next_own_server_when_several_players_are_registered() -> None:
    platform = installed(study(trial={"game": "alone"}))
    servers = Servers(platform)
    servers.start(StartServer("maze", "alice"))
    runs(platform, servers)
    project = pairs(**TWO).following(study(trial={"game": "alone"}))
    platform.documents.keep(MASTER_LIST, to_json(MasterList([project])))
    platform.wait(seconds=11)
    lose(platform, servers)
    deliver(platform, servers)
    assert task(platform)[0] == "alone"
    servers.start(StartServer("maze", "bob"))
    assert [each.label for each in open_sessions(platform)], "whoever comes now is on the way to a game of two"


def test_a_participant_who_plays_alone_gets_the_present_registration_for_one_player() -> None:
    platform = installed(study(trial={"game": "alone"}))
    servers = Servers(platform)
    servers.start(StartServer("maze", "alice"))
    register_as_well(platform, study(trial={"game": "alone, mended"}))
    lose(platform, servers)
    deliver(platform, servers)
    assert task(platform)[0] == "alone, mended"


def alone(user: str = "alice") -> tuple[FakePlatform, Servers]:
    """A participant plays alone, and two players are registered then."""
    platform = installed(study(trial={"game": "alone"}))
    servers = Servers(platform)
    servers.start(StartServer("maze", user))
    runs(platform, servers)
    register_as_well(platform, pairs(**TWO))
    return platform, servers


def test_a_repeated_start_message_while_the_next_own_server_is_asked_for_leads_to_no_lobby() -> None:
    platform, servers = alone()
    lose(platform, servers)
    servers.start(StartServer("maze", "alice"))
    deliver(platform, servers)
    assert task(platform)[0] == "alone"


def test_a_participant_whose_own_server_was_stopped_is_on_the_way_to_a_game_of_two() -> None:
    platform, servers = alone()
    assert servers.stop([StopServer("maze", "alice")]) == []
    servers.start(StartServer("maze", "alice", 2))
    deliver(platform, servers)
    assert task(platform)[0] == "two"


def test_a_member_gets_no_next_server_of_their_own() -> None:
    platform, servers = alone()
    form(platform)
    lose(platform, servers)
    deliver(platform, servers)
    assert platform.tasks.running == {}


@pytest.mark.parametrize("stop", [StopServer("maze", "alice"), StopUser("alice")], ids=["theirs", "everywhere"])
def test_a_members_stop_message_reaches_the_session_even_after_an_own_server(stop: Any) -> None:
    platform, servers = alone()
    assert servers.stop([StopServer("maze", "alice")]) == []
    form(platform)
    servers.start(StartServer("maze", SESSION, players=2))
    answer(platform, "bob", "1", "2", "3", "4")
    assert servers.stop([StopServer("maze", "alice", 1)]) == []
    assert record(platform).state is ServerState.STARTING, "that was their own server's"
    assert servers.stop([stop]) == []
    assert record(platform).is_closed
    assert nothing_left(platform)


def test_a_participant_in_the_lobby_may_leave_it_by_the_relay_even_after_an_own_server() -> None:
    platform, servers = alone()
    assert servers.stop([StopServer("maze", "alice")]) == []
    answer(platform, "alice", "1", "2")
    platform.bus.sent.clear()
    place.use(platform)
    try:
        assert ask(send_stop_server_message, "alice", **proof("alice")) == 202
    finally:
        place.use(None)
    assert platform.bus.sent == [(Topic.STOP, {"projectId": "maze", "userId": "alice"})]


def test_a_function_with_a_registration_for_one_player_reads_the_new_one_for_a_session() -> None:
    platform = installed(study())
    servers = Servers(platform)
    servers.start(StartServer("maze", "bob"))
    platform.tasks.running.clear()
    project = pairs(**TWO).following(study())
    platform.documents.keep(MASTER_LIST, to_json(MasterList([project])))
    servers.start(StartServer("maze", SESSION, players=2))
    assert task(platform)[0] == "two"
