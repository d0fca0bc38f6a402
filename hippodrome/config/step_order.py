"""Steps as messages name them, and what events name by default; `hippodrome.model.step_order` has their order."""

from __future__ import annotations

from collections.abc import Mapping

from hippodrome.config import project_keys
from hippodrome.config.project_keys import EventsKeys
from hippodrome.model.step_order import FINAL, default_start, default_stop, position
from hippodrome.model.step_types import type_of


def is_step_key(key: str) -> bool:
    """Whether it is 1, 2, 3 … or finalStep."""
    try:
        return bool(project_keys.step_key(key))
    except ValueError:
        return False


def step_name(key: str) -> str:
    """The step as a message names it."""
    return key if key == FINAL else f"step {key}"


def step_range(keys: list[str]) -> str:
    """The steps in words: "1 to 4 and finalStep"."""
    numbered = [key for key in keys if key != FINAL]
    words = f"{numbered[0]} to {numbered[-1]}" if len(numbered) > 1 else "".join(numbered)
    return words if numbered == keys else f"{words} and {FINAL}"


def changed_pages(before: Mapping[str, str], after: Mapping[str, str]) -> str:
    """Which steps have another page than before, in words: "step 3 is sleep (was rules), step 4 is rules (new)".

    Both map keys of steps to pages. Empty if no answer can come from another page: a final step has other words only.
    """
    words = [
        f"{step_name(key)} is {page} {_was(before.get(key))}"
        for key, page in after.items()
        if _moved(key, page, before)
    ]
    words += [f"{step_name(key)} is gone (was {page})" for key, page in before.items() if key not in after]
    return ", ".join(words)


def _moved(key: str, page: str, before: Mapping[str, str]) -> bool:
    return before.get(key) != page and not (key == FINAL and key in before)


def _was(page: str | None) -> str:
    return "(new)" if page is None else f"(was {page})"


def resolve_events(events: EventsKeys, keys: list[str], pages: Mapping[str, str]) -> EventsKeys:
    """The events with defaults, as keys of steps. The events have been checked."""
    start, stop = (position(key, keys) for key in (events.start_server_step, events.stop_server_step))
    games = [index for index, key in enumerate(keys) if type_of(pages[key]).on_server]
    if games:
        start = default_start(games) if start is None else start
        stop = default_stop(games) if stop is None else stop
    return EventsKeys.model_validate(
        {
            "startServerStep": None if start is None else keys[start],
            "stopServerStep": None if stop is None else keys[stop],
        }
    )
