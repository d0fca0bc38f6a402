"""What the function `match` of agent.py is asked (`matching: match`), and its answers. Pure: no clock, no I/O.

The researcher's code runs on servers alone. So who waits is written into a document, `_match/{projectId}/waiting.json`,
which servers without members look at. Each question has an id, and its answer a document of its own,
`{projectId}/lobby/groups/{id}.json`, which the first of them creates. A question stays as it is until it is answered,
or for `ANSWERED_WITHIN`. A participant who comes meanwhile stands beside it, for the next question. So an answer fits
what the document still says, however many participants come.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import msgspec

from hippodrome.lobby.entries import Waiting, seconds_since
from hippodrome.model.project import Project
from hippodrome.model.records import Record, from_json, to_json

WAITED_STEPS = 5
"""Seconds. How long a participant has waited is told in steps of so many, and asked again as often."""
ANSWERED_WITHIN = timedelta(seconds=10)
"""A question without an answer is asked anew after this: a server looks every two seconds, and `match` has five."""
MOST_WAITING = 200
"""Participants in one question: those who came first."""
MOST_CAME = 200
"""Further participants in the document. One who comes then is written down when there is room: the page asks again."""
MOST_ANSWERS = 16 * 1024
"""Bytes of one participant's answers. Larger ones are left out."""


class Candidate(Record, frozen=True):
    """A participant who waits, as `match` is told. `id` is their label; `waited` is in seconds."""

    id: str
    waited: int = 0
    group: int | None = None
    answers: dict[str, Any] = msgspec.field(default_factory=dict)


class Question(Record, frozen=True):
    """The document that `match` is asked with. `came` are participants who came later, for the next question."""

    id: str = ""
    players: int = 0
    asked: datetime | None = None
    waiting: tuple[Candidate, ...] = ()
    came: tuple[Candidate, ...] = ()

    def candidates(self) -> dict[str, Candidate]:
        """All participants in the document, by label."""
        return {each.id: each for each in (*self.waiting, *self.came)}


class _Groups(msgspec.Struct, frozen=True):
    groups: list[list[str]]


@dataclass(frozen=True)
class MatchAnswer:
    """The sessions of an answer that can be played, and a sentence for the researcher on what is wrong with others."""

    sessions: Sequence[Sequence[str]] = ()
    problem: str = ""


def candidate(label: str, group: int | None, answers: dict[str, Any]) -> Candidate:
    """The candidate for a participant who comes. Answers that are too large are left out."""
    found = Candidate(label, group=group, answers=answers)
    return found if len(to_json(found)) <= MOST_ANSWERS else Candidate(label, group=group)


def with_candidate(question: Question, one: Candidate) -> Question:
    """The document with this participant, for the next question; unchanged if `MOST_CAME` stand in it already."""
    if one.id in question.candidates() or is_full(question):
        return question
    return msgspec.structs.replace(question, came=(*question.came, one))


def is_full(question: Question) -> bool:
    """Whether the document has no room for another participant before the next question."""
    return len(question.came) >= MOST_CAME


def read(body: bytes, question: Question) -> MatchAnswer:
    """The answer in a document that a server has written, and that may hold anything."""
    try:
        found = from_json(body, _Groups).groups
    except (ValueError, RecursionError):
        return MatchAnswer(problem="the answer of match cannot be read")
    asked, taken, sessions, problem = {each.id for each in question.waiting}, set[str](), [], ""
    for labels in found[:MOST_WAITING]:
        if len(labels) != question.players or len(set(labels)) != len(labels):
            problem = problem or f"match chose other members than {question.players} different participants"
        elif not asked.issuperset(labels):
            problem = problem or "match chose a participant who does not wait"
        elif not taken.isdisjoint(labels):
            problem = problem or "match chose a participant for two sessions"
        else:
            taken.update(labels)
            sessions.append(labels)
    return MatchAnswer(sessions, problem)


def next_question(
    question: Question,
    project: Project,
    waiting: Collection[str],
    free: Iterable[Waiting],
    *,
    answered: bool,
    matched: Collection[str],
    now: datetime,
) -> Question:
    """What is asked now: `question` as it is, or a new one of those who are `free`.

    `waiting`: the labels of all who wait; a participant who is not among them is forgotten. `matched`: those whom the
    answer to `question` matches; they are asked about again only if they stay free.
    """
    candidates = {label: each for label, each in question.candidates().items() if label in waiting}
    asked = sorted(
        (one for one in free if one.label in candidates and one.label not in matched), key=lambda one: one.order
    )
    asked = asked[:MOST_WAITING]
    if not _is_due(question, project, {one.label for one in asked}, answered=answered, now=now):
        return question
    told = tuple(msgspec.structs.replace(candidates[one.label], waited=_waited(one, now)) for one in asked)
    labels = {each.id for each in told}
    rest = tuple(msgspec.structs.replace(each, waited=0) for label, each in candidates.items() if label not in labels)
    made = Question(players=project.players, asked=now, waiting=told, came=rest)
    return msgspec.structs.replace(made, id=hashlib.sha256(to_json(made)).hexdigest()[:20])


def _is_due(question: Question, project: Project, free: set[str], *, answered: bool, now: datetime) -> bool:
    """Whether it is time for another question."""
    age = now - question.asked if question.asked else timedelta.max
    is_new = free != {each.id for each in question.waiting}
    if len(question.waiting) < project.players:  # no session can be made of them, and no server is asked
        return is_new
    if not answered and age < ANSWERED_WITHIN:
        return False
    return is_new or age >= timedelta(seconds=WAITED_STEPS)


def _waited(one: Waiting, now: datetime) -> int:
    seconds = int(seconds_since(one.joined, now))
    return seconds - seconds % WAITED_STEPS
