"""Chooses which of the participants who wait play together: by arrival, by traits, or as `match` has chosen. Pure.

Here a session is a sequence of its members, in the order of their arrival. A participant's trait decides who may play
with whom (`matching` in config.yml).
"""

from __future__ import annotations

import hashlib
import heapq
import hmac
import json
import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any

from hippodrome.control.lobby.entries import NO_TRAIT, Waiting, milliseconds
from hippodrome.control.model.matching import field_of
from hippodrome.control.model.project import Project

PROPOSED_AT_ONCE = 50
"""The most sessions that one run proposes, so that a crowd makes no function slow. The next run proposes more."""
TRAIT_LENGTH = 10  # hex digits


def patience_is_over(joined: int, project: Project, now: datetime) -> bool:
    """Return whether a participant who came at `joined` (ms) has waited for `patience` seconds."""
    return milliseconds(now) - joined >= round(project.patience * 1000)


def choose(
    free: Sequence[Waiting], project: Project, now: datetime, chosen: Sequence[Sequence[str]]
) -> list[Sequence[Waiting]]:
    """Return the sessions to propose, at most `PROPOSED_AT_ONCE`.

    `free` are the participants who are in no session, in the order of arrival. `chosen` are the sessions that the
    function `match` has chosen, each as its members' labels.
    """
    over = [person for person in free if patience_is_over(person.joined, project, now)]
    with_policies = project.after_patience == "policies"
    candidates = (
        free if with_policies else [person for person in free if not patience_is_over(person.joined, project, now)]
    )
    if project.asks_match:
        sessions = _of_match(candidates, project, chosen)
    elif _together(project):
        sessions = _of_one_trait(candidates, project.players)
    else:
        sessions = list(_of_different_traits(candidates, project))
    sessions = sessions[:PROPOSED_AT_ONCE]
    if with_policies:
        sessions += _short_sessions(candidates, over, sessions, project)
    return sessions[:PROPOSED_AT_ONCE]


def _of_match(free: Sequence[Waiting], project: Project, chosen: Sequence[Sequence[str]]) -> list[Sequence[Waiting]]:
    """The chosen sessions that have `players` different members, all of whom are free."""
    waiting = {person.label: person for person in free}
    sessions: list[Sequence[Waiting]] = []
    for labels in chosen:
        if len(set(labels)) == project.players and all(label in waiting for label in labels):
            members = [waiting.pop(label) for label in dict.fromkeys(labels)]
            sessions.append(members if project.seats == "match" else sorted(members, key=lambda member: member.order))
    return sessions


def _of_one_trait(free: Sequence[Waiting], players: int) -> list[Sequence[Waiting]]:
    """Full sessions, each of one trait, in the order of arrival."""
    by_trait: dict[str, list[Waiting]] = {}
    for person in free:
        by_trait.setdefault(person.trait, []).append(person)
    sessions = [
        people[start : start + players]
        for people in by_trait.values()
        for start in range(0, len(people) - players + 1, players)
    ]
    return sorted(sessions, key=lambda members: members[0].order)


def _of_different_traits(free: Sequence[Waiting], project: Project) -> Iterator[Sequence[Waiting]]:
    """Full sessions, in the order of arrival. In none of them is a trait more often than it may be."""
    most = _most_of_one(project)
    by_trait: dict[str, deque[Waiting]] = {}
    for person in free:
        by_trait.setdefault(person.trait, deque()).append(person)
    heads = [(people[0].order, trait) for trait, people in by_trait.items()]  # in the order of arrival, so it is a heap
    while heads:
        members: list[Waiting] = []
        spent: list[str] = []  # the traits of which this session may have no further member
        count: dict[str, int] = {}
        while heads and len(members) < project.players:
            _, trait = heapq.heappop(heads)
            members.append(by_trait[trait].popleft())
            count[trait] = count.get(trait, 0) + 1
            if count[trait] >= most:
                spent.append(trait)
            elif by_trait[trait]:
                heapq.heappush(heads, (by_trait[trait][0].order, trait))
        if len(members) < project.players:
            return
        yield sorted(members, key=lambda member: member.order)
        for trait in spent:
            if by_trait[trait]:
                heapq.heappush(heads, (by_trait[trait][0].order, trait))


def _short_sessions(
    free: Sequence[Waiting], over: Sequence[Waiting], sessions: Iterable[Sequence[Waiting]], project: Project
) -> list[Sequence[Waiting]]:
    """A session for each participant in `over` without one, at most `PROPOSED_AT_ONCE`: with free ones, or alone."""
    labels = {member.label for members in sessions for member in members}
    short: list[Sequence[Waiting]] = []
    for person in over:
        if person.label in labels or len(short) == PROPOSED_AT_ONCE:
            continue
        members = around(person, [other for other in free if other.label not in labels], project)
        labels |= {member.label for member in members}
        short.append(members)
    return short


def around(waiting: Waiting, free: Iterable[Waiting], project: Project) -> list[Waiting]:
    """Return this participant and others who may play with them, in the order of arrival.

    There are at most `players`, and fewer if not enough fit.
    """
    members, most = [waiting], None if _together(project) else _most_of_one(project)
    for other in free:
        if len(members) == project.players:
            break
        same = sum(other.trait == member.trait for member in members)
        fits = other.trait == waiting.trait if most is None else same < most
        if other.label != waiting.label and fits:
            members.append(other)
    return sorted(members, key=lambda member: member.order)


# Traits


def trait(project: Project, group: int | None, answers: Mapping[str, Any]) -> str:
    """Return the participant's trait: a hash of the answer or of the group by which `matching` matches.

    Participants without an answer have the same trait as each other.
    """
    if (field := field_of(project.matching)) is not None:
        return _hash(project, answers.get(field))
    return _hash(project, group) if project.matching in ("group", "mixed") else NO_TRAIT


def _together(project: Project) -> bool:
    """Whether the members of a session must have the same trait; if not, they must have different ones."""
    if isinstance(project.matching, dict):
        return "same" in project.matching
    return project.matching != "mixed"


def _most_of_one(project: Project) -> int:
    """How many members of a session may have the same trait if members must have different ones.

    This is one. But with `matching: mixed` and fewer groups than players, several members must share a group: then it
    is the number of players divided by the number of groups, rounded up.
    """
    mixed = project.matching == "mixed" and project.groups
    return math.ceil(project.players / project.groups) if mixed else 1


def _hash(project: Project, value: Any) -> str:
    """The keyed hash of a value. A listing shows it, and only with the project's secret the value can be guessed."""
    normalised = value.strip().casefold() if isinstance(value, str) else value
    text = json.dumps(normalised, sort_keys=True, default=str)
    return hmac.new(project.secret.encode(), f"trait\0{text}".encode(), hashlib.sha256).hexdigest()[:TRAIT_LENGTH]
