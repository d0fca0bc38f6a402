"""examples/advice: the advisors are right as often as the debriefing says, and the agent reads earlier answers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest


def begun(load_module: Any, answers: dict[str, Any]) -> Any:
    agent = load_module("advice", "agent").Agent()
    agent.start("dots")
    agent.on_session_start(SimpleNamespace(answers=answers))
    return agent


@pytest.mark.parametrize(("often", "least", "most"), [(0.9, 170, 190), (0.6, 100, 140)])
def test_an_advisor_is_right_as_often_as_it_is_said(load_module, often: float, least: int, most: int) -> None:
    agent = begun(load_module, {})
    for seed in range(200):
        agent.reset(seed=seed, options={"advisor": often})
        agent.step(0)
        assert agent.step(0)[4]["success"] is (agent.more == 0)
    assert least <= agent.right <= most


@pytest.mark.parametrize(
    ("answers", "shows"),
    [
        ({"expect": {"trust": "2"}}, True),
        ({"expect": {"trust": "5"}}, False),
        ({"expect": {"trust": "2"}, "rate": {"expert": {"trust": "6"}}}, False),
    ],
)
def test_who_relies_little_on_advice_sees_the_record(load_module, answers: dict[str, Any], shows: bool) -> None:
    agent = begun(load_module, answers)
    for seed in (1, 2):
        agent.reset(seed=seed, options={"advisor": 0.9})
        agent.step(1)
        said = [each.get("text", "") for each in agent.render()["objects"]]
        agent.step(1)
    assert any("was right" in words for words in said) is shows


def test_training_is_one_judgement_without_advice(load_module) -> None:
    agent = begun(load_module, {})
    agent.reset(seed=1, options={"advisor": "none"})
    assert agent.step(0)[2] is True
