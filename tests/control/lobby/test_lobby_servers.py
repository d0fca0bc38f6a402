"""Servers that a lobby starts ahead, and which session gets which."""

from __future__ import annotations

import pytest

from hippodrome.control.lobby.lobby import NoServerYet
from hippodrome.control.model import server, sessions
from hippodrome.control.model.records import to_json
from tests.control.lobby.waiting_room import WaitingRoom, pairs


def test_a_server_is_started_for_every_two_participants_who_are_under_way(room: WaitingRoom) -> None:
    room.arrive_at_start("ann", "bob", "cem")
    assert len(room.started()) == 2
    assert {each.id for each in room.document().open} == set(room.started())


def test_a_pair_gets_the_server_that_was_started_first(room: WaitingRoom) -> None:
    room.arrive_at_start("ann")
    room.wait(30)
    room.arrive_at_start("bob", "cem")
    first = room.started()[0]
    room.poll("ann", "bob", seconds=4)
    assert room.session("ann").id == first
    assert room.started().count(first) == 1


def test_a_pair_gets_a_ready_server_even_if_another_was_started_first(room: WaitingRoom) -> None:
    room.arrive_at_start("ann")
    room.wait(30)
    room.arrive_at_start("bob", "cem")
    first, second = room.started()
    room.serve(first, state=server.ServerState.NAMING)
    room.poll("ann", "bob", seconds=4)
    assert room.session("ann").id == second
    assert [each.id for each in room.document().open] == [first]


def test_a_pair_without_a_ready_server_is_formed_and_gets_the_first_server_that_is_ready(room: WaitingRoom) -> None:
    room.arrive_at_start("ann", "bob", ready=False)
    room.wait(1)
    room.arrive_at_start("cem", ready=False)
    first, second = room.started()
    room.serve(first, second, state=server.ServerState.STARTING)
    told = room.poll("ann", "bob", seconds=4)
    assert told["ann"] == NoServerYet(first, 2, room.repository.server_of("maze", first), 2)
    assert (room.membership("ann"), room.stored(f"sessions/{first}/session.json")) == (None, None)
    assert [name for name in room.entries() if not name.endswith(".way")] == [], "they need no entries any more"
    room.serve(second)
    room.poll("ann", "bob")
    assert room.together("ann", "bob")
    assert room.session("ann").id == second


def test_the_pair_that_was_formed_first_gets_the_server_that_is_ready_first(room: WaitingRoom) -> None:
    """The server of the second pair becomes ready. A member of that pair asks, and the first pair gets the server."""
    room.arrive_at_start("ann", "bob", ready=False)
    room.wait(1)
    room.arrive_at_start("cem", "dan", ready=False)
    first, second = room.started()
    room.serve(first, second, state=server.ServerState.STARTING)
    room.poll("ann", "bob", seconds=4)
    room.poll("cem", "dan", seconds=4)
    room.serve(second)
    assert isinstance(room.visit("dan"), NoServerYet)
    assert room.together("ann", "bob")
    assert room.session("ann").id == second
    room.serve(first)
    room.poll("cem", "dan")
    assert room.together("cem", "dan")
    assert room.session("cem").id == first
    assert room.started() == [first, second], "no server more is started"


def test_a_pair_whose_only_server_has_ended_keeps_it(room: WaitingRoom) -> None:
    room.arrive_at_start("ann", "bob", ready=False)
    [first] = room.started()
    room.serve(first, state=server.ServerState.CLOSED, reason=server.Reason.REFUSED)
    room.poll("ann", "bob", seconds=4)
    assert room.session("ann").id == first


@pytest.mark.parametrize("which", [0, 1], ids=["first", "second"])
def test_a_pair_whose_server_has_ended_waits_for_another_that_starts(room: WaitingRoom, which: int) -> None:
    for users in (("ann", "bob"), ("cem", "dan"), ("eve",)):
        room.arrive_at_start(*users, ready=False)
        room.wait(1)
    servers = room.started()
    room.serve(*servers, state=server.ServerState.STARTING)
    room.serve(servers[which], state=server.ServerState.CLOSED, reason=server.Reason.FULL)
    room.poll("ann", "bob", seconds=4)
    room.poll("cem", "dan", seconds=4)
    told = room.poll("ann", "bob", "cem", "dan")
    assert all(isinstance(one, NoServerYet) for one in told.values())
    others = [each for each in servers if each != servers[which]]
    room.serve(*others)
    room.poll("ann", "bob", "cem", "dan")
    assert {room.session("ann").id, room.session("cem").id} == set(others)


