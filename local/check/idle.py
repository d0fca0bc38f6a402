"""Finds out whether the idle action, which is taken while no key is pressed, changes the picture.

It runs in the agent's process (`agent_process.py`). If the idle action changes the picture in a state in which another
action does not, the action changed it, and not the game by itself. The same seed and actions lead to the same state.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np

SECONDS = 3.0  # after so many seconds `actions_without_effect` gives up
_STATES = (0, 2, 5, 9)  # each state by its number of steps after a reset
_MAX_ACTIONS = 10


def actions_without_effect(
    begin: Callable[[int], Any], step: Callable[[int], bool], picture: Callable[[], Any], count: int, idle: int
) -> list[int] | None:
    """If the idle action changes the picture in a state where another does not, return the actions that never do.

    Otherwise return None, also if this is not known: the game is random, or the time or the episode was over too soon.
    Only the first `_MAX_ACTIONS` actions are tried, in the states of `_STATES`. If the time or the episode is over
    after such a state was found, the result is what the states before have shown.

    `begin(seed)` begins an episode. `step(action)` takes a step, and returns whether the episode is over. `picture`
    returns the picture. `count` is the number of actions.
    """
    until = time.monotonic() + SECONDS
    random = Random(1)  # noqa: S311 - the same each time
    walk = [random.randrange(count) for _ in range(max(_STATES))]
    others = [action for action in range(min(count, _MAX_ACTIONS)) if action != idle]
    still = set(others)
    found = False
    for state in _STATES:
        seen: dict[int, bool] = {}
        first: Any = None  # the pictures before and after the idle action
        for action in [idle, idle, *others]:
            if time.monotonic() > until:
                return sorted(still) if found else None
            begin(1)
            if any([step(each) for each in walk[:state]]):  # noqa: C419 - all steps are taken
                return sorted(still) if found else None
            before = picture()
            step(action)
            after = picture()
            first = first or (before, after)
            if not same(before, first[0]) or (action == idle and not same(after, first[1])):
                return None  # the game is not the same each time, so nothing can be compared
            seen[action] = not same(before, after)
            if seen[action]:
                still.discard(action)
        found = found or (seen[idle] and not all(seen.values()))
    return sorted(still) if found else None


def same(one: Any, other: Any) -> bool:
    """Return whether two pictures show the same. A picture is a frame, a scene, or a map with one for each player."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return bool(np.array_equal(one, other))
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    return bool(one == other)
