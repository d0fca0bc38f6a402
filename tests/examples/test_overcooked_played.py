"""examples/overcooked, played to the end by a bot on a real server."""

from __future__ import annotations

from typing import Any


def test_a_person_and_the_policy_cook_together(play_example: Any, load_module: Any) -> None:
    played = play_example(
        "overcooked", maxEpisodes=1, resetFreeze=0, betweenEpisodes=0, seed=1, options={"seconds": 20}
    )
    (lines,) = played.recordings
    steps = played.steps()
    assert len(steps) == 200
    assert lines[0]["players"]["0"]["kind"] == "human"
    assert lines[0]["players"]["1"]["policy"] == "policies/cook.onnx"
    chosen = [step["players"]["1"] for step in steps]
    for first, second in zip(chosen[::2], chosen[1::2], strict=True):
        assert "policy" not in (first["by"], second["by"]) or "noop" in (first["actionName"], second["actionName"])
    assert sum(each["by"] == "policy" for each in chosen) > 50, "at every second step, unless it is late"
    assert sum(step["players"]["1"]["reward"] for step in steps) > 0, "at least an onion is in the pot"
    assert {step["players"]["0"]["by"] for step in steps} == {"human", "none"}
