"""Decides when a session is proposed, falls apart or is formed, and when a participant is unmatched. Pure.

Each rule takes the document of decisions (`decisions.py`) and returns its next version.
"""

from __future__ import annotations

import hashlib
import math
from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from datetime import datetime, timedelta

import msgspec

from hippodrome.control.lobby.decisions import Decisions, Formed, Matched, OpenSession, Proposal, Unmatched, by_age
from hippodrome.control.lobby.entries import Entries, Waiting
from hippodrome.control.lobby.matchmaking import around, choose, patience_is_over
from hippodrome.control.model.project import Project

CONFIRMED_WITHIN = timedelta(seconds=10)
"""A proposal that not all members have confirmed within this time falls apart."""


def decide(
    document: Decisions,
    entries: Entries,
    project: Project,
    now: datetime,
    new_id: Callable[[], str],
    *,
    open_for: timedelta,
    known: Decisions | None = None,
    chosen: Sequence[Sequence[str]] = (),
) -> Decisions:
    """Drop proposals that have fallen apart, and propose sessions of participants who are present and in no session.

    `known` is the document as it was read before the listing `entries` was made; None: `document` itself. Proposals
    that are not in `known` stay, since they are newer than the listing. Participants who stand in `known` are not
    proposed now, since the listing may be too old to say whether they are free. `chosen` are the sessions that the
    function `match` has chosen, each as its members' labels; with `matching: match` no others are proposed. `new_id`
    makes the id of a proposal, and of its session unless that gets an open session. An open session can be used for
    `open_for` after its server was requested.
    """
    earlier = known if known is not None else document
    settled = _without_fallen(document, entries, earlier, now)
    if document.renewed is not None:
        return settled
    before = earlier.labels()
    among = [person for person in free(settled, entries, now) if person.label not in before]
    sessions = choose(among, project, now, chosen)
    return _with_proposals(settled, sessions, now, new_id, players=project.players, open_for=open_for)


def free(document: Decisions, entries: Entries, now: datetime) -> list[Waiting]:
    """Return the participants who are present and in no session, in the order of arrival."""
    busy = document.labels()
    present = (person for person in entries.waiting.values() if person.label not in busy and person.is_present(now))
    return sorted(present, key=lambda person: person.order)


def confirmed(document: Decisions, entries: Entries) -> list[Proposal]:
    """Return the proposals that all members have confirmed and no member has left."""
    return [
        proposal
        for proposal in document.proposed
        if entries.confirmed.get(proposal.id, frozenset()) >= set(proposal.labels)
        and all(label in entries.waiting for label in proposal.labels)
    ]


def number_here(document: Decisions, entries: Entries, project: Project, label: str, now: datetime) -> int:
    """Return how many participants could play together now, this one included; at most `players`."""
    proposal = document.proposal_of(label)
    if proposal is not None:
        return len(proposal.labels)
    formed = document.formed_of(label)
    if formed is not None:
        return len(formed.members)
    me = entries.waiting.get(label)
    if me is None:
        return 1
    among = [
        person
        for person in free(document, entries, now)
        if project.after_patience == "policies" or not patience_is_over(person.joined, project, now)
    ]
    return len(around(me, among, project))


def _without_fallen(document: Decisions, entries: Entries, decisions: Decisions, now: datetime) -> Decisions:
    """The document without the proposals in `decisions` that have fallen apart."""
    before = {proposal.id for proposal in decisions.proposed}
    fallen = [
        proposal.id for proposal in document.proposed if proposal.id in before and _has_fallen(proposal, entries, now)
    ]
    return without_proposals(document, fallen)


def _has_fallen(proposal: Proposal, entries: Entries, now: datetime) -> bool:
    """Whether the proposal's time is over, a member has left, or one who has not confirmed is no longer present."""
    if now - proposal.at >= CONFIRMED_WITHIN:
        return True
    labels = entries.confirmed.get(proposal.id, frozenset())
    members = (entries.waiting.get(label) for label in proposal.labels)
    return any(member is None or not (member.label in labels or member.is_present(now)) for member in members)


def without_proposals(document: Decisions, ids: Collection[str]) -> Decisions:
    """Return the document without these proposals. The open sessions that they had are open again."""
    if not any(proposal.id in ids for proposal in document.proposed):
        return document
    opened = [proposal.ahead for proposal in document.proposed if proposal.id in ids and proposal.ahead]
    return msgspec.structs.replace(
        document,
        proposed=tuple(proposal for proposal in document.proposed if proposal.id not in ids),
        open=by_age([*document.open, *opened]),
    )


