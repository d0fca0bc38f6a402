"""Sessions in `hippodrome data`: each recording is read once, and each row names its participant."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow.dataset
import pyarrow.parquet as pq
import pytest

from hippodrome.cli import main
from hippodrome.console.problem import Exit
from hippodrome.protocol.keys import membership_key, session_key, sessions_folder
from tests.export.data_world import PROJECT, crowd, into_folder, key, register
from tests.export.place import Place, rows
from tests.export.session_world import (
    ANN,
    BOB,
    CY,
    OTHER,
    SID,
    join,
    lines,
    packed,
    pair,
    recording_key,
    round_trip,
    session,
    study,
)
from tests.export.test_recordings import load


def table(out: Path, *columns: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = (
        pyarrow.dataset.dataset(out / "recordings").to_table(columns=list(columns) or None).to_pylist()
    )
    return found


def test_a_sessions_recording_is_read_once_and_names_the_player_of_each_action(place: Place) -> None:
    study(place.put, place.tmp)
    done = place.done()
    assert done["counts"]["sessions"] == done["counts"]["recordings"] == 1
    assert place.rows("problems") == []
    steps = [row for row in table(place.out) if row["kind"] == "step"]
    assert len(steps) == 6
    for row in steps:
        assert (row["session"], row["participant"], row["attempt"], row["studyStep"]) == (SID, None, 1, "3")
        assert (row["participant.left"], row["participant.right"]) == (ANN, BOB)
        assert (row["action.left"], row["action.right"], row["reward.right"]) == (1, 2, 0.5)
    assert (place.out / "recordings" / SID / "1" / "3-episode-0001.parquet").exists()


def test_an_episode_of_a_session_has_a_row_for_each_member_with_their_own_score(place: Place) -> None:
    study(place.put, place.tmp)
    place.done()
    names = ("participant", "session", "player", "score", "frames", "why")
    assert [tuple(row[name] for name in names) for row in place.rows("episodes")] == [
        (ANN, SID, "left", "6.0", "6", "terminated"),
        (BOB, SID, "right", "3.0", "6", "terminated"),
    ]
    (ann, bob), level = place.rows("callbacks")[:2], place.rows("callbacks")[2]
    assert [(row["participant"], row["player"], row["value"]) for row in (ann, bob)] == [
        (ANN, "left", "words-of-annabel"),
        (BOB, "right", "words-of-bob"),
    ]
    assert (level["participant"], level["session"], level["player"], level["value"]) == ("", SID, "", "3")


def test_an_episode_says_for_each_member_in_how_many_steps_the_substitute_played_in_their_place(place: Place) -> None:
    study(place.put, place.tmp, replaced=(2, 3, 5))
    place.done()
    assert [(row["participant"], row["frames"], row["framesByPolicy"]) for row in place.rows("episodes")] == [
        (ANN, "6", "0"),
        (BOB, "6", "3"),
    ]


def test_the_table_of_presence_says_who_came_and_went_and_how_long_round_trips_took(place: Place) -> None:
    study(place.put, place.tmp)
    place.done()
    found = place.rows("presence")
    assert {(row["session"], row["studyStep"], row["attempt"], row["trial"]) for row in found} == {
        (SID, "3", "1", "t-1")
    }
    names = ("participant", "player", "episode", "step", "what", "roundTrip")
    trips = [(user, player, "", "", "ping", str(round_trip(user))) for user, player in ((ANN, "left"), (BOB, "right"))]
    moves = [
        (user, player, "1", "3", what, "")
        for user, player in ((ANN, "left"), (BOB, "right"))
        for what in ("left", "returned")
    ]
    joined = [(ANN, "left", "", "", "joined", ""), (BOB, "right", "", "", "joined", "")]
    assert [tuple(row[name] for name in names) for row in found] == [*joined, *trips, *moves]
    assert all((place.out / row["file"]).exists() and row["time"] for row in found)


def test_the_table_of_presence_names_nobody_where_identities_are_apart(place: Place) -> None:
    study(place.put, place.tmp)
    place.done("--identities", "apart")
    numbers = {row["participant"] for row in place.rows("episodes")}
    assert {row["participant"] for row in place.rows("presence")} == numbers
    assert ANN not in (place.out / "presence.csv").read_text()


def test_answers_say_session_player_and_outcome_and_who_had_no_partner(place: Place) -> None:
    study(place.put, place.tmp)
    place.done()
    ann, bob, cy = place.rows()
    assert [(row["session"], row["seat"], row["unmatched"]) for row in (ann, bob, cy)] == [
        (SID, "0", "false"),
        (SID, "1", "false"),
        ("", "", "true"),
    ]
    assert [row["waited"] for row in (ann, bob, cy)] == ["0.0", "2.5", ""]
    assert [(row["3.session"], row["3.player"], row["3.outcome"], row["3.score"]) for row in (ann, bob, cy)] == [
        (SID, "left", "finished", "6.0"),
        (SID, "right", "finished", "3.0"),
        ("", "", "unmatched", ""),
    ]
    assert cy["completionCode"] == "UNMATCHED7", "the one that they were shown"
    assert (
        ann["completionCode"] == json.loads((place.data / key(ANN, "participant.json")).read_text())["completionCode"]
    )


def test_a_study_without_sessions_has_none_of_these_columns(place: Place) -> None:
    crowd(place.put, place.tmp)
    place.done()
    assert not {"session", "seat", "unmatched", "waited"} & {*place.rows()[0]}
    assert not {"session", "player", "framesByPolicy"} & {*place.rows("episodes")[0]}
    assert not (place.out / "presence.csv").exists()
    assert not [name for name in table(place.out)[0] if name == "session" or name.startswith("participant.")]


def test_a_second_run_fetches_only_what_is_new_or_changed(place: Place) -> None:
    study(place.put, place.tmp)
    first = place.done()
    listed = place.listed()
    again = place.done()
    assert (first["run"]["new"], again["run"]["new"], again["run"]["changed"]) == (20, 0, 0)
    assert again["run"]["unchanged"] == 20
    assert {path: hash for path, hash in place.listed().items() if path.startswith("recordings")} == {
        path: hash for path, hash in listed.items() if path.startswith("recordings")
    }
    pair(place.put, place.tmp, members=("dora-0001", "emil-0001"), session_id=OTHER)
    assert place.run("--dry-run", "--json").json["new"] == 14
    assert place.done()["run"]["new"] == 14
    assert {row["session"] for row in place.rows("episodes")} == {SID, OTHER}


def test_a_member_who_was_erased_is_no_ones_in_tables_and_the_other_stays(place: Place) -> None:
    study(place.put, place.tmp, observe=True)
    place.done("--format", "csv,parquet,minari", "--raw")
    for path in sorted((place.data / "maze/users" / ANN).rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    place.put(session_key(PROJECT.id, SID), session("", BOB).to_json())
    assert place.run("--dry-run", "--json").json["changed"] == 2
    done = place.done("--format", "csv,parquet,minari", "--raw")
    assert (done["run"]["changed"], done["run"]["gone"]) == (2, 6)
    for path in place.out.rglob("*"):
        assert not path.is_file() or ANN.encode() not in path.read_bytes(), path
    assert [(row["participant"], row["player"]) for row in place.rows("episodes")] == [("", "left"), (BOB, "right")]
    assert [each["id"] for each in done["minari"]] == ["maze-3-right-v0"]


def test_with_identities_apart_only_private_files_hold_members_data(place: Place) -> None:
    study(place.put, place.tmp)
    told = [ANN, BOB, f"prolific-of-{ANN}", f"prolific-of-{BOB}"]
    typed = f'"fields":{{"said":"I am {" and ".join(told)}"}}'.encode()
    made = [line.replace(b'"key":"words-of-annabel"', typed) for line in lines()]
    place.put(recording_key(), packed(place.tmp, made))
    place.done("--format", "csv,parquet", "--identities", "apart")
    for path in place.out.rglob("*"):
        if path.is_file() and "private" not in path.parts:
            texts = path.read_bytes()
            if path.suffix == ".parquet":
                texts = json.dumps(pq.read_table(path).to_pylist(), default=str).encode()
            assert not [each for each in [*told, CY, "UNMATCHED7"] if each.encode() in texts], path
    who = {row["userId"]: row["participant"] for row in rows(place.out / "private/identities.csv")}
    left = {row["participant.left"] for row in table(place.out)}
    assert left == {who[ANN]}
    assert f"I am {who[ANN]} and {who[BOB]} and (PROLIFIC_PID)" in str(table(place.out, "messages"))


def test_with_identities_apart_link_values_that_are_words_of_the_format_change_no_recording(place: Place) -> None:
    study(place.put, place.tmp)
    head = {name: {"kind": "human", "seat": seat} for seat, name in enumerate(("left", "right-player"))}
    made = [line.replace(b'"right"', b'"right-player"') for line in lines(observe=True, head=head)]
    place.put(recording_key(), packed(place.tmp, made))
    words = ("episode", "callback", "policy", "terminated", "messages", "player", "right-player", "on_tick")
    file = place.data / key(BOB, "participant.json")
    document = json.loads(file.read_text())
    found = []
    for more in ({}, {f"x{n}": word for n, word in enumerate(words)}):
        file.write_text(json.dumps({**document, "link": {**document["link"], **more}}))
        place.done("--format", "csv,parquet", "--identities", "apart")
        found.append((table(place.out), [row["score"] for row in place.rows("episodes")]))
    assert found[0] == found[1]
    assert {row["kind"] for row in found[1][0]} == {"reset", "step", "presence", "ping", "callback", "end"}


@pytest.mark.parametrize("wrong", [{"seat": 2**63}, {"waited": 2**53 + 1}, {"waited": 10**400}])
def test_a_number_that_no_column_can_hold_does_not_stop_the_run(place: Place, wrong: dict[str, int]) -> None:
    study(place.put, place.tmp)
    file = place.data / membership_key(PROJECT.id, ANN)
    file.write_text(json.dumps(json.loads(file.read_text()) | wrong))
    place.done()
    assert {row["participant"] for row in place.rows()} == {ANN, BOB, CY}


def test_minari_has_a_dataset_for_each_human_player(tmp_path: Path, monkeypatch: Any) -> None:
    study(into_folder(tmp_path / "data"), tmp_path, observe=True)
    out = tmp_path / "out"
    assert main(["data", "maze", "--to", str(out), "--from", str(tmp_path / "data"), "--format", "minari"]) == 0
    expected = {"left": (ANN, 1, 1.0, 7), "right": (BOB, 2, 0.5, 9)}
    for player, (participant, action, reward, pixel) in expected.items():
        dataset = load(out, f"maze-3-{player}-v0", monkeypatch)
        (episode,) = dataset.iterate_episodes()
        assert episode.actions.tolist() == [action] * 6
        assert episode.rewards.tolist() == [reward] * 6
        assert episode.observations.tolist() == [[n, pixel] for n in range(7)]
        assert episode.terminations.tolist() == [False] * 5 + [True]
        assert episode.infos["human"].tolist()[1:] == [action] * 6
        (about,) = dataset.storage.get_episode_metadata([0])
        assert (about["participant"], about["session"], about["player"]) == (participant, SID, player)
    right = load(out, "maze-3-right-v0", monkeypatch)
    (episode,) = right.iterate_episodes()
    assert [json.loads(text) for text in episode.infos["info"][1:]] == [{"right": n} for n in range(1, 7)]


@pytest.mark.parametrize(
    ("number", "reason"),
    [(b'"action":2', "an action that is no number from 0 on"), (b'"reward":0.5', "a reward that is no number")],
)
def test_an_episode_with_a_number_that_no_dataset_can_hold_is_left_out(
    place: Place, number: bytes, reason: str
) -> None:
    register(place.put)
    pair(place.put, place.tmp)
    name, _, _ = number.partition(b":")
    hostile = [line.replace(number, name + b":" + b"9" * 400) for line in lines()]
    assert hostile != lines()
    place.put(recording_key(), packed(place.tmp, hostile))
    left, right = place.done("--format", "minari")["minari"]
    assert (left["id"], left["episodes"], left["leftOut"]) == ("maze-3-left-v0", 1, {})
    assert (right["id"], right["episodes"], right["leftOut"]) == ("maze-3-right-v0", 0, {reason: 1})


def test_participants_with_different_players_have_a_dataset_for_each_player(tmp_path: Path, monkeypatch: Any) -> None:
    """Groups with different players, without sessions."""
    put = into_folder(tmp_path / "data")
    from tests.export.data_world import arrive, record, register
    from tests.export.data_world import recording_key as single

    register(put)
    for user, human in (("user-of-left", "left"), ("user-of-right", "right")):
        head = {name: {"kind": "human"} if name == human else {"kind": "policy", "policy": "random"}
                for name in ("left", "right")}  # fmt: skip
        arrive(put, user, {})
        put(single(user), record(tmp_path, user, frames=3, head={"players": head}))
    out = tmp_path / "out"
    assert main(["data", "maze", "--to", str(out), "--from", str(tmp_path / "data"), "--format", "minari"]) == 0
    for player in ("left", "right"):
        dataset = load(out, f"maze-3-{player}-v0", monkeypatch)
        (about,) = dataset.storage.get_episode_metadata([0])
        assert about["participant"] == f"user-of-{player}"


def test_an_incomplete_session_is_exported_as_far_as_possible(place: Place) -> None:
    """One recording is cut off, and the documents of some sessions are missing or damaged."""
    study(place.put, place.tmp)
    made = lines()
    place.put(recording_key(attempt=2), packed(place.tmp, made[:9], close=False))
    place.put(session_key(PROJECT.id, SID), b'{"schema": 1, "id": "s.nobody"}')
    place.put(f"{sessions_folder(PROJECT.id)}{SID}/other.txt", b"?")
    place.put(f"{sessions_folder(PROJECT.id)}no-session/session.json", b"{}")
    place.put(membership_key(PROJECT.id, BOB), b'{"session": 7}')
    assert place.run().code == Exit.DONE
    found = {row["file"]: row["problem"] for row in place.rows("problems")}
    assert found.keys() == {
        f"maze/sessions/{SID}/session.json",
        f"maze/sessions/{SID}/other.txt",
        "maze/sessions/no-session/session.json",
        "maze/" + recording_key(attempt=2).removeprefix("maze/"),
        f"{BOB}/session.json",
    }
    assert [(row["session"], row["player"], row["participant"]) for row in place.rows("episodes")] == [
        (SID, "left", ""),
        (SID, "right", ""),
        (SID, "left", ""),
        (SID, "right", ""),
    ]


def test_a_seat_that_the_substitute_had_from_the_beginning_is_no_persons(place: Place) -> None:
    """The header says that a policy plays at this seat. The columns beside `players` are those of the other human."""
    register(place.put)
    join(place.put, BOB, 1)
    place.put(session_key(PROJECT.id, SID), session("", BOB).to_json())
    head = {"left": {"kind": "policy", "policy": "random", "seat": 0}, "right": {"kind": "human", "seat": 1}}
    made = [json.loads(line) for line in lines(("", BOB), head=head, observe=True)]
    for line in made:
        if line["kind"] in ("reset", "step"):
            line["observation"] = line["players"]["right"].get("observation")
        if line["kind"] == "step":
            line |= {name: line["players"]["right"][name] for name in ("action", "reward", "human")}
    place.put(recording_key(), packed(place.tmp, [json.dumps(line).encode() + b"\n" for line in made]))
    done = place.done("--format", "csv,parquet,minari")
    assert [(row["participant"], row["player"], row["score"]) for row in place.rows("episodes")] == [
        (BOB, "right", "3.0")
    ]
    assert [(each["id"], each["steps"]) for each in done["minari"]] == [("maze-3-right-v0", 6)]
