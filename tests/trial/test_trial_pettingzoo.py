"""A game of PettingZoo on a real server, without an agent.py: a participant plays against an ONNX file."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from testing import onnx_files

TICTACTOE = {
    "game": "pettingzoo.classic.tictactoe_v3",
    "players": {"player_1": "human", "player_2": "policies/p.onnx"},
    "pace": "turns",
    "startingFrameRate": 30,
    "maxEpisodes": 1,
    "seed": 1,
}


async def test_a_game_in_turns_against_a_file_with_legal_actions_alone(
    launch: Any, open_client: Any, tmp_path: Any
) -> None:
    """The file prefers square 8, then 7 …; the participant takes the first row, and tries a square that is taken."""
    agent = tmp_path / "agent"
    file = onnx_files.constant(agent / "policies/p.onnx", np.arange(9, dtype=np.float32)[None], size=18)
    server = launch(None, trial=TICTACTOE, SDL_VIDEODRIVER="dummy", AGENT_DIR=str(agent))
    async with open_client(server.address) as client:
        await client.start()
        for press in ("0", "8", "1", "2"):  # the file has taken square 8 by then
            await client.until(lambda: client.state.get("toAct"))
            await client.say(action=press)
            refused = press == "8"
            await client.until(lambda no=refused: client.errors if no else client.done or not client.state.get("toAct"))
        await client.until(lambda: client.done)
    assert server.wait() == 0, server.log_text()
    assert len(client.errors) == 1, "square 8 is taken"
    (lines,) = server.recordings().values()
    head = lines[0]
    assert {"pettingzoo", "onnxruntime"} <= head["versions"].keys()
    assert head["players"]["player_1"] == {"kind": "human"}
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    assert head["players"]["player_2"] == {"kind": "policy", "policy": "policies/p.onnx", "sha256": sha256}
    steps = [line for line in lines if line["kind"] == "step"]
    taken = [
        next((name, part["action"]) for name, part in line["players"].items() if part["action"] is not None)
        for line in steps
    ]
    assert taken == [("player_1", 0), ("player_2", 8), ("player_1", 1), ("player_2", 7), ("player_1", 2)]
    assert {part["by"] for line in steps for part in line["players"].values()} >= {"human", "policy"}
    assert steps[-1]["reward"] == 1
    assert steps[-1]["terminated"] is True
