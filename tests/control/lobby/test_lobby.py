"""What the lobby promises its participants, on a platform in memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import timedelta
from typing import Any

import pytest

from hippodrome.control.lobby import decisions, rules
from hippodrome.control.lobby import entries as folder
from hippodrome.control.lobby.decisions import Decisions, OpenSession
from hippodrome.control.lobby.lobby import LobbyState
from hippodrome.control.model import ids, sessions
from hippodrome.control.model.records import to_json
from hippodrome.control.model.sessions import Membership
from hippodrome.control.ports import Entry, Topic
from hippodrome.protocol.keys import membership_key
from testing.port_faults import PortFault
from tests.control.lobby.interleaved import Crossing
from tests.control.lobby.waiting_room import WaitingRoom, pairs, waits

# Matched


def test_two_participants_in_the_lobby_play_together(room: WaitingRoom) -> None:
    assert room.visit("ann") == LobbyState(1, 0.0, proposed=False)
    room.wait(1)
    assert room.visit("bob") == LobbyState(2, 0.0, proposed=True)
    room.poll("ann", "bob", seconds=2)
    assert room.together("ann", "bob")
    assert room.entries() == [f"{room.session('ann').id}.done"]
    assert room.started() == [room.session("ann").id]


def test_a_finished_session_leaves_the_document_with_the_next_write_and_its_mark_is_deleted(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=4)
    assert room.document().labels() == {room.label("ann"), room.label("bob")}
    room.poll("cem", "dan")
    assert room.document().labels() == {room.label("cem"), room.label("dan")}
    assert not [name for name in room.entries() if name.endswith(".done")]


def test_the_sweep_removes_finished_sessions_from_the_document(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=4)
    room.poll("cem", seconds=60)
    room.lobby.repair(room.project)
    assert room.document().labels() == frozenset()
    assert room.entries() == []


def test_seats_are_drawn_by_lot_and_do_not_follow_from_who_came_first() -> None:
    room = WaitingRoom()
    for number in range(60):
        room.visit(f"early{number}")
        room.wait(1)
        room.poll(f"late{number}", f"early{number}", seconds=4)
    memberships = [room.membership(f"early{number}") for number in range(60)]
    assert 12 < sum(one.seat for one in memberships if one) < 48  # chance exceeds this in about one of 10 million runs


def test_with_seats_by_group_each_member_has_the_seat_of_their_group() -> None:
    users = [f"u{n}" for n in range(20)]
    groups = {user: n % 3 % 2 for n, user in enumerate(users)}
    room = WaitingRoom(pairs(matching="mixed", seats="group"), groups=groups)
    room.poll(*users, seconds=6)
    seats = {user: membership.seat for user in users if (membership := room.membership(user)) is not None}
    assert len(seats) >= 10
    assert seats == {user: groups[user] for user in seats}


def test_a_membership_holds_the_time_for_which_the_participant_waited(room: WaitingRoom) -> None:
    room.visit("zoe")
    room.wait(1)
    room.poll("ann", "zoe", seconds=4)
    zoe, ann = room.membership("zoe"), room.membership("ann")
    assert zoe is not None
    assert ann is not None
    assert zoe.waited == pytest.approx((ann.waited or 0.0) + 1)


def test_an_unmatched_participants_membership_holds_their_patience_as_the_time_waited(room: WaitingRoom) -> None:
    room.poll("ann", seconds=room.project.patience + 4)
    membership = room.membership("ann")
    assert membership is not None
    assert membership.waited == pytest.approx(room.project.patience, abs=2.1)


@pytest.mark.parametrize("players", [2, 3, 5, 16])
def test_a_session_never_has_more_members_than_players(players: int) -> None:
    room = WaitingRoom(pairs(players=players))
    users = [f"u{n}" for n in range(2 * players + 1)]
    told = room.poll(*users, seconds=6)
    memberships = [one for one in told.values() if isinstance(one, Membership)]
    assert len(memberships) == 2 * players
    for session_id in {one.session for one in memberships}:
        assert sorted(one.seat for one in memberships if one.session == session_id) == list(range(players))
    assert waits(told[users[-1]]).here == 1


@pytest.mark.parametrize("count", [200, pytest.param(1000, marks=pytest.mark.hunt)])
def test_hundreds_of_participants_who_come_at_once_are_all_matched(count: int) -> None:
    """Each participant's request lists all others, so the time grows with the square of their number."""
    room = WaitingRoom()
    users = [f"u{n}" for n in range(count)]
    told = room.poll(*users, seconds=6)
    by_session: dict[str | None, list[str]] = {}
    for user, membership in told.items():
        assert isinstance(membership, Membership), user
        by_session.setdefault(membership.session, []).append(user)
    assert len(by_session) == count // 2
    assert {len(users) for users in by_session.values()} == {2}


