"""The order of steps, which of them participants visit, and which one an event names. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

FINAL = "finalStep"


def ordered(keys: Iterable[str]) -> list[str]:
    """The keys of steps in their order: by number, finalStep last."""
    return sorted(keys, key=lambda key: (key == FINAL, 0 if key == FINAL else int(key)))


def visited(keys: list[str], pages: Mapping[str, str]) -> list[str]:
    """The keys of the steps that participants visit: finalStep only if it has a page of its own."""
    same = len(keys) > 1 and keys[-1] == FINAL and pages.get(FINAL) == pages.get(keys[-2])
    return keys[:-1] if same and FINAL in pages else keys


def position(key: str | None, keys: list[str]) -> int | None:
    """The index of the step that an event names. The last one may be called finalStep, or, as in HIPPO, one more."""
    if key in keys:
        return keys.index(key)
    numbers = [int(number) for number in keys if number != FINAL]
    return len(keys) - 1 if key in (FINAL, str(max(numbers, default=0) + 1)) else None


def default_start(games: Sequence[int]) -> int:
    """The index of the step at which a server starts by default: the second, which is only reached with an answer.

    If the game is the first step, it is that one. `games` are the indexes of the game steps.
    """
    return min(1, games[0])


def default_stop(games: Sequence[int]) -> int:
    """The index of the step at which a server stops by default: the one after the last game."""
    return games[-1] + 1
