"""Participants' ids with which one researcher can play in all places of a game (`project.players`). Pure."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

from hippodrome.control.model import ids

MAX_TRIED = 10_000


def user_ids(
    project_id: str, players: int, matching: str | dict[str, Any], groups: int, new: Callable[[int], str]
) -> list[str]:
    """Return an id for each of the `players`, such that `matching` by groups lets them play together.

    With `group` all ids belong to one group. With `mixed` each belongs to the next group, and after the last group
    comes the first again. `new` makes an id from a number. If `MAX_TRIED` ids do not suffice, the result is shorter.
    """
    new_ids = (new(number) for number in itertools.count(1))
    if not groups or matching not in ("group", "mixed"):
        return list(itertools.islice(new_ids, players))
    user_ids: list[str] = []
    first: int | None = None
    for user_id in itertools.islice(new_ids, MAX_TRIED):
        group = ids.group(project_id, user_id, groups)
        first = group if first is None else first
        step = len(user_ids) if matching == "mixed" else 0
        if group == (first + step) % groups:
            user_ids.append(user_id)
        if len(user_ids) == players:
            break
    return user_ids


def advice(matching: str | dict[str, Any]) -> str:
    """Return what the researcher has to answer, if participants are matched by an answer; otherwise ""."""
    if not isinstance(matching, dict):
        return ""
    how, field = next(iter(matching.items()))
    answers = "the same answer" if how == "same" else "a different answer"
    return f"Give {answers} to the question {field} in each window."
