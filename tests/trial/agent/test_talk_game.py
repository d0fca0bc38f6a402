"""The built-in game `talk`."""

from __future__ import annotations

import pytest

from hippodrome.trial.agent.loading import TalkGame


@pytest.mark.parametrize("reward", [20, {"player_0": 20}])
def test_the_agent_ends_a_round_with_a_score(reward: float | dict[str, float]) -> None:
    game = TalkGame(("player_0",))
    game.reset()
    assert game.step(0)[1:] == (0.0, False, False, {})
    game.end(reward, success=True)
    assert game.step(0)[1:] == (20.0, True, False, {"success": True})
    game.reset()
    assert game.step(0)[1:] == (0.0, False, False, {})


def test_each_of_several_has_a_score() -> None:
    game = TalkGame(("buyer", "seller"))
    game.reset()
    game.end({"seller": 30})
    _, rewards, over, *_ = game.step({})
    assert (rewards, over) == ({"buyer": 0.0, "seller": 30.0}, {"buyer": True, "seller": True})
