"""Whether the sessions of a simulated installation are in order, by its documents and by what its participants did."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta

from hippodrome.model import memberships
from hippodrome.model.project import Project
from protocol.keys import answer_key, membership_key
from testing.simulation.lobby import Kept, formed
from testing.simulation.members import SimulatedMember

PRESENT = timedelta(seconds=10)  # after which who has not asked is no longer there
ANSWERS = timedelta(seconds=30)  # that a page may take: what it decides, it decides for who was there when it began


def wrong(kept: Kept, project: Project, people: Sequence[SimulatedMember]) -> list[str]:
    """Sessions whose members are split, or that are merged, participants who were matched as ghosts, and answers of another session."""
    return [
        *_split(kept, project, people),
        *_merged(kept, project),
        *_ghosts(kept, project, people),
        *_answers(kept, project),
    ]


def _split(kept: Kept, project: Project, people: Sequence[SimulatedMember]) -> Iterator[str]:
    """Where a session and its members do not say the same."""
    members = {(member.user_id, one.id) for one in formed(kept, project) for member in one.members}
    told = set()
    for user in {person.visit.user for person in people}:
        if stored := kept.get(membership_key(project.id, user)):
            membership = memberships.read(stored[0])
            if membership.session is not None:
                told.add((user, membership.session))
    yield from (f"split: {user} is a member of {session} and was not told" for user, session in sorted(members - told))
    yield from (f"split: {user} was told of {session} and is no member" for user, session in sorted(told - members))


def _merged(kept: Kept, project: Project) -> Iterator[str]:
    """Participants in two sessions, and sessions of too many."""
    count: Counter[str] = Counter()
    for one in formed(kept, project):
        count.update(member.user_id for member in one.members)
        if len(one.members) > project.players:
            yield f"merged: {one.id} has {len(one.members)} members"
        if len(one.members) < project.players and project.after_patience != "policies":
            yield f"split: {one.id} has {len(one.members)} members"
    yield from (f"merged: {user} is in {times} sessions" for user, times in sorted(count.items()) if times > 1)


def _ghosts(kept: Kept, project: Project, people: Sequence[SimulatedMember]) -> Iterator[str]:
    """Members who had closed the page long before their session was formed."""
    asked: dict[str, list[datetime]] = defaultdict(list)
    for person in people:
        asked[person.visit.user] += person.asked_at
    for one in formed(kept, project):
        when = datetime.fromisoformat(one.formed.replace("Z", "+00:00"))
        for member in one.members:
            if not any(when - PRESENT - ANSWERS <= at <= when for at in asked[member.user_id]):
                yield f"ghost: {member.user_id} had not asked for long when {one.id} was formed"


def _answers(kept: Kept, project: Project) -> Iterator[str]:
    """Game steps that members of a session have answered in another."""
    for one in formed(kept, project):
        for member in one.members:
            for step in project.game_steps:
                if stored := kept.get(answer_key(project.id, member.user_id, step)):
                    answers = json.loads(stored[0])["answers"]
                    if answers.get("session") != one.id:
                        yield f"split: {member.user_id} has played in {answers.get('session')}, not in {one.id}"