@pytest.mark.parametrize(
    ("matching", "groups", "answers", "together"),
    [
        ("group", {"a": 0, "b": 1, "c": 0, "d": 1}, {}, [{"a", "c"}, {"b", "d"}]),
        ("mixed", {"a": 0, "b": 0, "c": 1, "d": 1}, {}, [{"a", "c"}, {"b", "d"}]),
        (
            {"same": "language"},
            {},
            {"a": {"language": "German"}, "b": {"language": "Urdu"}, "c": {"language": " german"}, "d": {"language": "urdu"}},
            [{"a", "c"}, {"b", "d"}],
        ),
        (
            {"different": "role"},
            {},
            {"a": {"role": "guide"}, "b": {"role": "guide"}, "c": {"role": "guest"}, "d": {}},
            [{"a", "c"}, {"b", "d"}],
        ),
    ],
)  # fmt: skip
def test_matching_decides_who_plays_with_whom(
    matching: Any, groups: dict[str, int], answers: dict[str, Mapping[str, Any]], together: list[set[str]]
) -> None:
    room = WaitingRoom(pairs(matching=matching), groups=groups, answers=answers)
    for user in "abcd":
        room.visit(user)
        room.wait(0.1)
    room.poll(*"abcd", seconds=6)
    assert [{m.user_id for m in room.session(user).members} for user in ("a", "b")] == together


def test_participants_of_another_group_are_not_counted_as_there() -> None:
    room = WaitingRoom(pairs(matching="group"), groups={"ann": 0, "bob": 1})
    told = room.poll("ann", "bob", seconds=10)
    assert [waits(state).here for state in told.values()] == [1, 1]


def test_the_number_of_participants_who_are_there_includes_all_members_of_a_formed_session(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=4)
    document, entries = room.document(), room.lobby._store.entries(room.project)
    assert [each.id for each in document.formed] == [room.session("ann").id]
    assert rules.number_here(document, entries, room.project, room.label("ann"), room.platform.now()) == 2


def test_the_researchers_function_may_choose_the_groups() -> None:
    """The rules propose the groups that the function has chosen, and no others."""
    project = pairs(matching="match")
    room = WaitingRoom(project)
    room.poll("ann", "bob", "cem", seconds=4)
    assert room.document().proposed == ()
    entries = room.lobby._store.entries(project)
    labels = {user: room.label(user) for user in ("ann", "bob", "cem")}
    wished = [[labels["ann"], labels["cem"]], [labels["bob"], labels["cem"]], [labels["bob"]]]
    now, open_for = room.platform.now(), sessions.open_for(project, room.platform.settings)
    decided = rules.decide(Decisions(), entries, project, now, ids.new_session_id, open_for=open_for, chosen=wished)
    assert [set(each.labels) for each in decided.proposed] == [{labels["ann"], labels["cem"]}]


# Participants who do not ask any more


def test_a_participant_who_has_not_asked_since_the_proposal_is_not_matched(room: WaitingRoom) -> None:
    room.visit("ann")
    room.wait(2)
    room.visit("bob")  # and closes the browser, which sends no message
    told = room.poll("ann", seconds=8)
    assert waits(told["ann"]).proposed
    assert room.membership("ann") is None
    told = room.poll("ann", seconds=6)
    assert not waits(told["ann"]).proposed
    assert waits(told["ann"]).here == 1


