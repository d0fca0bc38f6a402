"""The ids with which one researcher plays in all places of a game."""

from __future__ import annotations

import pytest

from hippodrome.control.model import ids
from hippodrome.local.own_places import advice, user_ids


def groups_of(matching: str, players: int, groups: int, run: int) -> list[int]:
    made = user_ids("maze", players, matching, groups, lambda number: f"try-{run}-{number}")
    assert len(set(made)) == players
    return [ids.group("maze", user, groups) for user in made]


@pytest.mark.parametrize("run", range(8))
def test_the_ids_are_of_groups_that_play_together(run: int) -> None:
    assert len(set(groups_of("group", 3, 4, run))) == 1
    assert len(set(groups_of("mixed", 3, 3, run))) == 3
    assert sorted(map(groups_of("mixed", 4, 2, run).count, (0, 1))) == [2, 2]


@pytest.mark.parametrize(("matching", "groups"), [("arrival", 2), ("group", 0)])
def test_without_groups_the_ids_are_numbered(matching: str, groups: int) -> None:
    assert user_ids("maze", 2, matching, groups, lambda number: f"try-{number}") == ["try-1", "try-2"]


def test_the_answers_that_let_the_ids_play_together_are_printed() -> None:
    assert advice("mixed") == ""
    assert advice({"same": "language"}) == "Give the same answer to the question language in each window."
    assert advice({"different": "role"}) == "Give a different answer to the question role in each window."
