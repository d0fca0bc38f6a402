"""examples/slime-volleyball, played to the end by a bot on a real server."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "slime-volleyball"
LEFT, RIGHT = "agent_left", "agent_right"


def test_a_person_plays_against_the_policy(play_example: Any, load_module: Any) -> None:
    played = play_example(
        "slime-volleyball",
        maxEpisodes=1,
        resetFreeze=0,
        betweenEpisodes=0,
        seed=1,
        options={"points": 1, "seconds": 20},
    )
    (lines,) = played.recordings
    head, steps = lines[0], played.steps()
    assert head["players"][LEFT]["kind"] == "human"
    policy = (EXAMPLE / "policies" / "right.onnx").read_bytes()
    assert head["players"][RIGHT]["policy"] == "policies/right.onnx"
    assert head["players"][RIGHT]["sha256"] == hashlib.sha256(policy).hexdigest()
    assert {step["players"][LEFT]["by"] for step in steps} <= {"human", "none"}
    chose = [step["players"][RIGHT]["by"] for step in steps]
    assert chose.count("policy") > len(steps) / 2, "on a busy machine it may be late"
    assert len({step["players"][RIGHT]["action"] for step in steps}) > 1
    repeat(load_module("slime-volleyball", "volleyball"), lines)


def repeat(volleyball: Any, lines: list[dict[str, Any]]) -> None:
    """Take the recorded seed and actions again; the environment must give the recorded rewards."""
    env = volleyball.Volleyball(points=1, seconds=20)
    (reset,) = (line for line in lines if line["kind"] == "reset")
    env.reset(seed=reset["seed"])
    for line in lines:
        if line["kind"] == "step":
            _, rewards, *_ = env.step({player: line["players"][player]["action"] for player in (LEFT, RIGHT)})
            assert rewards == {player: line["players"][player]["reward"] for player in (LEFT, RIGHT)}
    assert env.agents == []
