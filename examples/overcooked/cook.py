"""A cook by rules, from whom the policy of this study learns (`train.py`).

From the state of the kitchen the cook decides what to fetch or bring, and walks there around the other chef. The cook
remembers nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator

from kitchen import NOOP, PICKUP, POT_HOLDS, STEPS, Cell, Kitchen


def act(kitchen: Kitchen, chef: int) -> int:
    """Return the best action of this chef."""
    for wanted in _targets(kitchen, chef):
        action = _towards(kitchen, chef, wanted)
        if action is not None:
            return action
    return NOOP


def _targets(kitchen: Kitchen, number: int) -> Iterator[frozenset[Cell]]:
    """Yield sets of cells to walk to and use, the best set first.

    A set counts only if no cell of an earlier set can be reached.
    """
    me, other = kitchen.chefs[number], kitchen.chefs[1 - number]
    filling = [cell for cell, (onions, _) in kitchen.pots.items() if onions < POT_HOLDS]
    full = {cell: timer for cell, (onions, timer) in kitchen.pots.items() if onions == POT_HOLDS}
    lying, fixed = _places(kitchen.lying), _places(kitchen.fixed)
    free = frozenset(cell for cell in fixed("counter") if cell not in kitchen.lying)
    if me.holds == "onion_soup":
        yield fixed("delivery_zone")
    elif me.holds == "plate":
        if full:
            yield frozenset(full)
        yield free  # no pot is full: the hands are needed for onions
    elif me.holds == "onion":
        if filling:
            yield frozenset(filling)
        yield free
    else:
        if lying("onion_soup"):
            yield lying("onion_soup")
        plates_wanted = len(full) - (other.holds == "plate")
        if plates_wanted > 0:
            yield fixed("plate_stack") | lying("plate")
        onions_wanted = sum(POT_HOLDS - kitchen.pots[cell][0] for cell in filling) - (other.holds == "onion")
        if onions_wanted > 0 or not full:
            yield fixed("onion_stack") | lying("onion")
        # What lies on the floor is in the way.
        yield frozenset(cell for cell in kitchen.lying if cell not in kitchen.fixed)


def _places(things: dict[Cell, str]) -> Callable[[str], frozenset[Cell]]:
    return lambda name: frozenset(cell for cell, thing in things.items() if thing == name)


def _towards(kitchen: Kitchen, number: int, wanted: frozenset[Cell]) -> int | None:
    """Return the action that uses a wanted cell ahead, or else the first step of the shortest way to a wanted cell.

    The way leads around the other chef; if there is no such way, through them, since they may go. Return None if there
    is no way at all.
    """
    me, other = kitchen.chefs[number], kitchen.chefs[1 - number]
    if not wanted:
        return None
    if me.ahead in wanted:
        return NOOP if _cooks(kitchen, me.ahead) and me.holds == "plate" else PICKUP
    for blocked in ({other.cell}, set[Cell]()):
        step = _first_step(kitchen, me.cell, wanted, blocked)
        if step is not None:
            return step
    return None


def _cooks(kitchen: Kitchen, cell: Cell) -> bool:
    onions, timer = kitchen.pots.get(cell, (0, 0))
    return onions == POT_HOLDS and timer > 0


def _first_step(kitchen: Kitchen, start: Cell, wanted: frozenset[Cell], blocked: Iterable[Cell]) -> int | None:
    closed = {start, *blocked, *kitchen.fixed, *kitchen.lying}
    ways: deque[tuple[Cell, int | None]] = deque([(start, None)])
    while ways:
        cell, first = ways.popleft()
        for action, (down, right) in STEPS.items():
            ahead = cell[0] + down, cell[1] + right
            if ahead in wanted:  # the last step turns the chef towards it
                return action if first is None else first
            if ahead not in closed and 0 <= ahead[0] < kitchen.size[0] and 0 <= ahead[1] < kitchen.size[1]:
                closed.add(ahead)
                ways.append((ahead, action if first is None else first))
    return None
