"""Calls the function `match` of agent.py, which says who plays with whom (`matching: match`)."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from types import ModuleType
from typing import Any

from trial.agent import signatures
from trial.agent.agent import AgentError

NAME = "match"
SECONDS = 5.0
"""A call that takes longer is given up, and `match` is called no more on that server."""


class BadGroups(AgentError):
    """`match` returned something else than groups of those who wait. The message is for the researcher."""


def function_of(module: ModuleType | None) -> Callable[..., Any] | None:
    """The function `match` of agent.py; None if there is none."""
    found = getattr(module, NAME, None)
    return found if callable(found) else None


def in_class(agent: Any) -> bool:
    """Whether `match` is a method of the agent, where it is not looked for."""
    return callable(getattr(agent, NAME, None))


def candidates(question: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What `match` is given: a dict for each participant who waits, in the order in which they came."""
    return [{"waited": 0, "group": None, "answers": {}} | each for each in json.loads(json.dumps(question["waiting"]))]


def groups(function: Callable[..., Any], question: Mapping[str, Any]) -> tuple[list[list[str]], str]:
    """Call it. Return the groups that can be played, and a sentence on what is wrong with the others; "" if nothing is.

    A group holds ids, or the dicts themselves. Raises BadGroups if no groups were returned, and what `match` raises.
    """
    waiting, players = candidates(question), question["players"]
    there = {each["id"] for each in waiting}
    more = {"players": players} if signatures.names(function, "players") else {}
    returned = function(waiting, **more)
    if returned is None or isinstance(returned, str | bytes | Mapping) or not isinstance(returned, Iterable):
        raise BadGroups(f"match() must return a list of groups, and returned {type(returned).__name__}")
    found: list[list[str]] = []
    taken: set[str] = set()
    problem = ""
    for group in returned:
        ids = _ids(group)
        if ids is None:
            raise BadGroups(f"each group that match() returns must be a list of ids; one is {type(group).__name__}")
        wrong = _wrong(ids, players, there, taken)
        if wrong:
            problem = problem or wrong
        else:
            taken.update(ids)
            found.append(ids)
    return found, problem


def _ids(group: Any) -> list[str] | None:
    if isinstance(group, str | bytes | Mapping) or not isinstance(group, Iterable):
        return None
    found: list[str] = []
    for each in group:
        name = each.get("id") if isinstance(each, Mapping) else each
        if not isinstance(name, str):
            return None
        found.append(name)
    return found


def _wrong(ids: list[str], players: int, there: set[str], taken: set[str]) -> str:
    if not there.issuperset(ids):
        return "match() chose an id that is not among those who wait"
    if len(set(ids)) < len(ids):
        return "match() chose a participant twice in one group"
    if len(ids) != players:
        return f"match() made a group of {len(ids)}, and project.players is {players}"
    return "" if taken.isdisjoint(ids) else "match() chose a participant for two groups"
