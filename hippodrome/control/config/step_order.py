"""Names steps in messages, and fills in the default steps of `events`. `control.model.step_order` orders steps."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

from hippodrome.control.config import project_keys
from hippodrome.control.config.project_keys import EventsKeys
from hippodrome.control.model.step_order import FINAL, default_start, default_stop, position
from hippodrome.control.model.step_types import type_of


def is_step_key(key: str) -> bool:
    """Return whether the key is 1, 2, 3 … or finalStep."""
    try:
        return bool(project_keys.step_key(key))
    except ValueError:
        return False


def step_name(key: str) -> str:
    """Return the step's name for messages: "step 3", "finalStep", or its own name."""
    return f"step {key}" if key.isdecimal() else key


def step_range(keys: list[str]) -> str:
    """Return the steps in words: "1 to 4 and finalStep"."""
    if not all(key == FINAL or key.isdecimal() for key in keys):
        return ", ".join(keys)
    numbered = [key for key in keys if key != FINAL]
    words = f"{numbered[0]} to {numbered[-1]}" if len(numbered) > 1 else "".join(numbered)
    return words if numbered == keys else f"{words} and {FINAL}"


def changed_pages(before: Mapping[str, str], after: Mapping[str, str]) -> str:
    """Return the steps whose page has changed, in words: "step 3 is sleep (was rules), step 4 is rules (new)".

    `before` and `after` map keys of steps to pages. Another page of finalStep does not count, since that step has no
    answers. Returns "" if no page has changed.
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


def resolve_events(
    events: EventsKeys, keys: list[str], pages: Mapping[str, str], repeated: Collection[str] = ()
) -> EventsKeys:
    """Return the checked events as keys of steps, with defaults filled in. `repeated` are the steps of blocks."""
    start, stop = (position(key, keys) for key in (events.start_server_step, events.stop_server_step))
    games = [index for index, key in enumerate(keys) if type_of(pages[key]).on_server]
    if games:
        start = default_start(games) if start is None else start
        if stop is None:
            stop = next(at for at in range(default_stop(games), len(keys)) if keys[at] not in repeated)
    return replace(
        events,
        start_server_step=None if start is None else keys[start],
        stop_server_step=None if stop is None else keys[stop],
    )
