"""examples/two-by-two: the partners behave as the debriefing says, and the design is what the README says."""

from __future__ import annotations

from pathlib import Path

import pytest

from hippodrome.control.config import read_project
from hippodrome.control.model.design import cell_name, cells

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "two-by-two"


@pytest.mark.parametrize(("partner", "least", "most"), [("greedy", 0, 20), ("copycat", 100, 100)])
def test_what_each_partner_gives_to_somebody_who_always_gives(load_module, partner: str, least: int, most: int) -> None:
    agent = load_module("two-by-two", "agent").Agent()
    agent.start("give-and-take")
    agent.reset(seed=1, options={"partner": partner})
    for _ in range(100):
        agent.step(0)
    given = sum(answer == 0 for _, answer in agent.rounds)
    assert least <= given <= most


def test_the_picture_hides_what_was_before_in_one_condition(load_module) -> None:
    agent = load_module("two-by-two", "agent").Agent()
    agent.start("give-and-take")
    for history, shown in (("shown", 3), ("hidden", 1)):
        agent.reset(seed=1, options={"partner": "copycat", "history": history})
        for _ in range(3):
            agent.step(0)
        assert len(agent.render()["objects"]) == 2 + 2 * shown


def test_the_design_has_four_cells_and_three_ends_before_the_last_page() -> None:
    design = read_project(EXAMPLE).design
    names = [cell_name(levels) for levels in cells(design.conditions)]
    assert names == ["copycat,shown", "copycat,hidden", "greedy,shown", "greedy,hidden"]
    assert [end.name for end in design.ends] == ["declined", "screenedOut", "late"]
