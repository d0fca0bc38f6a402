"""Orders the keys of steps, and finds the steps that participants visit and the step that an event names. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

FINAL = "finalStep"


def ordered(keys: Iterable[str]) -> list[str]:
    """Return the keys of steps in the order of their numbers, finalStep last; names stay as they are."""
    keys = list(keys)
    if not all(key == FINAL or key.isdecimal() for key in keys):
        return keys
    return sorted(keys, key=lambda key: (key == FINAL, 0 if key == FINAL else int(key)))


def visited(keys: list[str], pages: Mapping[str, str]) -> list[str]:
    """Return the keys of the steps that participants visit.

    If finalStep has the same page as the step before, it is left out.
    """
    same = len(keys) > 1 and keys[-1] == FINAL and pages.get(FINAL) == pages.get(keys[-2])
    return keys[:-1] if same and FINAL in pages else keys


def position(key: str | None, keys: list[str]) -> int | None:
    """Return the index of the step that an event names; None if no step is meant.

    The last step may also be named finalStep, or, as in HIPPO, by the number after the last.
    """
    if key in keys:
        return keys.index(key)
    numbers = [int(number) for number in keys if number.isdecimal()]
    return len(keys) - 1 if key in (FINAL, str(max(numbers, default=0) + 1)) else None


def default_start(games: Sequence[int]) -> int:
    """Return the index of the step at which a server starts by default.

    It is the second step, which only an answer leads to; but the first one if that is a game. `games` are the indexes
    of the game steps.
    """
    return min(1, games[0])


def default_stop(games: Sequence[int]) -> int:
    """Return the index of the step at which a server stops by default: the step after the last game step."""
    return games[-1] + 1
