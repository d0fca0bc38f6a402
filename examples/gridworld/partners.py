"""Two partners for the participant: one that plans for both players, and one that goes for the nearest acorn."""

from __future__ import annotations

import time
from functools import cache
from typing import Any

from forest import MOVES, Place, distances

THINKING_SECONDS = 0.4
"""The time for which a partner waits before each move, so that people see one move after the other."""


class Planner:
    """Divides the acorns so that all are collected soonest, supposing that the other player keeps to the same plan."""

    def act(self, observation: dict[str, Any], info: dict[str, Any]) -> int:
        time.sleep(THINKING_SECONDS)
        return step_towards(observation, info, first_of_plan(observation))


class Nearest:
    """Goes for the acorn that is nearest to it, whatever the other player does."""

    def act(self, observation: dict[str, Any], info: dict[str, Any]) -> int:
        time.sleep(THINKING_SECONDS)
        away = distances(observation["me"], observation["trees"])
        return step_towards(observation, info, min(observation["acorns"], key=lambda acorn: (away[acorn], acorn)))


def first_of_plan(observation: dict[str, Any]) -> Place | None:
    """Return the acorn to fetch first; None if the plan leaves all acorns to the other player.

    The plan is the division of the acorns with which all are collected soonest. Of equal divisions it is the one with
    which the players walk least.
    """
    acorns, trees = sorted(observation["acorns"]), observation["trees"]
    between = [distances(acorn, trees) for acorn in acorns]
    everything = (1 << len(acorns)) - 1

    @cache
    def onward(at: int, left: int) -> int:
        """Return the fewest moves from acorn `at` through all acorns of the set `left`."""
        return min(
            (between[at][acorns[to]] + onward(to, left & ~(1 << to)) for to in _members(left)),
            default=0,
        )

    def tour(start: Place, left: int) -> tuple[int, int | None]:
        """Return the fewest moves from a place through all acorns of the set `left`, and the first of them."""
        ways = ((between[to][start] + onward(to, left & ~(1 << to)), to) for to in _members(left))
        return min(ways, default=(0, None))

    def costs(mine: int) -> tuple[int, int]:
        me, other = tour(observation["me"], mine)[0], tour(observation["other"], everything & ~mine)[0]
        return max(me, other), me + other

    mine = min(range(everything + 1), key=costs)
    first = tour(observation["me"], mine)[1]
    return None if first is None else acorns[first]


def _members(numbers: int) -> list[int]:
    """Return the members of a set. The set is a number: its bit n says whether n is a member."""
    return [bit for bit in range(numbers.bit_length()) if numbers >> bit & 1]


def step_towards(observation: dict[str, Any], info: dict[str, Any], acorn: Place | None) -> int:
    """Return the legal move after which the acorn is nearest; without an acorn to fetch, the move `wait`."""
    if acorn is None:
        return 0
    away = distances(acorn, observation["trees"])
    column, row = observation["me"]
    legal = [move for move, allowed in enumerate(info["action_mask"]) if allowed]
    return min(legal, key=lambda move: (away[column + MOVES[move][0], row + MOVES[move][1]], move))
