"""examples/cec: seven partners cook as partners.py says, and everybody meets all of them in a balanced order."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hippodrome.control.config import read_project
from hippodrome.control.model.design import latin_rows

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "cec"
PARTNERS = ["cook", "onions", "plates", "helper", "slow", "stubborn", "fickle"]


@pytest.fixture
def modules(load_module: Any) -> Any:
    names = ("kitchen", "partners", "picture", "agent")
    return SimpleNamespace(**{name: load_module("cec", name) for name in names})


def soups(modules: Any, you: Any, partner: Any, seed: int = 3) -> int:
    """Play a round of a minute; return how many soups were delivered."""
    agent = modules.agent.Agent()
    agent.start("kitchen")
    seen, _ = agent.reset(seed, {"seconds": 60})
    over = False
    while not over:
        actions = {"you": you.act(seen["you"], {}), "partner": partner.act(seen["partner"], {})}
        seen, _, _, truncations, _ = agent.step(actions)
        over = truncations["you"]
    return int(agent.kitchen.soups)


class Idle:
    def act(self, observation: Any, info: Any) -> int:
        return 0


def test_one_chef_alone_delivers_soups_while_the_other_stands_still(modules: Any) -> None:
    """So the tutorial can be played."""
    assert soups(modules, modules.partners.Cook(), Idle()) >= 3


def test_a_cook_delivers_soups_with_each_partner_but_most_with_one_who_cooks_too(modules: Any) -> None:
    cook = modules.partners.Cook()
    delivered = {name: soups(modules, cook, getattr(modules.partners, name.title())()) for name in PARTNERS}
    assert all(delivered.values()), delivered
    assert min(delivered["cook"], delivered["helper"]) > max(delivered["slow"], delivered["stubborn"]), delivered


def test_partners_who_do_one_thing_need_the_other_chef(modules: Any) -> None:
    onions, plates = modules.partners.Onions, modules.partners.Plates
    assert soups(modules, onions(), onions()) == soups(modules, plates(), plates()) == 0


def test_the_same_seed_gives_the_same_round(modules: Any) -> None:
    fickle = modules.partners.Fickle
    rounds = {seed: [soups(modules, modules.partners.Cook(), fickle(), seed) for _ in range(2)] for seed in range(6)}
    assert all(first == second for first, second in rounds.values())
    assert len({first for first, _ in rounds.values()}) > 1


def test_chefs_do_not_walk_through_each_other(modules: Any) -> None:
    kitchen = modules.kitchen.Kitchen(10)
    kitchen.chefs["you"].place, kitchen.chefs["partner"].place = (2, 1), (4, 1)
    right, left = modules.kitchen.RIGHT, modules.kitchen.LEFT
    kitchen.step({"you": right, "partner": left})
    assert [chef.place for chef in kitchen.chefs.values()] == [(2, 1), (4, 1)], "both wanted the tile between them"
    kitchen.step({"you": right, "partner": modules.kitchen.STAY})
    kitchen.step({"you": right, "partner": left})
    assert [chef.place for chef in kitchen.chefs.values()] == [(3, 1), (4, 1)]


def test_everybody_meets_seven_partners_and_each_follows_each_other_equally_often() -> None:
    (block,) = read_project(EXAMPLE).design.blocks
    assert [levels[0] for levels in block.runs] == PARTNERS
    pairs = [pair for row in latin_rows(len(block.runs)) for pair in itertools.pairwise(row)]
    assert {pairs.count(pair) for pair in pairs} == {2}


def test_seven_items_follow_each_partner() -> None:
    page = (EXAMPLE / "steps" / "rate.html").read_text(encoding="utf-8")
    items = ["adapted", "consistent", "humanlike", "inMyWay", "frustrating", "enjoyed"]
    assert [item for item in items if f'"{item}":' not in page] == []
    assert 'name="coordination"' in page


def test_a_bot_plays_the_tutorial_and_seven_rounds(play_example: Any) -> None:
    played = play_example("cec", options={"seconds": 1}, resetFreeze=0)
    assert len(played.recordings) == 8
    assert {len([line for line in lines if line["kind"] == "step"]) for lines in played.recordings} == {6}
    partners = [lines[0]["players"]["partner"].get("policy") for lines in played.recordings]
    assert {f"agent:{name.title()}" for name in PARTNERS} < {*partners}
