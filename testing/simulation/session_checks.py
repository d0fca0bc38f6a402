"""Checks the sessions of a simulated installation by its documents and by the requests of its participants."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta

from hippodrome.control.model.project import Project
from hippodrome.control.model.sessions import read_membership
from hippodrome.protocol.keys import answer_key, membership_key
from testing.simulation.lobby import StoredDocuments, formed
from testing.simulation.members import SimulatedMember

PRESENT = timedelta(seconds=10)  # a participant counts as present for so long after a request
ANSWERS = timedelta(seconds=30)  # a request may take so long; those present at its beginning count


def faults(documents: StoredDocuments, project: Project, people: Sequence[SimulatedMember]) -> list[str]:
    """Return a sentence for each fault. It begins with the kind of fault: "split:", "merged:" or "ghost:"."""
    return [
        *_split(documents, project, people),
        *_merged(documents, project),
        *_ghosts(documents, project, people),
        *_answers(documents, project),
    ]


def _split(documents: StoredDocuments, project: Project, people: Sequence[SimulatedMember]) -> Iterator[str]:
    """Compare the members in the sessions' documents with the membership that each participant has."""
    members = {(member.user_id, one.id) for one in formed(documents, project) for member in one.members}
    memberships_found = set()
    for user in {person.visit.user for person in people}:
        if stored := documents.get(membership_key(project.id, user)):
            membership = read_membership(stored[0])
            if membership.session is not None:
                memberships_found.add((user, membership.session))
    for user, session in sorted(members - memberships_found):
        yield f"split: {user} is a member of {session} and has no membership of it"
    for user, session in sorted(memberships_found - members):
        yield f"split: {user} has a membership of {session} and is no member"


def _merged(documents: StoredDocuments, project: Project) -> Iterator[str]:
    """Find participants in two sessions, and sessions with too many or too few members."""
    count: Counter[str] = Counter()
    for one in formed(documents, project):
        count.update(member.user_id for member in one.members)
        if len(one.members) > project.players:
            yield f"merged: {one.id} has {len(one.members)} members"
        if len(one.members) < project.players and project.after_patience != "policies":
            yield f"split: {one.id} has {len(one.members)} members"
    yield from (f"merged: {user} is in {times} sessions" for user, times in sorted(count.items()) if times > 1)


def _ghosts(documents: StoredDocuments, project: Project, people: Sequence[SimulatedMember]) -> Iterator[str]:
    """Find members who had sent no request for long when their session was formed."""
    asked: dict[str, list[datetime]] = defaultdict(list)
    for person in people:
        asked[person.visit.user] += person.asked_at
    for one in formed(documents, project):
        when = datetime.fromisoformat(one.formed.replace("Z", "+00:00"))
        for member in one.members:
            if not any(when - PRESENT - ANSWERS <= at <= when for at in asked[member.user_id]):
                yield f"ghost: {member.user_id} had sent no request for long when {one.id} was formed"


def _answers(documents: StoredDocuments, project: Project) -> Iterator[str]:
    """Find game steps that members of a session have answered in another session."""
    for one in formed(documents, project):
        for member in one.members:
            for step in project.game_steps:
                if stored := documents.get(answer_key(project.id, member.user_id, step)):
                    answers = json.loads(stored[0])["answers"]
                    if answers.get("session") != one.id:
                        yield f"split: {member.user_id} has played in {answers.get('session')}, not in {one.id}"