def test_the_request_that_proposes_confirms_nothing(room: WaitingRoom) -> None:
    room.visit("ann")
    room.visit("bob")
    assert [name for name in room.entries() if ".yes." in name] == []


def test_a_confirmation_counts_for_one_proposal_even_if_the_next_has_the_same_server(room: WaitingRoom) -> None:
    """Ann confirms to be with Bob, who leaves; she is proposed again, with Cem and the same server, and asks no more."""
    room.arrive_at_start("ann", "bob")
    room.poll("ann", "bob")
    room.wait(1)
    room.visit("ann")  # confirms
    room.lobby.leave(room.project, "bob")
    room.wait(1)
    room.visit("ann")
    room.visit("cem")  # proposes the two
    [proposal] = room.document().proposed
    assert set(proposal.labels) == {room.label("ann"), room.label("cem")}
    room.wait(1)
    room.visit("cem")
    assert room.membership("cem") is None
    room.visit("ann")
    assert room.together("ann", "cem")
    assert room.session("ann").id == room.started()[0]


def test_a_participant_who_asked_last_ten_seconds_ago_is_not_there(room: WaitingRoom) -> None:
    room.visit("ann")
    room.wait(10)
    assert waits(room.visit("bob")).here == 1
    assert not waits(room.visit("bob")).proposed


