"""`matching: match`: a server's answer, which the researcher's function has computed, decides who plays with whom."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import pytest

from hippodrome.control.lobby import questions
from hippodrome.control.lobby.lobby import LobbyState
from hippodrome.protocol.keys import groups_key, waiting_key
from tests.control.lobby.waiting_room import WaitingRoom, pairs


@pytest.fixture
def room() -> WaitingRoom:
    people = ("ann", "bob", "cem", "dan")
    answers = {user: {"skill": str(number)} for number, user in enumerate(people)}
    return WaitingRoom(pairs(matching="match"), answers=answers, groups={"ann": 1})


def question(room: WaitingRoom) -> Any:
    found = room.platform.documents.kept.get(waiting_key(room.project.id))
    return json.loads(found[0]) if found else None


def answer(room: WaitingRoom, body: bytes) -> None:
    """Write the answer that a server without members writes."""
    room.platform.documents.create(groups_key(room.project.id, question(room)["id"]), body)


def choose(room: WaitingRoom, *groups: Sequence[str]) -> None:
    answer(room, json.dumps({"groups": [[room.label(user) for user in group] for group in groups]}).encode())


def test_a_question_lists_the_waiting_participants_with_their_answers_and_without_their_ids(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=6)
    asked = question(room)
    assert asked["players"] == 2
    people = {each["id"]: each for each in asked["waiting"]}
    assert people[room.label("ann")] == {"id": room.label("ann"), "group": 1, "answers": {"skill": "0"}}
    assert people[room.label("bob")]["answers"] == {"skill": "1"}
    assert b'"ann"' not in room.platform.documents.kept[waiting_key(room.project.id)][0]


def test_participants_whom_match_has_chosen_play_together(room: WaitingRoom) -> None:
    room.poll("ann", "bob", "cem", "dan", seconds=12)
    assert room.membership("ann") is None
    choose(room, ("ann", "dan"), ("bob", "cem"))
    room.poll("ann", "bob", "cem", "dan", seconds=6)
    assert room.together("ann", "dan")
    assert room.together("bob", "cem")


def test_after_an_answer_the_next_question_comes_with_new_waiting_times(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=2)
    choose(room)
    room.poll("ann", "bob", seconds=6)
    waited = {each.get("waited", 0) for each in question(room)["waiting"]}
    assert waited == {5}


def test_a_question_stays_until_it_is_answered_however_many_participants_come(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=2)
    first = question(room)["id"]
    room.poll("ann", "bob", "cem", "dan", seconds=2)
    assert question(room)["id"] == first
    choose(room, ("ann", "bob"))
    room.poll("cem", "dan", "ann", "bob")
    assert {each["id"] for each in question(room)["waiting"]} == {room.label("cem"), room.label("dan")}


def test_without_an_answer_a_new_question_lists_all_who_are_there(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=2)
    first = question(room)["id"]
    room.poll("ann", "bob", "cem", seconds=12)
    assert question(room)["id"] != first
    assert len(question(room)["waiting"]) == 3


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[" * 100_000,
        b"null",
        b'{"groups": 1}',
        b'{"groups": [[1, 2]]}',
        b'{"groups": [["ann", "bob"]]}',
        b'{"groups": [[]]}',
        b'{"groups": [["LABEL", "LABEL"]]}',
        b'{"groups": [["LABEL"]]}',
    ],
)
def test_an_invalid_answer_matches_no_participant_and_is_logged_once(
    room: WaitingRoom, body: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    room.poll("ann", "bob", seconds=2)
    answer(room, body.replace(b"LABEL", room.label("ann").encode()))
    told = room.poll("ann", "bob", seconds=6)
    assert all(isinstance(state, LobbyState) and not state.proposed for state in told.values())
    assert len([each for each in caplog.messages if "match" in each]) == 1


def test_a_participant_in_two_groups_plays_in_the_first(room: WaitingRoom) -> None:
    room.poll("ann", "bob", "cem", seconds=12)
    choose(room, ("ann", "bob"), ("bob", "cem"))
    room.poll("ann", "bob", "cem", seconds=6)
    assert room.together("ann", "bob")
    assert room.membership("cem") is None


def test_a_participant_who_has_left_is_not_proposed(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=2)
    choose(room, ("ann", "bob"))
    room.lobby.leave(room.project, "bob")
    room.poll("ann", seconds=2)
    assert room.document().proposed == ()


def test_without_an_answer_participants_are_unmatched_at_the_end_of_patience(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=64)
    memberships = [room.membership(user) for user in ("ann", "bob")]
    assert all(one is not None and one.unmatched for one in memberships)


def test_the_sweep_deletes_old_questions(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=2)
    choose(room)
    room.wait(301)
    room.lobby.repair(room.project)
    assert not [key for key in room.platform.documents.kept if "/lobby/" in key or key.startswith("_match/")]


def test_a_matched_participant_is_in_no_later_question(room: WaitingRoom) -> None:
    room.poll("ann", "bob", seconds=2)
    choose(room, ("ann", "bob"))
    room.poll("ann", "bob", "cem", "dan", seconds=6)
    room.poll("cem", "dan", seconds=14)
    asked = question(room)
    assert {one["id"] for one in asked["waiting"]} == {room.label("cem"), room.label("dan")}
    assert "came" not in asked


def test_a_full_question_leaves_out_further_participants_until_the_next(
    room: WaitingRoom, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two participants fit beside the question. Of three who come before its answer, the third is in a later question."""
    monkeypatch.setattr(questions, "MAX_CAME", 2)
    room.poll("ann", "bob", seconds=2)
    others = ("cem", "dan", "eve")
    room.poll("ann", "bob", *others, seconds=2)
    asked = question(room)
    assert len(asked["waiting"]) == 2
    assert [one["id"] for one in asked["came"]] == [room.label("cem"), room.label("dan")]
    choose(room, ("ann", "bob"))
    room.poll("ann", "bob", *others, seconds=6)
    assert room.together("ann", "bob")
    room.poll(*others, seconds=14)
    assert {one["id"] for one in question(room)["waiting"]} == {room.label(user) for user in others}


def test_a_project_without_match_writes_no_question() -> None:
    room = WaitingRoom(pairs())
    room.poll("ann", seconds=4)
    assert question(room) is None
