"""The calls of language models, in `hippodrome data`."""

from __future__ import annotations

import json

from tests.export.data_world import crowd, recording_key, register
from tests.export.place import Place

CALL = {
    "kind": "call",
    "hash": "ab" * 32,
    "nth": 1,
    "path": "/chat/completions",
    "model": "small",
    "request": {"messages": [{"role": "user", "content": "Hi"}]},
    "status": 200,
    "answer": {"choices": []},
    "tokens": {"input": 12, "output": 3},
    "ms": 820,
    "time": "2026-11-21T14:46:10+00:00",
    "episode": 2,
    "step": 17,
    "line": 5,
}
FAILED = {
    **CALL,
    "status": 504,
    "answer": {"error": {"code": "timeout"}},
    "tokens": {"input": 0, "output": 0, "estimated": True},
    "line": None,
}


def test_each_call_has_a_row(place: Place) -> None:
    register(place.put)
    (user, _) = crowd(place.put, place.tmp, 2)
    at = recording_key(user, "3-talk-0001").replace(".jsonl.gz", ".json")
    place.put(at, json.dumps({"schema": 1, "records": [CALL, FAILED, {"kind": "call", "tokens": 3}]}).encode())
    place.done()
    first, second, odd = place.rows("calls")
    assert {name: first[name] for name in ("participant", "episode", "step", "n", "model", "status", "error")} == {
        "participant": user,
        "episode": "2",
        "step": "17",
        "n": "5",
        "model": "small",
        "status": "200",
        "error": "",
    }
    assert (first["milliseconds"], first["inputTokens"], first["outputTokens"]) == ("820", "12", "3")
    assert (second["status"], second["error"], second["estimated"], second["n"]) == ("504", "timeout", "true", "")
    assert (odd["model"], odd["inputTokens"]) == ("", "")


def test_the_answers_have_a_column_for_each_sum_of_a_game(place: Place) -> None:
    register(place.put)
    (user,) = crowd(place.put, place.tmp, 1)
    at = f"maze/users/{user}/answers/3.json"
    answer = json.loads((place.data / at).read_text())
    answer["answers"]["talk"] = {"lines": 2, "calls": 3, "tokens": {"input": 40, "output": 7}, "prompt": "0a1b"}
    (place.data / at).write_text(json.dumps(answer))
    place.done()
    (row,) = place.rows()
    assert {name: value for name, value in row.items() if ".talk" in name} == {
        "3.talk.lines": "2",
        "3.talk.calls": "3",
        "3.talk.tokens.input": "40",
        "3.talk.tokens.output": "7",
        "3.talk.prompt": "0a1b",
    }


def test_without_calls_there_is_no_table(place: Place) -> None:
    register(place.put)
    crowd(place.put, place.tmp, 1)
    place.done()
    assert not list(place.out.glob("calls.*"))
