"""The questions to the function `match` of agent.py (`matching: match`), and its answers. Pure: no clock, no I/O.

Researchers' code runs on servers alone. So the participants who wait are written into a document,
`_match/{projectId}/waiting.json`, which servers without members read. Each question has an id. Its answer is a document
of its own, `{projectId}/lobby/groups/{id}.json`, which the first of these servers creates. A question stays unchanged
until it is answered, or for `ANSWERED_WITHIN`. A participant who comes in this time is kept beside it, in `came`, for
the next question. So an answer fits the question in the document, however many participants come.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import msgspec

from hippodrome.control.lobby.entries import Waiting, seconds_since
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import Record, from_json, to_json

WAITED_STEPS = 5
"""Waiting times in a question are rounded down to a multiple of so many seconds. After so many, it is asked again."""
ANSWERED_WITHIN = timedelta(seconds=10)
"""A question without an answer is asked again after this time: servers look every two seconds, `match` has five."""
MAX_WAITING = 200
"""The most participants in one question. If more wait, the question has the participants who came first."""
MAX_CAME = 200
"""The most further participants in the document. Others are added by a later request, when there is room."""
MAX_ANSWERS = 16 * 1024
"""The most bytes of a candidate with their answers. If there are more, the answers are left out."""


class Candidate(Record, frozen=True):
    """A participant who waits, as `match` gets them. `id` is their label; `waited` is in seconds."""

    id: str
    waited: int = 0
    group: int | None = None
    answers: dict[str, Any] = msgspec.field(default_factory=dict)


class Question(Record, frozen=True):
    """The document with the question: `waiting` may be matched now; `came` are participants for the next question."""

    id: str = ""
    players: int = 0
    asked: datetime | None = None
    waiting: tuple[Candidate, ...] = ()
    came: tuple[Candidate, ...] = ()

    def candidates(self) -> dict[str, Candidate]:
        """Return all participants in the document, in the question or in `came`, by label."""
        return {person.id: person for person in (*self.waiting, *self.came)}


class _Groups(msgspec.Struct, frozen=True):
    groups: list[list[str]]


@dataclass(frozen=True)
class MatchAnswer:
    """The possible sessions in an answer. `problem` says what is wrong with the first impossible one, if any."""

    sessions: Sequence[Sequence[str]] = ()
    problem: str = ""


def candidate(label: str, group: int | None, answers: dict[str, Any]) -> Candidate:
    """Return what `match` gets of a participant who comes. Answers that are too large are left out."""
    candidate = Candidate(label, group=group, answers=answers)
    return candidate if len(to_json(candidate)) <= MAX_ANSWERS else Candidate(label, group=group)


def with_candidate(question: Question, candidate: Candidate) -> Question:
    """Return the document with this participant added to `came`, for the next question.

    It is unchanged if the participant is in the document, or if `came` has `MAX_CAME` participants already.
    """
    if candidate.id in question.candidates() or is_full(question):
        return question
    return msgspec.structs.replace(question, came=(*question.came, candidate))


def is_full(question: Question) -> bool:
    """Return whether no other participant can be added to the document before the next question."""
    return len(question.came) >= MAX_CAME


def read(body: bytes, question: Question) -> MatchAnswer:
    """Read the answer to `question` in a document that a server has written. The document may hold anything."""
    try:
        groups = from_json(body, _Groups).groups
    except ValueError:
        return MatchAnswer(problem="the answer of match cannot be read")
    ids, matched, sessions, problem = {person.id for person in question.waiting}, set[str](), [], ""
    for labels in groups[:MAX_WAITING]:
        if len(labels) != question.players or len(set(labels)) != len(labels):
            problem = problem or f"match chose other members than {question.players} different participants"
        elif not ids.issuperset(labels):
            problem = problem or "match chose a participant who does not wait"
        elif not matched.isdisjoint(labels):
            problem = problem or "match chose a participant for two sessions"
        else:
            matched.update(labels)
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
    """Return the question to ask now: `question` unchanged, or a new one about the participants who are `free`.

    `waiting`: the labels of all participants who wait; others are dropped from the document. `matched`: the labels in
    the answer to `question`. The new question leaves them out; a later one has them again if they are still free.
    """
    candidates = {label: candidate for label, candidate in question.candidates().items() if label in waiting}
    next_asked = sorted(
        (person for person in free if person.label in candidates and person.label not in matched),
        key=lambda person: person.order,
    )
    next_asked = next_asked[:MAX_WAITING]
    if not _is_due(question, project, {person.label for person in next_asked}, answered=answered, now=now):
        return question
    in_question = tuple(
        msgspec.structs.replace(candidates[person.label], waited=_waited(person, now)) for person in next_asked
    )
    labels = {candidate.id for candidate in in_question}
    rest = tuple(
        msgspec.structs.replace(candidate, waited=0) for label, candidate in candidates.items() if label not in labels
    )
    next_one = Question(players=project.players, asked=now, waiting=in_question, came=rest)
    return msgspec.structs.replace(next_one, id=hashlib.sha256(to_json(next_one)).hexdigest()[:20])


def _is_due(question: Question, project: Project, free: set[str], *, answered: bool, now: datetime) -> bool:
    """Whether another question should replace this one. `free`: the labels of the participants it would have."""
    age = now - question.asked if question.asked else timedelta.max
    is_new = free != {person.id for person in question.waiting}
    if len(question.waiting) < project.players:  # too few for a session, so no server answers it
        return is_new
    if not answered and age < ANSWERED_WITHIN:
        return False
    return is_new or age >= timedelta(seconds=WAITED_STEPS)


def _waited(waiting: Waiting, now: datetime) -> int:
    seconds = int(seconds_since(waiting.joined, now))
    return seconds - seconds % WAITED_STEPS
