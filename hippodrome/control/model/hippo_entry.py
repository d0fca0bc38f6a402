"""Gives our form to the entries of `project_master_list.json` that HIPPO's function has written. Pure.

HIPPO stores `id`, `name`, `live`, `researcher`, `team_members`, `ecsTask`, `steps` (a map), `events`, `maxRuntime` and
`bucket` as they were sent (IRLL/HIPPO_Gym_AWS, `update_project_master_list.py`). Functions that show pages read such
an entry, so this module imports nothing heavy. A registration by HIPPO's script is read by
`hippodrome.control.config.hippo_registration`, which also makes remarks.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from hippodrome.control.model.step_order import FINAL, default_start, default_stop, position, visited
from hippodrome.control.model.step_types import type_of

SALT = "hippo"
"""The salt of a project whose entry HIPPO wrote: the project's secret is derived from it.

A registration keeps the salt, so tickets and codes stay valid.
"""

USUAL_RUNTIME, MAX_RUNTIME = 60, 1440  # minutes: HIPPO's default, and the most that we take
_PAGE = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9_ .-]{0,98}[A-Za-z0-9_-])?")


def is_from_hippo(entry: Mapping[str, Any]) -> bool:
    """Return whether HIPPO wrote this entry: its steps are a map. In our entries they are a list."""
    return isinstance(entry.get("steps"), dict)


def fields_of(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry as the fields of a `Project`. Raises ValueError if participants could not take part in it."""
    pages = _pages(entry["steps"])
    keys = visited(list(pages), pages)
    if type_of(pages[keys[-1]]).on_server:
        raise ValueError("its last step is the game")
    return {
        "id": entry.get("id"),
        "name": _text(entry.get("name")),
        "researcher": _text(entry.get("researcher")),
        "teamMembers": _texts(entry.get("teamMembers") or entry.get("team_members")),
        "live": bool(entry.get("live")),
        "maxRuntime": _minutes(entry.get("maxRuntime")),
        "useAWS": True,
        "steps": [{"key": key, "page": pages[key]} for key in keys],
        "events": _events(entry, keys, pages),
        "pageFolder": "",
        "salt": SALT,
    }


def _pages(steps: Mapping[str, Any]) -> dict[str, str]:
    """The pages in order, by their keys. Steps without a page are left out, and later steps get lower numbers."""
    numbers = _numbers(steps)
    if numbers != list(range(1, len(numbers) + 1)):
        missing = next(number for number, number_given in enumerate(numbers, 1) if number != number_given)
        raise ValueError(f"it has no step {missing}, but later ones; number the steps without a gap")
    with_page = [number for number in numbers if not _is_blank(steps[str(number)])]
    pages = {str(now): _page(steps[str(number)]) for now, number in enumerate(with_page, 1)}
    if not _is_blank(steps.get(FINAL)):
        pages[FINAL if pages else "1"] = _page(steps[FINAL])
    if not pages:
        raise ValueError("none of its steps has a page")
    return pages


def _numbers(steps: Mapping[str, Any]) -> list[int]:
    return sorted(int(key) for key in steps if re.fullmatch(r"[1-9][0-9]{0,2}", key))


def _events(entry: Mapping[str, Any], keys: list[str], pages: Mapping[str, str]) -> dict[str, str]:
    """The steps at which the server starts and stops. Steps that do not fit the game are replaced by the defaults."""
    games = [index for index, key in enumerate(keys) if type_of(pages[key]).on_server]
    if not games:
        return {}
    events = entry.get("events")
    start, stop = (
        _place(events.get(name) if isinstance(events, dict) else None, entry["steps"], keys)
        for name in ("startServerStep", "stopServerStep")
    )
    start = default_start(games) if start is None or start > games[0] else start
    stop = default_stop(games) if stop is None or stop <= games[-1] else stop
    return {"startServerStep": keys[start], "stopServerStep": keys[stop]}


def _place(event: object, steps: Mapping[str, Any], keys: list[str]) -> int | None:
    """The index in `keys` of the step that this event of HIPPO's names; None if it names no step.

    If the step comes after the last one, the result is the last index.
    """
    text = str(event)
    if text == FINAL:
        return len(keys) - 1
    numbers = _numbers(steps)
    if not re.fullmatch(r"[1-9][0-9]{0,2}", text):
        return None
    before = sum(_is_blank(steps[str(number)]) for number in numbers if number < int(text))
    place = position(str(int(text) - before), keys)
    return len(keys) - 1 if place is None else place


def _page(page: object) -> str:
    name = re.split(r"[/\\]", page)[-1].strip().removesuffix(".html") if isinstance(page, str) else ""
    if not _PAGE.fullmatch(name) or ".." in name:
        raise ValueError("the name of a page cannot stand in addresses and folders on AWS")
    return name


def _minutes(minutes: object) -> int:
    """The maxRuntime in minutes, from a number or its digits as text; `USUAL_RUNTIME` if it is missing."""
    if _is_blank(minutes):
        return USUAL_RUNTIME
    if isinstance(minutes, bool) or not re.fullmatch(r"[1-9][0-9]{0,8}", str(minutes)):
        raise ValueError("its maxRuntime is no number of minutes")
    return min(int(str(minutes)), MAX_RUNTIME)


def _is_blank(value: object) -> bool:
    return value is None or value == ""


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""


def _texts(value: object) -> list[str]:
    values = value if isinstance(value, list) else [value]
    return [text for text in values if isinstance(text, str) and text]