def test_a_pair_whose_server_has_ended_gets_a_ready_one_however_many_others_have_ended(room: WaitingRoom) -> None:
    for number in range(8):
        room.arrive_at_start(f"ann{number}", f"bob{number}", ready=False)
        room.wait(1)
    *ended, last = room.started()
    room.serve(*ended, state=server.ServerState.CLOSED, reason=server.Reason.FULL)
    room.serve(last)
    room.poll("ann0", "bob0", seconds=4)
    assert room.session("ann0").id == last


def test_a_group_gets_no_server_that_was_started_for_another_number_of_players(room: WaitingRoom) -> None:
    room.arrive_at_start("ann", "bob")
    [before] = room.started()
    room.project = pairs(players=3)
    room.poll("ann", "bob", "cem", seconds=4)
    assert room.together("ann", "bob", "cem")
    assert room.session("ann").id != before
    room.lobby.repair(room.project)
    assert room.stopped() == [before]


def test_a_group_that_was_proposed_before_the_number_of_players_changed_is_not_formed(room: WaitingRoom) -> None:
    room.poll("ann", "bob")
    room.project = pairs(players=3)
    room.wait(2)
    room.poll("ann", "bob", seconds=4)
    assert room.stored("users/ann/session.json") is None
    room.poll("ann", "bob", "cem", seconds=4)
    assert room.together("ann", "bob", "cem")


def test_a_pair_that_waits_for_its_server_stays_a_pair_when_the_number_of_players_changes(room: WaitingRoom) -> None:
    room.arrive_at_start("ann", "bob", ready=False)
    room.serve(*room.started(), state=server.ServerState.STARTING)
    room.poll("ann", "bob", seconds=4)
    room.project = pairs(players=3)
    room.serve(*room.started())
    room.poll("ann", "bob")
    assert room.together("ann", "bob")
    assert room.session("ann").players == 2, "as its server was told"


def test_a_pair_whose_server_is_lost_and_replaced_waits_for_it(room: WaitingRoom) -> None:
    room.arrive_at_start("ann", "bob", ready=False)
    [first] = room.started()
    room.serve(first, state=server.ServerState.CLOSED, reason=server.Reason.LOST)
    told = room.poll("ann", "bob", seconds=4)
    assert isinstance(told["ann"], NoServerYet)


def test_after_five_minutes_a_pair_keeps_its_server(room: WaitingRoom) -> None:
    room.arrive_at_start("ann", "bob", ready=False)
    [first] = room.started()
    room.serve(first, state=server.ServerState.STARTING)
    room.poll("ann", "bob", seconds=298)
    assert room.membership("ann") is None
    room.poll("ann", "bob", seconds=6)
    assert room.session("ann").id == first


def test_the_sweep_gives_ready_servers_to_pairs_that_do_not_ask_any_more(room: WaitingRoom) -> None:
    room.arrive_at_start("ann", "bob", ready=False)
    [first] = room.started()
    room.serve(first, state=server.ServerState.STARTING)
    room.poll("ann", "bob", seconds=4)
    room.serve(first)
    room.lobby.repair(room.project)
    assert room.together("ann", "bob")


def test_a_late_start_message_writes_no_entry_for_a_participant_who_waits_for_a_server(room: WaitingRoom) -> None:
    room.arrive_at_start("ann", "bob", ready=False)
    room.serve(*room.started(), state=server.ServerState.STARTING)
    room.poll("ann", "bob", seconds=4)
    room.arrive_at_start("ann", ready=False)
    assert room.entries() == []


def test_the_start_message_of_a_server_without_a_record_is_sent_again_once_when_the_session_is_formed(
    room: WaitingRoom,
) -> None:
    room.arrive_at_start("ann", "bob", ready=False)
    room.platform.bus.sent.clear()  # the message was lost
    room.poll("ann", "bob", seconds=4)
    assert room.started() == [each.id for each in room.document().formed]
    room.poll("ann", "bob", seconds=4)
    assert len(room.started()) == 1, "once"


def test_a_repeated_start_message_starts_no_second_server(room: WaitingRoom) -> None:
    for _ in range(3):
        room.arrive_at_start("ann")
        room.wait(5)
    assert len(set(room.started())) == 1
    assert len(room.document().open) == 1


def test_a_start_message_that_comes_an_hour_late_changes_nothing(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=4)
    room.wait(3600)
    before = (dict(room.platform.documents.kept), list(room.platform.bus.sent))
    room.arrive_at_start("ann", "bob", ready=False)
    assert (room.platform.documents.kept, room.platform.bus.sent) == before


