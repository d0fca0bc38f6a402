"""examples/two-players: the rules of the garden, the helper that takes an empty place, and a picture for each player."""

from __future__ import annotations

from typing import Any

import pytest

STEPS = 6 * 60  # steps of a round


@pytest.fixture
def modules(load_module: Any) -> tuple[Any, Any, Any]:
    """The modules lanterns, helper and agent."""
    return tuple(load_module("two-players", name) for name in ("lanterns", "helper", "agent"))  # type: ignore[return-value]


class Still:
    """A participant who does nothing."""

    def act(self, observation: dict[str, Any], info: dict[str, Any]) -> int:
        return 0


def lanterns_lit(modules: Any, seed: int, red: Any, blue: Any) -> tuple[int, int]:
    """Play a round; return how many lanterns were lit, and after how many steps it ended."""
    agent = modules[2].Agent()
    agent.start("lanterns")
    observations, infos = agent.reset(seed)
    who = {"red": red, "blue": blue}
    points = 0.0
    for step in range(1, STEPS + 1):
        actions = {player: who[player].act(observations[player], infos[player]) for player in who}
        observations, rewards, over, _, infos = agent.step(actions)
        assert rewards["red"] == rewards["blue"]
        points += rewards["red"]
        if over["__all__"]:
            return int(points), step
    return int(points), STEPS


def helper(modules: Any, player: str) -> Any:
    found = modules[1].Helper(player)
    found.reset(1)
    return found


def test_two_helpers_light_all_lanterns_in_every_garden(modules: Any) -> None:
    for seed in range(40):
        points, steps = lanterns_lit(modules, seed, helper(modules, "red"), helper(modules, "blue"))
        assert points == modules[0].LANTERNS
        assert steps < STEPS / 2


def test_one_player_alone_lights_no_lantern(modules: Any) -> None:
    assert [lanterns_lit(modules, seed, helper(modules, "red"), Still())[0] for seed in range(5)] == [0] * 5


def test_a_lantern_is_lit_when_both_stand_on_the_plates_which_then_move(modules: Any) -> None:
    garden = modules[0].Garden(1)
    first, second = before = garden.plates
    garden.places = {"red": first, "blue": first}
    assert (garden.move({"red": 0, "blue": 0}), garden.plates) == (0.0, before)
    garden.places = {"red": second, "blue": first}
    assert garden.move({"red": 0, "blue": 0}) == 1.0
    assert not set(garden.plates) & {first, second}


def test_players_walk_through_each_other_but_not_through_hedges_or_the_border(modules: Any) -> None:
    garden = modules[0].Garden(1)
    garden.hedges = frozenset({(1, 5)})
    garden.move({"red": 2, "blue": 1})
    assert garden.places == {"red": (0, 5), "blue": (8, 0)}
    garden.places = {"red": (4, 3), "blue": (5, 3)}
    garden.move({"red": 2, "blue": 4})
    assert garden.places == {"red": (5, 3), "blue": (4, 3)}


def test_each_player_sees_who_they_are(modules: Any) -> None:
    agent = modules[2].Agent()
    agent.start("lanterns")
    agent.reset(1)
    red, blue = agent.render("red"), agent.render("blue")
    assert (red["hud"], blue["hud"]) == ("You are red. 0 of 12 lanterns lit", "You are blue. 0 of 12 lanterns lit")
    rings = [next(each for each in picture["objects"] if each["id"] == "you") for picture in (red, blue)]
    assert rings[0]["x"] < 100 < 500 < rings[1]["x"]
