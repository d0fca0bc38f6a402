"""The document of a session, which the control plane writes and the trial reads; and the tokens of its members."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from protocol.keys import NAME
from protocol.session import (
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


def changed(**change: Any) -> bytes:
    return json.dumps({**GOOD, **change}).encode()


def with_member(**change: Any) -> bytes:
    first, second = GOOD["members"]
    return changed(members=[first, {**second, **change}])


HOSTILE = {
    "nothing": b"",
    "half": PAIR.to_json()[:-9],
    "a list": b"[1]",
    "too deep": b"[" * 100_000,
    "no text": b"\xff\xfe\x00",
    "a number without end": b'{"schema": 1' + b"0" * 10_000 + b"}",
    "a later schema": changed(schema=2),
    "no id": changed(id=None),
    "a participant's id": changed(id="anna"),
    "an id with a line more": changed(id=SID + "\n"),
    "no players": changed(players=0),
    "players like true": changed(players=True),
    "too many players": changed(players=MAX_PLAYERS + 1),
    "no members": changed(members=[]),
    "members that are none": changed(members=["anna"]),
    "members like a map": changed(members={"anna": 0}),
    "a member like a path": with_member(userId="../anna"),
    "a member like a session": with_member(userId=SID),
    "a member without an id": with_member(userId=None),
    "one member twice": with_member(userId="anna"),
    "one seat twice": with_member(seat=0),
    "a seat too far": with_member(seat=2),
    "a seat below zero": with_member(seat=-1),
    "a seat like true": with_member(seat=True),
    "a seat like text": with_member(seat="1"),
    "a group like text": with_member(group="1"),
    "a group below zero": changed(group=-1),
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
def test_what_is_written_is_what_is_read(
    seats: tuple[int, list[tuple[str, int | None, int]]], group: int | None
) -> None:
    written = SessionDocument(SID, seats[0], tuple(Member(*each) for each in seats[1]), group, "now")
    assert parse(written.to_json()) == written


def test_the_document_is_as_its_module_says() -> None:
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


def test_sixteen_play_together_at_most() -> None:
    assert parse(changed(players=16)).players == 16
    with pytest.raises(BadSession):
        parse(changed(players=17))


def test_a_session_and_a_participant_have_folders_of_their_own() -> None:
    assert owner_folder("maze", SID) == f"maze/sessions/{SID}/"
    assert owner_folder("maze", "anna") == "maze/users/anna/"


def test_a_member_whose_data_were_erased_keeps_their_seat_and_no_id() -> None:
    found = parse(with_member(userId=""))
    assert found.members[1] == Member("", None, 1)
    assert found.member("") is None
    assert found.member("anna") == Member("anna", None, 0)


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_no_session_is_refused_without_a_word_of_it(name: str) -> None:
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
        lambda change: changed(**change)
    )
)
@example(PAIR.to_json())
def test_whatever_stands_there_is_read_or_refused(body: bytes) -> None:
    try:
        found = parse(body)
    except BadSession:
        return
    assert is_session_id(found.id)
    assert len({member.seat for member in found.members}) == len(found.members) <= found.players <= MAX_PLAYERS


@given(IDS, IDS, st.text(min_size=1), st.text(min_size=1))
def test_a_members_token_is_theirs_on_this_server_alone(one: str, other: str, token: str, another: str) -> None:
    mine = member_token(token.encode("utf-8", "replace").decode(), one)
    assert re.fullmatch("[0-9a-f]{48}", mine)
    assert (mine == member_token(token.encode("utf-8", "replace").decode(), other)) is (one == other)
    if token.strip("\0") != another.strip("\0"):  # HMAC fills a key up with zero bytes
        assert mine != member_token(another.encode("utf-8", "replace").decode(), one)
    assert mine != token


def test_a_members_token_is_as_the_wires_page_says() -> None:
    """docs/wire.md describes the derivation, for clients in other languages."""
    import hmac

    assert member_token("secret", "P1") == hmac.new(b"secret", b"member\x00P1", "sha256").hexdigest()[:48]
