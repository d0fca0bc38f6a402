"""The document of a session, which the control plane writes and the trial reads; and the tokens of its members."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hippodrome.protocol.keys import NAME
from hippodrome.protocol.session import (
    MAX_PLAYERS,
    BadSession,
    Member,
    SessionDocument,
    is_session_id,
    member_token,
    owner_folder,
    parse,
)

SID = "s.0123456789abcdef0123"
PAIR = SessionDocument(SID, 2, (Member("anna", None, 0), Member("bert", None, 1)), None, "2026-11-22T22:00:00.000000Z")
GOOD: dict[str, Any] = json.loads(PAIR.to_json())
IDS = st.from_regex(NAME, fullmatch=True)


def document_with(**change: Any) -> bytes:
    return json.dumps({**GOOD, **change}).encode()


def document_with_member(**change: Any) -> bytes:
    first, second = GOOD["members"]
    return document_with(members=[first, {**second, **change}])


HOSTILE = {
    "nothing": b"",
    "half": PAIR.to_json()[:-9],
    "a list": b"[1]",
    "too deep": b"[" * 100_000,
    "no text": b"\xff\xfe\x00",
    "a number without end": b'{"schema": 1' + b"0" * 10_000 + b"}",
    "a later schema": document_with(schema=2),
    "no id": document_with(id=None),
    "a participant's id": document_with(id="anna"),
    "an id with a line more": document_with(id=SID + "\n"),
    "no players": document_with(players=0),
    "players like true": document_with(players=True),
    "too many players": document_with(players=MAX_PLAYERS + 1),
    "no members": document_with(members=[]),
    "members that are none": document_with(members=["anna"]),
    "members like a map": document_with(members={"anna": 0}),
    "a member like a path": document_with_member(userId="../anna"),
    "a member like a session": document_with_member(userId=SID),
    "a member without an id": document_with_member(userId=None),
    "one member twice": document_with_member(userId="anna"),
    "one seat twice": document_with_member(seat=0),
    "a seat too far": document_with_member(seat=2),
    "a seat below zero": document_with_member(seat=-1),
    "a seat like true": document_with_member(seat=True),
    "a seat like text": document_with_member(seat="1"),
    "a group like text": document_with_member(group="1"),
    "a group below zero": document_with(group=-1),
}


@given(
    st.integers(1, MAX_PLAYERS).flatmap(
        lambda players: st.tuples(
            st.just(players),
            st.lists(
                st.tuples(IDS, st.none() | st.integers(0, 9), st.integers(0, players - 1)),
                min_size=1,
                max_size=players,
                unique_by=(lambda each: each[0], lambda each: each[2]),
            ),
        )
    ),
    st.none() | st.integers(0, 9),
)
def test_a_written_document_is_read_unchanged(
    seats: tuple[int, list[tuple[str, int | None, int]]], group: int | None
) -> None:
    written = SessionDocument(SID, seats[0], tuple(Member(*each) for each in seats[1]), group, "now")
    assert parse(written.to_json()) == written


def test_the_document_has_the_form_that_its_module_describes() -> None:
    member = SessionDocument(SID, 2, (Member("anna", 1, 0),), 1, "now")
    assert member.to_json().decode().splitlines() == [
        "{",
        ' "schema": 1,',
        f' "id": "{SID}",',
        ' "players": 2,',
        ' "group": 1,',
        ' "formed": "now",',
        ' "members": [',
        "  {",
        '   "userId": "anna",',
        '   "group": 1,',
        '   "seat": 0',
        "  }",
        " ]",
        "}",
    ]


@pytest.mark.parametrize("formed", [{}, {"formed": None}, {"formed": 1}])
def test_a_document_that_does_not_say_when_it_was_formed_is_read(formed: dict[str, Any]) -> None:
    without = {key: value for key, value in GOOD.items() if key != "formed"}
    assert parse(json.dumps({**without, **formed}).encode()) == SessionDocument(SID, 2, PAIR.members)
    assert parse(json.dumps({**without, **formed}).encode()).formed == ""


def test_a_session_has_at_most_sixteen_players() -> None:
    assert parse(document_with(players=16)).players == 16
    with pytest.raises(BadSession):
        parse(document_with(players=17))


def test_a_session_and_a_participant_have_folders_of_their_own() -> None:
    assert owner_folder("maze", SID) == f"maze/sessions/{SID}/"
    assert owner_folder("maze", "anna") == "maze/users/anna/"


def test_a_member_whose_data_were_erased_keeps_their_seat_and_no_id() -> None:
    found = parse(document_with_member(userId=""))
    assert found.members[1] == Member("", None, 1)
    assert found.member("") is None
    assert found.member("anna") == Member("anna", None, 0)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_bad_document_is_refused_with_a_message_without_its_ids(name: str) -> None:
    with pytest.raises(BadSession) as raised:
        parse(HOSTILE[name])
    assert "anna" not in str(raised.value)


@given(
    st.binary()
    | st.recursive(
        st.none() | st.booleans() | st.text() | st.integers() | st.floats() | st.sampled_from([SID, 1, 2]),
        lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from([*GOOD, "userId", "seat"]), inner),
    ).map(lambda value: json.dumps(value).encode())
    | st.dictionaries(st.sampled_from([*GOOD]), st.none() | st.integers() | st.lists(st.integers())).map(
        lambda change: document_with(**change)
    )
)
@example(PAIR.to_json())
def test_any_document_is_read_or_refused(body: bytes) -> None:
    try:
        found = parse(body)
    except BadSession:
        return
    assert is_session_id(found.id)
    assert len({member.seat for member in found.members}) == len(found.members) <= found.players <= MAX_PLAYERS


@given(IDS, IDS, st.text(min_size=1), st.text(min_size=1))
def test_each_member_has_another_token_on_each_server(one: str, other: str, token: str, another: str) -> None:
    mine = member_token(token.encode("utf-8", "replace").decode(), one)
    assert re.fullmatch("[0-9a-f]{48}", mine)
    assert (mine == member_token(token.encode("utf-8", "replace").decode(), other)) is (one == other)
    if token.strip("\0") != another.strip("\0"):  # HMAC fills a key up with zero bytes
        assert mine != member_token(another.encode("utf-8", "replace").decode(), one)
    assert mine != token


def test_a_members_token_is_made_as_docs_wire_describes() -> None:
    """docs/wire.md describes the derivation, for clients in other languages."""
    import hmac

    assert member_token("secret", "P1") == hmac.new(b"secret", b"member\x00P1", "sha256").hexdigest()[:48]
