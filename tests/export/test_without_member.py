"""A session's recording from which a member was removed holds nothing that they sent, and the whole game of the others."""

from __future__ import annotations

import gzip
import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hippodrome.export.without_member import rewrite
from hippodrome.trial.core.history import RecordedTrial
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.resume import add_lines
from testing.exploration import examples
from tests.export.session_world import ANN, BOB, lines, packed, round_trip, said


def without(folder: Path, body: bytes, seat: int = 0, user: str = ANN) -> tuple[bytes, bool]:
    (folder / "whole.gz").write_bytes(body)
    differs = rewrite(folder / "whole.gz", folder / "left.gz", seat, user)
    return (folder / "left.gz").read_bytes(), differs


@pytest.mark.parametrize(("seat", "user", "player", "other"), [(0, ANN, "left", "right"), (1, BOB, "right", "left")])
def test_everything_that_the_member_sent_is_removed(
    tmp_path: Path, seat: int, user: str, player: str, other: str
) -> None:
    body = packed(tmp_path, [*lines(), recording.line("error", episode=1, error=f"{user} and {user.upper()}")])
    left, differs = without(tmp_path, body, seat, user)
    text = gzip.decompress(left)
    assert differs
    for gone in (said(user), user, user.upper(), f":{round_trip(user)}"):
        assert gone.encode() not in text
    for line in recording.read(left):
        assert all(message["player"] == other for message in line.get("messages", ()))
        assert player not in line.get("roundTrip", {})
        assert not (line["kind"] in ("presence", "callback") and line.get("player") == player)
        part = line.get("players", {}).get(player, {})
        assert line["kind"] == "header" or not {"human", "pressedAt"} & {*part}
    again, differs = without(tmp_path, left, seat, user)
    assert (again, differs) == (left, False)


@pytest.mark.parametrize(("seat", "user", "other"), [(0, ANN, BOB), (1, BOB, ANN)])
def test_the_game_and_the_others_messages_are_unchanged(tmp_path: Path, seat: int, user: str, other: str) -> None:
    body = packed(tmp_path, lines(observe=True))
    left, _ = without(tmp_path, body, seat, user)
    before, after = recording.read(body), recording.read(left)
    theirs = [m for line in before for m in line.get("messages", ()) if m["player"] == ("left", "right")[1 - seat]]
    assert [m for line in after for m in line.get("messages", ())] == theirs
    for wanted, found in zip(steps(before), steps(after), strict=True):
        for name in ("action", "by", "reward", "terminated", "observation", "info", "extra", "ns"):
            assert found[name] == wanted[name]
        for player, part in wanted["players"].items():
            kept = found["players"][player]
            assert {**part, **kept} == part
            assert kept["action"] == part["action"]
    assert said(other) in gzip.decompress(left).decode()