@pytest.mark.parametrize("ahead", [-6, -2, 2, 6, 60])
def test_participants_are_matched_even_if_the_clock_of_s3_is_wrong(
    room: WaitingRoom, ahead: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LastModified is of S3's clock, and is compared with the function's (docs/unproven.md)."""
    listed = room.platform.documents.list

    def elsewhere(prefix: str) -> Iterator[Entry]:
        off = timedelta(seconds=ahead)
        return (entry._replace(modified=entry.modified + off) for entry in list(listed(prefix)))

    monkeypatch.setattr(room.platform.documents, "list", elsewhere)
    room.poll("ann", seconds=10)
    room.poll("ann", "bob", seconds=6)
    assert room.together("ann", "bob")


def test_a_member_is_not_matched_again_when_a_request_of_a_second_tab_is_late() -> None:
    crossing = Crossing()
    late = crossing.visit("ann")
    while not crossing.platform.made or not crossing.platform.made[-1].startswith("list"):
        crossing.advance(late)  # it has read that nobody is there, and will write ann's entry
    for user in ("ann", "bob", "ann", "bob", "ann"):
        crossing.platform.wait(seconds=1)
        crossing.finish(crossing.visit(user))
    assert {m["userId"] for m in next(iter(crossing.sessions().values()))["members"]} == {"ann", "bob"}
    crossing.finish(late)
    for _ in range(20):
        crossing.platform.wait(seconds=1)
        for user in ("cem", "dan"):
            crossing.finish(crossing.visit(user))
    assert crossing.wrong(["ann", "bob", "cem", "dan"], at_rest=True) == []
    assert {m["userId"] for m in crossing.sessions()[crossing.membership("cem")["session"]]["members"]} == {
        "cem",
        "dan",
    }


def test_a_member_whose_late_request_wrote_an_entry_is_in_no_second_session(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=4)
    first = room.session("ann")
    room.lobby.repair(room.project)  # the document does not hold her any more
    one = folder.Waiting(room.label("ann"), folder.milliseconds(room.platform.now()), "-", room.platform.now())
    room.platform.documents.put(folder.waiting_key("maze", one), folder.body(folder.WaitingDocument("ann")))
    room.visit("cem")
    [proposal] = room.document().proposed
    room.platform.documents.put(folder.confirmation_key("maze", room.label("ann"), proposal.id), b"")
    told = room.poll("cem", seconds=4)
    assert isinstance(told["cem"], LobbyState)
    assert room.session("ann") == first
    assert room.membership("cem") is None


# Leaving, coming back


def test_a_participant_who_closes_the_page_has_left_at_once(room: WaitingRoom) -> None:
    room.visit("ann")
    room.lobby.leave(room.project, "ann")
    assert waits(room.visit("bob")).here == 1
    assert not waits(room.visit("bob")).proposed


def test_a_proposal_falls_apart_at_once_when_a_member_leaves(room: WaitingRoom) -> None:
    room.poll("ann", "bob", "cem")
    assert set(room.document().proposed[0].labels) == {room.label("ann"), room.label("bob")}
    room.lobby.leave(room.project, "bob")
    room.wait(1)
    room.poll("ann", "cem", seconds=4)
    assert room.together("ann", "cem")


def test_a_reload_keeps_the_time_at_which_the_participant_came(room: WaitingRoom) -> None:
    room.poll("ann", seconds=20)
    room.lobby.leave(room.project, "ann")
    room.wait(1)
    assert waits(room.visit("ann")).seconds == 21


def test_the_leave_message_of_a_reload_may_come_after_the_new_page(room: WaitingRoom) -> None:
    room.poll("ann", seconds=20)
    room.visit("ann")
    room.lobby.leave(room.project, "ann")
    room.wait(2)
    assert waits(room.visit("ann")).seconds == 22
    assert waits(room.visit("bob")).here == 2


def test_a_participant_with_two_tabs_may_close_one(room: WaitingRoom) -> None:
    room.poll("ann", "ann", seconds=10)
    room.lobby.leave(room.project, "ann")
    told = room.poll("ann", "bob", seconds=6)
    assert room.together("ann", "bob"), told


def test_a_participant_who_comes_back_after_more_than_ten_seconds_begins_to_wait_anew(room: WaitingRoom) -> None:
    room.poll("ann", seconds=20)
    room.lobby.leave(room.project, "ann")
    room.wait(11)
    assert waits(room.visit("ann")).seconds == 0


def test_a_participant_who_did_not_ask_for_half_a_minute_begins_to_wait_anew(room: WaitingRoom) -> None:
    room.poll("ann", seconds=10)
    room.wait(29)
    assert waits(room.visit("ann")).seconds == 39
    room.wait(31)
    assert waits(room.visit("ann")).seconds == 0


def test_a_lobby_that_all_have_left_is_empty_after_two_sweeps(room: WaitingRoom) -> None:
    users = [f"u{n}" for n in range(7)]
    room.poll(*users)
    for user in users:
        room.lobby.leave(room.project, user)
    room.wait(61)
    room.lobby.repair(room.project)
    room.wait(61)
    room.lobby.repair(room.project)
    assert room.entries() == []
    assert room.document().labels() == frozenset()
    assert room.document().open == ()
    assert [room.membership(user) for user in users] == [None] * 7


def test_a_leave_message_changes_nothing_for_a_participant_outside_the_lobby(room: WaitingRoom) -> None:
    room.arrive_at_start("ann")
    before = dict(room.platform.documents.kept)
    for user in ("ann", "nobody"):
        room.lobby.leave(room.project, user)
    assert room.platform.documents.kept == before


# One participant, several pages


def test_two_tabs_are_one_participant(room: WaitingRoom) -> None:
    told = room.poll("ann", "ann", "ann", seconds=20)
    assert waits(told["ann"]).here == 1
    assert len(room.entries()) == 1


def test_two_tabs_that_open_at_once_are_one_participant() -> None:
    crossing = Crossing()
    tabs = [crossing.visit("ann"), crossing.visit("ann")]
    while tabs[0].calls < 3 or tabs[1].calls < 3:
        for tab in tabs:
            crossing.advance(tab)
        crossing.platform.wait(seconds=0.01)
    for tab in tabs:
        crossing.finish(tab)
    crossing.platform.wait(seconds=2)
    told = crossing.finish(crossing.visit("ann")).result
    assert (told.here, told.proposed) == (1, False)
    assert len([key for key in crossing.platform.documents.kept if key.startswith("_lobby/")]) == 1


def test_a_participant_with_two_pages_is_in_one_session(room: WaitingRoom) -> None:
    """A request to the lobby names no step: so pages at two game steps are the same to it as two tabs."""
    room.poll("ann", "ann", "bob", seconds=6)
    assert room.together("ann", "bob")
    assert room.visit("ann") == room.membership("ann")


def test_a_member_who_asks_again_gets_the_same_membership(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=4)
    before = dict(room.platform.documents.kept)
    for _ in range(3):
        room.poll("ann", "bob", "ann", seconds=4)
        room.wait(3600)
    assert room.platform.documents.kept == before


# Patience


def test_patience_ends_at_the_exact_second(room: WaitingRoom) -> None:
    told = room.poll("ann", seconds=58)
    assert waits(told["ann"]).seconds == 58
    room.wait(2)
    told = room.poll("ann")
    assert isinstance(told["ann"], Membership)
    assert told["ann"].unmatched
    assert room.stored("users/ann/answers/3.json")["answers"] == {"outcome": "unmatched"}
    assert room.entries() == [f"{room.label('ann')}.done"]


def test_a_participant_is_not_matched_after_the_end_of_patience_however_late_the_page_asks(room: WaitingRoom) -> None:
    room.poll("ann", seconds=58)
    room.wait(3)  # the patience of ann is over; her page has not asked since
    told = room.poll("bob", seconds=4)
    assert waits(told["bob"]).here == 1
    told = room.poll("ann", "bob")
    assert told["ann"] == room.membership("ann")
    assert isinstance(told["bob"], LobbyState)


def test_a_proposal_made_in_time_holds_beyond_the_end_of_patience(room: WaitingRoom) -> None:
    room.poll("ann", seconds=58)
    room.wait(1)
    room.visit("bob")
    room.wait(1.5)
    room.poll("ann", "bob", seconds=2)
    assert room.together("ann", "bob")


def test_all_game_steps_of_an_unmatched_participant_have_an_answer() -> None:
    steps = [*pairs().steps[:4], pairs().steps[2].__class__("5", "game"), pairs().steps[4]]
    room = WaitingRoom(pairs(steps=steps, patience=10))
    room.poll("ann", seconds=10)
    assert [room.stored(f"users/ann/answers/{step}.json")["answers"] for step in ("3", "5")] == [
        {"outcome": "unmatched"}
    ] * 2


def test_a_lost_answer_of_an_unmatched_participant_is_written_when_they_ask_again(room: WaitingRoom) -> None:
    room.poll("ann", seconds=60)
    room.platform.documents.delete("maze/users/ann/answers/3.json")
    room.visit("ann")
    assert room.stored("users/ann/answers/3.json")["answers"] == {"outcome": "unmatched"}


def test_a_participant_alone_in_the_lobby_is_unmatched_after_an_hour_of_patience() -> None:
    room = WaitingRoom(pairs(patience=3600))
    told = room.poll("ann", seconds=3598)
    assert waits(told["ann"]) == LobbyState(1, 3598.0, proposed=False)
    room.wait(2)
    room.visit("ann")
    membership = room.membership("ann")
    assert membership is not None
    assert membership.unmatched


@pytest.mark.parametrize("there", [1, 2, 3])
def test_with_policies_the_participants_who_are_there_play_together(there: int) -> None:
    room = WaitingRoom(pairs(players=4, after_patience="policies", patience=20))
    users = ["ann", "bob", "cem"][:there]
    room.visit("ann")
    room.wait(1)
    told = room.poll(*users, seconds=24)
    assert room.together(*users), told
    assert room.session("ann").players == 4


# Hostile and faulty clients


def test_a_page_that_asks_a_hundred_times_a_second_writes_once_a_second(room: WaitingRoom) -> None:
    room.visit("ann")
    room.platform.documents.calls.clear()
    for _ in range(500):
        room.wait(0.01)
        room.visit("ann")
    assert 4 <= room.platform.documents.calls.count("put") <= 5


def test_a_page_that_asks_often_confirms_a_proposal_with_one_write(room: WaitingRoom) -> None:
    room.poll("ann", "bob")
    room.platform.documents.calls.clear()
    for _ in range(500):
        room.wait(0.01)
        room.visit("ann")
    assert room.platform.documents.calls.count("put") == 1


@pytest.mark.parametrize("name", ["x", "..", "sxx.1.-", "s" + "a" * 20 + ".way.way", "s" + "a" * 20 + ".yes.s.0", ""])
def test_strange_entries_in_the_folder_are_ignored(room: WaitingRoom, name: str) -> None:
    room.platform.documents.put(folder.folder("maze") + name, b"[")
    room.poll("ann", "bob", seconds=4)
    assert room.together("ann", "bob")


@pytest.mark.parametrize("body", [b"", b"{", b"[]", b'{"userId": 7}', b'{"userId": "../../x"}', b'{"userId": "bob"}'])
def test_an_entry_without_a_readable_document_is_matched_with_no_participant(room: WaitingRoom, body: bytes) -> None:
    label = room.label("ghost")
    one = folder.Waiting(label, folder.milliseconds(room.platform.now()), "-", room.platform.now())
    room.platform.documents.put(folder.waiting_key("maze", one), body)
    room.visit("ann")
    [proposal] = room.document().proposed
    room.platform.documents.put(folder.confirmation_key("maze", label, proposal.id), b"")
    room.poll("ann", "cem", seconds=20)
    assert room.together("ann", "cem")


@pytest.mark.parametrize("body", [b"", b"{", b"[]", b'{"proposed": 7}', b"[" * 100_000])
def test_a_document_that_cannot_be_read_is_made_anew(body: bytes) -> None:
    room = WaitingRoom(pairs(patience=300))
    room.visit("ann")
    room.platform.documents.put(decisions.key("maze"), body)
    room.poll("ann", "bob", seconds=6)
    assert room.document().proposed == (), "a session may be half written, of which the document says nothing any more"
    room.poll("ann", "bob", seconds=52)
    room.lobby.repair(room.project)
    assert room.document().renewed is not None, "not yet: a request that writes a session may still run"
    room.poll("ann", "bob", seconds=4)
    room.lobby.repair(room.project)
    room.serve(*room.started())
    room.poll("ann", "bob", seconds=6)
    assert room.together("ann", "bob")


def test_a_session_that_was_half_written_when_the_document_was_lost_is_finished(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=4)
    found = room.session("ann")
    room.platform.documents.delete(membership_key("maze", "bob"))
    room.platform.documents.put(decisions.key("maze"), b"{")
    room.poll("bob", "cem", seconds=62)
    assert room.membership("bob") is None
    room.lobby.repair(room.project)
    assert room.together("ann", "bob")
    assert room.session("bob") == found


def test_a_participant_is_not_unmatched_before_a_lost_document_is_repaired(room: WaitingRoom) -> None:
    room.visit("ann")
    room.platform.documents.put(decisions.key("maze"), b"{")
    room.poll("ann", seconds=70)
    assert room.membership("ann") is None
    room.lobby.repair(room.project)
    room.poll("ann", seconds=2)
    membership = room.membership("ann")
    assert membership is not None
    assert membership.unmatched


def test_each_version_of_the_document_has_other_bytes() -> None:
    """Otherwise a function that has read an earlier version could overwrite a later one, since an ETag is a hash of the content."""
    crossing, written = Crossing(), list[bytes]()
    documents = crossing.platform.documents
    keep = documents._write

    def write(key: str, body: bytes) -> str:
        if key == decisions.key("maze"):
            written.append(body)
        return keep(key, body)

    documents._write = write  # type: ignore[method-assign]
    for lap in range(3):
        for user in (f"ann{lap}", f"bob{lap}") * 3:
            crossing.platform.wait(seconds=1)
            crossing.finish(crossing.visit(user))
        crossing.finish(crossing.repair())
    assert len(written) == len(set(written)) == 9
    assert crossing.decisions() == {"version": 9}


# Erasure


def test_nothing_about_an_erased_participant_stays_in_the_document() -> None:
    member = decisions.Matched
    now = WaitingRoom().platform.now()
    document = Decisions(
        open=(OpenSession("s.1", now, "ann"),),
        proposed=(
            decisions.Proposal("s.2", ("ann", "bob"), now, OpenSession("s.2", now)),
            decisions.Proposal("s.4", ("dan", "eve"), now, OpenSession("s.4", now, "ann")),
        ),
        formed=(decisions.Formed("s.3", (member("ann", "Ann"), member("cem", "Cem")), now),),
        unmatched=(decisions.Unmatched("ann", "Ann", now),),
    )
    left = rules.without(document, "ann")
    assert "nn" not in to_json(left).decode()
    assert [member.user_id for member in left.formed[0].members] == ["", "Cem"]
    assert {each.id for each in left.open} == {"s.1", "s.2"}
    assert [each.labels for each in left.proposed] == [("dan", "eve")]


# Calls


def calls(room: WaitingRoom) -> dict[str, int]:
    made = list(room.platform.documents.calls)
    room.platform.documents.calls.clear()
    return {name: made.count(name) for name in sorted(set(made))}


def test_a_request_in_the_lobby_makes_four_calls(room: WaitingRoom) -> None:
    room.visit("ann")
    calls(room)
    room.wait(2)
    room.visit("ann")
    # Get: the membership and the document; list: the folder; put: ann's entry.
    assert calls(room) == {"get": 2, "list": 1, "put": 1}


def test_the_calls_that_a_pair_makes_from_the_lobby_to_its_memberships(room: WaitingRoom) -> None:
    room.visit("ann")
    assert calls(room) == {"get": 2, "list": 1, "put": 1}
    room.wait(1)
    room.visit("bob")  # bob's request proposes: it reads the document again, and writes it
    assert calls(room) == {"get": 3, "list": 1, "put": 2}
    room.wait(1)
    room.visit("ann")  # ann's request confirms, and lists again
    assert calls(room) == {"get": 2, "list": 2, "put": 1}
    room.visit("bob")  # bob's request confirms, forms the session, and writes it with its memberships
    # two reads for each member; written: the document, a confirmation, the session, two memberships and the mark; four entries are deleted
    assert calls(room) == {"delete": 4, "get": 2 + 4 + 1, "list": 2, "put": 1 + 5}
    room.wait(1)
    room.visit("ann")
    assert calls(room) == {"get": 1}


def test_a_request_in_a_crowd_reads_and_writes_few_documents() -> None:
    room = WaitingRoom()
    for number in range(300):
        room.visit(f"u{number}")
    calls(room)
    room.wait(2)
    room.visit("u0")
    made = calls(room)
    assert made["get"] <= 4
    assert made["put"] <= 2


def test_a_lost_reply_to_the_write_of_the_document_makes_no_second_proposal() -> None:
    crossing = Crossing()
    crossing.finish(crossing.visit("ann"))
    crossing.platform.wait(seconds=1)
    before = len(crossing.platform.made)
    crossing.finish(crossing.visit("bob"), PortFault.REPLY, at=6)
    assert crossing.platform.made[before + 5] == f"create {decisions.key('maze')}", "this call's reply is lost"
    assert len(crossing.decisions()["proposed"]) == 1


@pytest.mark.parametrize(("seconds", "is_formed"), [(1, False), (5, True)], ids=["a moment ago", "long ago"])
def test_other_requests_form_a_group_after_a_while_and_its_members_carry_it_out(
    room: WaitingRoom, seconds: float, is_formed: bool
) -> None:
    """In a crowd most writes of the document conflict; so each write that succeeds decides on several groups."""
    room.poll("ann", "bob", "ann")  # bob's request proposes them
    (proposal,) = room.document().proposed
    for user in ("ann", "bob"):
        room.platform.documents.put(folder.confirmation_key(room.project.id, room.label(user), proposal.id), b"")
    room.wait(seconds)
    room.visit("cem")
    assert bool(room.document().formed) is is_formed
    assert room.membership("ann") is None
    if is_formed:
        room.visit("ann")
        assert room.together("ann", "bob")


def test_each_start_message_names_the_sessions_number_of_players(room: WaitingRoom) -> None:
    """A start message that arrives after another number of players was registered still names its session's number."""
    room.arrive_at_start("ann", ready=False)  # one server ahead
    room.wait(200)
    room.lobby.repair(room.project)  # the server has no record: its message may be lost
    room.poll("bob", "cem", "dan", "eve", seconds=4)  # formed: one pair with the server ahead, one without
    sent = [message for topic, message in room.platform.bus.sent if topic is Topic.START]
    assert len(sent) > 3
    assert {message["players"] for message in sent} == {2}
