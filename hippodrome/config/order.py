"""The steps in order, and which of them an event names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from hippodrome.config import values
from hippodrome.config.models import Events
from hippodrome.config.values import FINAL
from hippodrome.model.step_types import type_of


def is_step_key(key: str) -> bool:
    """Whether it is 1, 2, 3 … or finalStep."""
    try:
        return bool(values.step_key(key))
    except ValueError:
        return False


def ordered(keys: Iterable[str]) -> list[str]:
    """By number, finalStep last."""
    return sorted(keys, key=lambda key: (key == FINAL, 0 if key == FINAL else int(key)))


def step_name(key: str) -> str:
    """The step as a message names it."""
    return key if key == FINAL else f"step {key}"


def walk(keys: list[str], pages: Mapping[str, str]) -> list[str]:
    """The keys a participant walks through: finalStep only if it is another page than the last numbered step."""
    same = len(keys) > 1 and keys[-1] == FINAL and pages.get(FINAL) == pages.get(keys[-2])
    return keys[:-1] if same and FINAL in pages else keys


def place(key: str | None, keys: list[str]) -> int | None:
    """Where an event's step stands. The last step may be called finalStep, or as in HIPPO one past the last number."""
    if key in keys:
        return keys.index(key)
    numbers = [int(number) for number in keys if number != FINAL]
    return len(keys) - 1 if key in (FINAL, str(max(numbers, default=0) + 1)) else None


def span(keys: list[str]) -> str:
    """The steps there are, in words: "1 to 4 and finalStep"."""
    numbered = [key for key in keys if key != FINAL]
    words = f"{numbered[0]} to {numbered[-1]}" if len(numbered) > 1 else "".join(numbered)
    return words if numbered == keys else f"{words} and {FINAL}"


def usual_start(games: Sequence[int]) -> int:
    """Where a server starts if nobody says so: at the second step, which nobody reaches without an answer.

    A game that is the first step leaves no choice. `games` are the places of the game steps, from 0.
    """
    return min(1, games[0])


def resolved(events: Events, keys: list[str], pages: Mapping[str, str]) -> Events:
    """The events with defaults, as keys of steps. The events have been checked."""
    start, stop = (place(key, keys) for key in (events.start_server_step, events.stop_server_step))
    games = [index for index, key in enumerate(keys) if type_of(pages[key]).on_server]
    if games:
        start = usual_start(games) if start is None else start
        stop = games[-1] + 1 if stop is None else stop
    return Events.model_validate(
        {
            "startServerStep": None if start is None else keys[start],
            "stopServerStep": None if stop is None else keys[stop],
        }
    )
