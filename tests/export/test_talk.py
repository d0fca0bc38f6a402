"""What people have said in games, in `hippodrome data`."""

from __future__ import annotations

import json

from tests.export.data_world import crowd, recording_key, register
from tests.export.place import Place
from tests.export.session_world import ANN, BOB, SID, said, study, tape, tape_key

SHOWN = ("participant", "n", "by", "to", "text", "replySeconds", "typedSeconds", "held", "original")


def test_each_line_of_a_session_names_who_has_said_it_and_how_long_an_answer_took(place: Place) -> None:
    study(place.put, place.tmp)
    place.put(tape_key(), tape())
    place.done()
    assert place.rows("problems") == []
    assert [tuple(row[name] for name in SHOWN) for row in place.rows("messages")] == [
        (ANN, "1", "left", "", said(ANN), "", "2.5", "", ""),
        ("", "2", "ai", "", "Hello", "2.0", "", "", ""),
        (BOB, "3", "right", "left", said(BOB), "3.0", "", "", "Rude"),
        (ANN, "", "left", "", f"{said(ANN)}!", "", "", "true", ""),
    ]
    (row, *_) = place.rows("messages")
    assert (row["session"], row["studyStep"], row["attempt"], row["episode"], row["step"]) == (SID, "3", "1", "1", "2")


def test_of_one_participant_each_line_has_their_number_and_later_runs_read_only_new_pieces(place: Place) -> None:
    register(place.put)
    (user, _) = crowd(place.put, place.tmp, 2)
    line = {
        "kind": "line",
        "n": 1,
        "by": "player_0",
        "text": f"I am {user}",
        "time": "2026-11-21T14:46:10+00:00",
        "id": 7,
    }
    answer = {"kind": "line", "n": 3, "by": "ai", "text": "Hello", "time": "2026-11-21T14:46:30+00:00", "answers": 2}
    at = recording_key(user, "3-talk-0001").replace(".jsonl.gz", ".json")
    place.put(at, json.dumps({"schema": 1, "records": [line]}).encode())
    place.done()
    second = {**line, "n": 2, "text": "=SUM(A1)\nand more", "time": "2026-11-21T14:46:20+00:00"}
    place.put(at.replace("0001", "0002"), json.dumps({"schema": 1, "records": [second, answer]}).encode())
    place.put(at.replace("0001", "0003"), b"no JSON")
    assert place.done()["run"]["new"] == 2
    said_by = [(row["participant"], row["by"], row["n"]) for row in place.rows("messages")]
    assert said_by == [(user, "player_0", "1"), (user, "player_0", "2"), ("", "ai", "3")]
    assert [row["problem"] for row in place.rows("problems")] == ["it is no piece of a tape that this version can read"]