def _with_proposals(
    document: Decisions,
    sessions: Iterable[Sequence[Waiting]],
    now: datetime,
    new_id: Callable[[], str],
    *,
    players: int,
    open_for: timedelta,
) -> Decisions:
    """The document with a proposal for each of these sessions. They get open sessions, the oldest first."""
    usable = deque(server for server in document.open if server.is_usable(players, now, open_for))
    added = []
    for members in sessions:
        ahead = usable.popleft() if usable else None
        labels = tuple(member.label for member in members)
        added.append(Proposal(new_id(), labels, now, ahead, players))
    if not added:
        return document
    used = {addition.ahead.id for addition in added if addition.ahead}
    return msgspec.structs.replace(
        document,
        proposed=(*document.proposed, *added),
        open=tuple(server for server in document.open if server.id not in used),
    )


# Decisions for good


def form(
    document: Decisions, proposal_id: str, members: Sequence[Matched], now: datetime, seats: str = "lot"
) -> Decisions:
    """Form the proposed session with these members, unless the document has no such proposal of theirs any more.

    `seats` says which member plays which player (`project.seats`).
    """
    proposal_found = next((proposal for proposal in document.proposed if proposal.id == proposal_id), None)
    if proposal_found is None or proposal_found.labels != tuple(member.label for member in members):
        return document
    seated = _seated(members, proposal_found.session_id, seats)
    formed = Formed(
        proposal_found.session_id,
        seated,
        now,
        proposal_found.ahead is not None,
        proposal_found.ahead,
        proposal_found.players,
    )
    return msgspec.structs.replace(
        document,
        proposed=tuple(proposal for proposal in document.proposed if proposal is not proposal_found),
        formed=(*document.formed, formed),
    )


def _seated(members: Sequence[Matched], lot: str, seats: str) -> tuple[Matched, ...]:
    """The members in the order of their seats.

    The lot is drawn from the session's random id. Otherwise the participant who comes first, and is perhaps more eager,
    would always play the same player. The lot also decides between members of one group.
    """
    if seats == "match":
        return tuple(members)
    drawn = sorted(members, key=lambda member: hashlib.sha256(f"{lot}\0{member.label}".encode()).digest())
    if seats == "group":
        drawn.sort(key=lambda member: math.inf if member.group is None else member.group)
    return tuple(drawn)


def give_up(document: Decisions, unmatched: Unmatched) -> Decisions:
    """Make the participant unmatched, unless they stand in the document already."""
    if document.renewed is not None or unmatched.label in document.labels():
        return document
    return msgspec.structs.replace(document, unmatched=(*document.unmatched, unmatched))


def without_done(document: Decisions, done: Collection[str]) -> Decisions:
    """Return the document without the decisions that are carried out.

    `done` holds the ids of sessions, and the labels of unmatched participants.
    """
    if not any(session.id in done for session in document.formed) and not any(
        member.label in done for member in document.unmatched
    ):
        return document
    return msgspec.structs.replace(
        document,
        formed=tuple(session for session in document.formed if session.id not in done),
        unmatched=tuple(member for member in document.unmatched if member.label not in done),
    )


def without(document: Decisions, label: str) -> Decisions:
    """Return the document without this participant, whose data are erased.

    Their seat in a formed session is empty then.
    """

    def unnamed(ahead: OpenSession | None) -> OpenSession | None:
        return msgspec.structs.replace(ahead, by="") if ahead and ahead.by == label else ahead

    formed = (
        msgspec.structs.replace(
            session,
            members=tuple(Matched("", "") if member.label == label else member for member in session.members),
            waits_for=unnamed(session.waits_for),
        )
        for session in document.formed
    )
    others = without_proposals(document, [proposal.id for proposal in document.proposed if label in proposal.labels])
    return msgspec.structs.replace(
        others,
        open=tuple(unnamed_server for server in others.open if (unnamed_server := unnamed(server))),
        proposed=tuple(
            msgspec.structs.replace(proposal, ahead=unnamed(proposal.ahead)) for proposal in others.proposed
        ),
        formed=tuple(session for session in formed if any(member.label for member in session.members)),
        unmatched=tuple(member for member in others.unmatched if member.label != label),
    )
