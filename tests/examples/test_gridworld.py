"""examples/gridworld: two players take turns, the partner plans, and every image of the scene exists."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "gridworld"


@pytest.fixture
def modules(load_module: Any, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any, Any]:
    """The modules forest, partners (which do not wait as if they thought) and agent."""
    forest, partners = load_module("gridworld", "forest"), load_module("gridworld", "partners")
    monkeypatch.setattr(partners, "THINKING_SECONDS", 0)
    return forest, partners, load_module("gridworld", "agent")


def turns_with(modules: Any, you: Any, partner: Any, seed: int) -> int:
    """Play a game; return how many turns it took."""
    _, _, module = modules
    agent, players = module.Agent(), {"you": you, "partner": partner}
    agent.start("forest")
    observations, infos = agent.reset(seed)
    for turn in itertools.count(1):
        player = agent.to_act()
        move = players[player].act(observations[player], infos[player])
        assert infos[player]["action_mask"][move]
        observations, _, terminated, truncated, infos = agent.step({player: move})
        if terminated["you"] or truncated["you"]:
            return turn
    raise AssertionError


def test_the_planner_is_a_better_partner_than_the_one_that_goes_for_the_nearest(modules: Any) -> None:
    _, partners, _ = modules
    person = partners.Nearest()
    seeds = range(30)
    planner, nearest = (
        np.mean([turns_with(modules, person, partner, seed) for seed in seeds])
        for partner in (partners.Planner(), partners.Nearest())
    )
    assert planner < nearest - 1


def observation(forest: Any, **more: Any) -> dict[str, Any]:
    return {"me": (7, 0), "other": (0, 5), "acorns": [], "trees": frozenset(), "left": 36, **more}


def test_the_planner_leaves_acorns_to_the_player_who_is_nearer(modules: Any) -> None:
    forest, partners, _ = modules
    near_the_other, far = (1, 5), (4, 0)
    assert partners.first_of_plan(observation(forest, acorns=[near_the_other, far])) == far
    assert partners.first_of_plan(observation(forest, acorns=[near_the_other])) is None


def test_the_plan_is_the_best_division_of_the_acorns(modules: Any) -> None:
    """It is compared with a plain search through all divisions and orders."""
    forest, partners, _ = modules

    def length(start: Any, order: Any) -> int:
        places = [start, *order]
        return sum(abs(a[0] - b[0]) + abs(a[1] - b[1]) for a, b in itertools.pairwise(places))

    for seed in range(10):
        chance = np.random.default_rng(seed)
        acorns = [(int(number) % 8, int(number) // 8) for number in chance.choice(np.arange(8, 40), 4, replace=False)]
        watched = observation(forest, acorns=acorns)
        best: dict[tuple[int, int], set[Any]] = {}
        for count in range(len(acorns) + 1):
            for mine in itertools.permutations(acorns, count):
                rest = [acorn for acorn in acorns if acorn not in mine]
                me = length(watched["me"], mine)
                other = min(length(watched["other"], order) for order in itertools.permutations(rest))
                best.setdefault((max(me, other), me + other), set()).add(mine[0] if mine else None)
        assert partners.first_of_plan(watched) in best[min(best)]


def test_all_acorns_of_a_forest_can_be_reached_and_the_seed_repeats_it(modules: Any) -> None:
    forest, _, _ = modules
    for seed in range(50):
        one, same = forest.Forest(seed), forest.Forest(seed)
        assert (one.trees, one.acorns) == (same.trees, same.acorns)
        assert one.acorns <= forest.distances(forest.START["you"], one.trees).keys()
    assert len({frozenset(forest.Forest(seed).trees) for seed in range(50)}) > 45


def test_players_take_turns_and_share_the_points(modules: Any) -> None:
    _, _, module = modules
    agent = module.Agent()
    agent.start("forest")
    agent.reset(1)
    agent.forest.trees, agent.forest.acorns = frozenset(), {(1, 5), (7, 5)}
    assert agent.to_act() == "you"
    _, rewards, _, _, _ = agent.step({"you": 2, "partner": 0})
    assert rewards == {"you": 1.0, "partner": 1.0}
    assert (agent.forest.places["you"], agent.to_act()) == ((1, 5), "partner")


def test_no_player_walks_through_trees_or_through_the_other(modules: Any) -> None:
    forest, _, _ = modules
    game = forest.Forest(1)
    game.places, game.trees = {"you": (0, 0), "partner": (1, 0)}, frozenset({(0, 1)})
    assert game.legal("you") == [True, False, False, False, False]
    game.move(2)
    assert game.places["you"] == (0, 0)


def test_a_game_ends_when_all_acorns_are_collected_or_the_turns_are_over(modules: Any) -> None:
    forest, _, module = modules
    agent = module.Agent()
    agent.start("forest")
    agent.reset(1)
    for _ in range(forest.TURNS):
        _, _, terminated, truncated, _ = agent.step({agent.to_act(): 0})
    assert (terminated["you"], truncated["you"]) == (False, True)
    agent.reset(1)
    agent.forest.acorns = {(0, 4)}
    agent.forest.trees = frozenset()
    _, _, terminated, truncated, _ = agent.step({"you": 1})
    assert (terminated["you"], truncated["you"]) == (True, False)


def test_every_scene_can_be_drawn(modules: Any) -> None:
    from hippodrome.trial.pictures.assets import load
    from hippodrome.trial.pictures.scene import as_scene, images_of

    _, _, module = modules
    agent = module.Agent()
    agent.start("forest")
    agent.reset(1)
    scene = as_scene(agent.render())
    assert scene.problems == ()
    assert set(images_of(scene)) <= set(load(EXAMPLE, "assets").by_name)


def test_a_bot_and_the_planner_play_the_example_to_the_end(play_example: Any) -> None:
    played = play_example("gridworld", maxEpisodes=1)
    [lines] = played.recordings
    assert lines[-1]["kind"] == "end"
    assert lines[0]["players"]["you"]["kind"] == "human"
    assert {"kind": "policy", "policy": "agent:Planner"}.items() <= lines[0]["players"]["partner"].items()
    steps = played.steps()
    assert {step["by"] for step in steps[::2]} == {"human"}
    assert {step["players"]["partner"]["by"] for step in steps[1::2]} == {"policy"}
