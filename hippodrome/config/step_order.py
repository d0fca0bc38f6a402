"""The steps in order, and which of them an event names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from hippodrome.config import project_keys
from hippodrome.config.project_keys import FINAL, Events
from hippodrome.model.step_types import type_of


def is_step_key(key: str) -> bool:
    """Whether it is 1, 2, 3 … or finalStep."""
    try:
        return bool(project_keys.step_key(key))
    except ValueError:
        return False


def ordered(keys: Iterable[str]) -> list[str]:
    """By number, finalStep last."""
    return sorted(keys, key=lambda key: (key == FINAL, 0 if key == FINAL else int(key)))


def step_name(key: str) -> str:
    """The step as a message names it."""
    return key if key == FINAL else f"step {key}"


def visited(keys: list[str], pages: Mapping[str, str]) -> list[str]:
    """The keys of the steps that participants visit: finalStep only if it has a page of its own."""
    same = len(keys) > 1 and keys[-1] == FINAL and pages.get(FINAL) == pages.get(keys[-2])
    return keys[:-1] if same and FINAL in pages else keys


def position(key: str | None, keys: list[str]) -> int | None:
    """Where an event's step stands. The last step may be called finalStep, or as in HIPPO one past the last number."""
    if key in keys:
        return keys.index(key)
    numbers = [int(number) for number in keys if number != FINAL]
    return len(keys) - 1 if key in (FINAL, str(max(numbers, default=0) + 1)) else None


def step_range(keys: list[str]) -> str:
    """The steps in words: "1 to 4 and finalStep"."""
    numbered = [key for key in keys if key != FINAL]
    words = f"{numbered[0]} to {numbered[-1]}" if len(numbered) > 1 else "".join(numbered)
    return words if numbered == keys else f"{words} and {FINAL}"


def default_start(games: Sequence[int]) -> int:
    """The index of the step at which a server starts by default: the second, which is only reached with an answer.

    If the game is the first step, it is that one. `games` are the indexes of the game steps.
    """
    return min(1, games[0])


def resolve_events(events: Events, keys: list[str], pages: Mapping[str, str]) -> Events:
    """The events with defaults, as keys of steps. The events have been checked."""
    start, stop = (position(key, keys) for key in (events.start_server_step, events.stop_server_step))
    games = [index for index, key in enumerate(keys) if type_of(pages[key]).on_server]
    if games:
        start = default_start(games) if start is None else start
        stop = games[-1] + 1 if stop is None else stop
    return Events.model_validate(
        {
            "startServerStep": None if start is None else keys[start],
            "stopServerStep": None if stop is None else keys[stop],
        }
    )