def test_servers_ahead_never_exceed_max_servers() -> None:
    """Otherwise each sweep would start all servers again that found no slot."""
    room = WaitingRoom(pairs(max_servers=3))
    for number in range(40):
        room.arrive_at_start(f"p{number}", ready=False)
    first = room.started()
    assert len(set(first)) == len(room.document().open) == 3
    room.serve(*first, state=server.ServerState.CLOSED, reason=server.Reason.FULL, closed=room.platform.now())
    room.wait(300)
    room.lobby.repair(room.project)
    assert len(set(room.started())) == 6


def test_a_participant_who_has_played_is_not_under_way(room: WaitingRoom) -> None:
    room.platform.documents.put("maze/users/ann/answers/3.json", b"{}")
    room.arrive_at_start("ann")
    assert room.entries() == []
    assert room.started() == []


def test_the_start_message_of_a_participant_in_the_lobby_changes_nothing(room: WaitingRoom) -> None:
    room.visit("ann")
    before = room.entries()
    room.arrive_at_start("ann")
    assert room.entries() == before


def test_an_unmatched_participant_is_not_under_way(room: WaitingRoom) -> None:
    room.poll("ann", seconds=60)
    room.arrive_at_start("ann")
    assert room.started() == []


def test_the_sweep_stops_servers_that_are_not_needed(room: WaitingRoom) -> None:
    for user in ("ann", "bob", "cem", "dan", "eve"):
        room.arrive_at_start(user)
        room.wait(1)
    assert len(room.document().open) == 3
    for user in ("cem", "dan", "eve"):
        room.lobby.forget(room.project, user)
    listed = room.lobby.repair(room.project)
    assert len(room.document().open) == 1
    assert set(listed) == {room.started()[0]}
    assert sorted(room.stopped()) == sorted(set(room.started()) - set(listed))


def test_the_sweep_replaces_a_server_that_waited_too_long(room: WaitingRoom) -> None:
    room.arrive_at_start("ann")
    [first] = room.started()
    room.wait(sessions.open_for(room.project, room.platform.settings).total_seconds() - 1)
    room.arrive_at_start("bob")
    assert room.lobby.repair(room.project) == {first}
    room.wait(1)
    [second] = room.lobby.repair(room.project)
    assert second != first
    assert room.stopped() == [first]
    assert room.started()[-1] == second


def test_a_pair_does_not_get_a_server_that_waited_too_long(room: WaitingRoom) -> None:
    room.arrive_at_start("ann")
    [first] = room.started()
    room.wait(sessions.open_for(room.project, room.platform.settings).total_seconds())
    room.poll("ann", "bob", seconds=4)
    assert room.session("ann").id != first


@pytest.mark.parametrize("max_runtime", [5, 60, 1440])
def test_a_participant_who_never_arrives_costs_one_server(max_runtime: int) -> None:
    room = WaitingRoom(pairs(max_runtime=max_runtime))
    room.arrive_at_start("ann")
    for _ in range(12 * 25):  # a sweep every five minutes, for longer than any game
        room.wait(300)
        room.lobby.repair(room.project)
        put_record(room, room.started()[0])
    assert len(set(room.started())) == 1
    assert room.stopped() == room.started()[:1]
    assert room.entries() == []
    assert room.document().open == ()


def test_the_server_of_a_participant_who_never_arrives_is_stopped_when_it_can_no_longer_be_used(
    room: WaitingRoom,
) -> None:
    room.arrive_at_start("ann")
    room.wait(sessions.open_for(room.project, room.platform.settings).total_seconds())
    assert list(room.lobby.repair(room.project)) == []
    assert room.stopped() == room.started()[:1]


def test_the_sweep_sends_the_start_message_of_an_open_server_without_a_record_again(room: WaitingRoom) -> None:
    room.arrive_at_start("ann", ready=False)
    room.platform.bus.sent.clear()
    room.wait(170)
    room.lobby.repair(room.project)
    assert room.started() == []
    room.wait(11)
    assert room.started() == []
    assert list(room.lobby.repair(room.project)) == room.started()


def test_the_sweep_replaces_an_open_server_that_has_ended(room: WaitingRoom) -> None:
    room.arrive_at_start("ann")
    [first] = room.started()
    put_record(room, first, closed=True)
    room.wait(181)
    assert first not in room.lobby.repair(room.project)
    assert len(room.document().open) == 1


def put_record(room: WaitingRoom, session_id: str, *, closed: bool = False) -> None:
    """Write the record of the session's server as `start_server` does."""
    platform = room.platform
    made = server.new_attempt(room.project, session_id, 1, settings=platform.settings, now=platform.now())
    if closed:
        made = server.close(made, server.Reason.REFUSED, platform.now())
    platform.documents.put(server.key(made.label), to_json(made))
