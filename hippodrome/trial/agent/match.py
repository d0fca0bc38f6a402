"""Calls the function `match` of agent.py, which says who plays with whom (`matching: match`)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping
from types import ModuleType
from typing import Any

from hippodrome.trial.agent import signatures
from hippodrome.trial.agent.loading import AgentError

NAME = "match"
SECONDS = 5.0
"""The limit of a call, in seconds. If it takes longer, it is given up, and that server calls `match` no more."""


class BadGroups(AgentError):
    """`match` returned something else than groups of ids or of candidates. The message is for the researcher."""


def function_of(module: ModuleType | None) -> Callable[..., Any] | None:
    """Return the function `match` of agent.py; None if there is none."""
    function = getattr(module, NAME, None)
    return function if callable(function) else None


def in_class(agent: Any) -> bool:
    """Whether the agent has a method `match`, which is never called: `match` must be a function of agent.py."""
    return callable(getattr(agent, NAME, None))


def candidates(question: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Build the argument of `match`: a dict for each participant who waits, in the order in which they came."""
    return [{"waited": 0, "group": None, "answers": {}} | each for each in copy.deepcopy(question["waiting"])]


def groups(function: Callable[..., Any], question: Mapping[str, Any]) -> tuple[list[list[str]], str]:
    """Call `match`. Return the groups that can be played, as lists of ids, and a sentence about the first other group.

    The sentence is empty if all groups can be played. `match` may return ids or the candidates themselves. Raises
    BadGroups if it returned anything else, and what `match` raises.
    """
    waiting, players = candidates(question), question["players"]
    waiting_ids = {person["id"] for person in waiting}
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
        fault = _fault(ids, players, waiting_ids, taken)
        if fault:
            problem = problem or fault
        else:
            taken.update(ids)
            found.append(ids)
    return found, problem


def _ids(group: Any) -> list[str] | None:
    """Return the ids of a group; None if it is no list of ids or candidates."""
    if isinstance(group, str | bytes | Mapping) or not isinstance(group, Iterable):
        return None
    ids: list[str] = []
    for each in group:
        name = each.get("id") if isinstance(each, Mapping) else each
        if not isinstance(name, str):
            return None
        ids.append(name)
    return ids


def _fault(ids: list[str], players: int, waiting_ids: set[str], taken: set[str]) -> str:
    """Return why the group cannot be played, in a sentence for the researcher; empty if it can."""
    if not waiting_ids.issuperset(ids):
        return "match() chose an id that is not among those who wait"
    if len(set(ids)) < len(ids):
        return "match() chose a participant twice in one group"
    if len(ids) != players:
        return f"match() made a group of {len(ids)}, and project.players is {players}"
    return "" if taken.isdisjoint(ids) else "match() chose a participant for two groups"