def steps(made: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [line for line in made if line["kind"] == "step"]


def test_the_game_can_still_be_repeated(tmp_path: Path) -> None:
    body = packed(tmp_path, lines())
    left, _ = without(tmp_path, body)
    whole, rest = RecordedTrial(), RecordedTrial()
    add_lines(whole, recording.read(body))
    add_lines(rest, recording.read(left))
    assert [episode.steps for episode in rest.ended] == [6]
    assert whole.ended == rest.ended


def test_lines_of_others_are_unchanged_byte_for_byte(tmp_path: Path) -> None:
    odd = b'{"kind":"callback","callback":"on_tick","episode":1, "value":1.50, "name":"caf\\u00e9"}\n'
    left, _ = without(tmp_path, packed(tmp_path, [*lines(), odd]))
    assert odd in gzip.decompress(left)


def test_a_recording_that_was_cut_off_stays_so_and_keeps_its_lines(tmp_path: Path) -> None:
    made = lines()
    left, _ = without(tmp_path, packed(tmp_path, made[:9], close=False))
    unpack = zlib.decompressobj(31)
    found = unpack.decompress(left)
    assert not unpack.eof
    assert found.count(b"\n") == 9 - 2  # their presence stands in two lines
    assert said(ANN).encode() not in found


def test_without_a_header_the_messages_of_all_members_are_removed(tmp_path: Path) -> None:
    left, _ = without(tmp_path, packed(tmp_path, lines()[1:]))
    text = gzip.decompress(left)
    assert said(ANN).encode() not in text
    assert said(BOB).encode() not in text
    assert len(steps(recording.read(left))) == 6


def test_lines_that_name_no_player_are_removed(tmp_path: Path) -> None:
    more = [
        recording.line("callback", episode=1, callback="on_feedback", name="who", value="unknown"),
        recording.line("end", episode=1, why="stopped", messages=[{"ns": 1, "command": "unknown"}, "unknown"]),
    ]
    left, _ = without(tmp_path, packed(tmp_path, [*lines(), *more]))
    assert b"unknown" not in gzip.decompress(left)


def test_a_place_of_the_substitute_belongs_to_no_member(tmp_path: Path) -> None:
    """The header has the seats. After the erasure of a member, the order of the humans is not that of the seats."""
    head = {"left": {"kind": "policy", "policy": "random", "seat": 0}, "right": {"kind": "human", "seat": 1}}
    body = packed(tmp_path, lines(head=head))
    left, _ = without(tmp_path, body, 1, BOB)
    assert said(BOB).encode() not in gzip.decompress(left)
    assert said(ANN).encode() in gzip.decompress(left)


def test_the_seed_of_the_policy_that_took_the_place_stays(tmp_path: Path) -> None:
    line = recording.line("presence", episode=1, step=2, player="left", what="replaced", seed=77)
    left, _ = without(tmp_path, packed(tmp_path, [*lines(), line]))
    assert line in gzip.decompress(left)


@settings(max_examples=examples(60))
@given(st.binary(max_size=200), st.integers(0, 3000), st.booleans())
def test_damaged_recordings_keep_nothing_of_the_member(noise: bytes, at: int, inside: bool) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        body = packed(folder, lines())
        if inside:
            text = gzip.decompress(body)
            body = gzip.compress(text[:at] + noise + text[at + len(noise) :])
        else:
            body = body[:at] + noise + body[at + len(noise) :]
        left, _ = without(folder, body)
        found = zlib.decompressobj(31).decompress(left) if left else b""
    for line in filter(None, found.split(b"\n")):
        for message in json.loads(line).get("messages") or ():
            assert message["player"] != "left"


# An id may be any word of letters, digits, dashes and underscores: also one of the format's


@pytest.mark.parametrize(
    "user",
    [
        "header",
        "rewards",
        "player",
        "players",
        "answer",
        "terminated",
        "callback",
        "on_tick",
        "human_0",
        "float32",
    ],
)
def test_an_id_that_is_a_word_of_the_format_leaves_the_others_data_as_they_are(tmp_path: Path, user: str) -> None:
    seen = recording.observation(np.zeros(2, np.float32))
    more = [
        recording.line("step", episode=1, step=7, info={"rewards": {"human_0": 1.0}, "answer": seen, "player": 3}),
        recording.line("presence", episode=1, step=7, player="right", what="left"),
        recording.line("end", episode=1, why="terminated", outcomes={"right": "completed"}),
    ]
    body = packed(tmp_path, [*lines(observe=True), *more])
    usual, _ = without(tmp_path, body, user="annabel-0043")
    left, _ = without(tmp_path, body, user=user)
    assert recording.read(left) == recording.read(usual)


@pytest.mark.parametrize("name", ["player_0", "left-player"])
def test_an_id_that_is_the_name_of_a_player_stays_where_it_names_the_player(tmp_path: Path, name: str) -> None:
    head = {"other": {"kind": "human", "seat": 0}, name: {"kind": "human", "seat": 1}}
    line = recording.line(
        "step", episode=1, step=1, info={"leader": name}, toAct=[name], players={name: {"reward": 1.0}}
    )
    left, _ = without(tmp_path, packed(tmp_path, [*lines(head=head)[:1], line]), 0, name)
    assert line in gzip.decompress(left)


def test_the_id_leaves_a_sentence_of_another_member_and_no_longer_word(tmp_path: Path) -> None:
    form = {"page": ANN, "fields": {"who": f"It was {ANN.upper()}, or\n{ANN}!", ANN: f"{ANN}-2"}}
    line = recording.line("break", episode=1, why="over", messages=[{"ns": 1, "player": "right", "form": form}])
    left, _ = without(tmp_path, packed(tmp_path, [*lines(), line]))
    (message,) = recording.read(left)[-1]["messages"]
    assert message["form"] == {"page": ANN, "fields": {"who": "It was , or\n!", ANN: f"{ANN}-2"}}
