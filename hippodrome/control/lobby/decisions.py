"""The document of decisions: one per project's lobby, with the records in it. Pure: no clock, no I/O.

`_lobbies/{projectId}.json` is changed by compare-and-swap alone. A participant stands in it at most once: as a member
of a *proposed* session, as a member of a *formed* session (which is decided for good), or as *unmatched*. So no
participant gets into two sessions, even if several functions decide at once from listings of different age. A formed
session leaves the document only after its own document and its members' memberships have been written (`store.py`).
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timedelta

import msgspec

from hippodrome.control.model.records import Record

LOBBIES = "_lobbies/"


class OpenSession(Record, frozen=True):
    """A session without members, whose server was started ahead.

    `requested`: when its server was requested. `by`: the label of the participant for whom it was requested; "" if the
    sweep requested it, or the participant is erased. `players`: for how many participants it is; its server runs the
    registration for that number.
    """

    id: str
    requested: datetime
    by: str = ""
    players: int = 2

    def is_usable(self, players: int, now: datetime, open_for: timedelta) -> bool:
        """Return whether the session, which is for `players`, may still get members.

        It may until `open_for` after its server was requested.
        """
        return now - self.requested < open_for and self.players == players


class Proposal(Record, frozen=True):
    """A session that may be formed. `labels` are the labels of its members, in the order in which they came.

    `id` identifies the proposal: its members confirm it by this id. `ahead`: the open session whose server it gets, if
    there is one; if this proposal falls apart, another proposal may get that server. `players`: the project's number
    when the session was proposed.
    """

    id: str
    labels: tuple[str, ...]
    at: datetime
    ahead: OpenSession | None = None
    players: int = 2

    @property
    def session_id(self) -> str:
        """The id of the session if it is formed."""
        return self.ahead.id if self.ahead else self.id


class Matched(Record, frozen=True):
    """A member of a formed session. `waited`: the seconds that the participant spent in the lobby."""

    label: str
    user_id: str
    group: int | None = None
    waited: float | None = None


class Formed(Record, frozen=True):
    """A session whose members are decided. The order of `members` is that of their seats.

    `ahead`: whether its server was started ahead. `waits_for`: the open session whose server it waits for, until that
    server or another one is ready (`with_ready_servers`). Once `waits_for` is None, the session has its id, and so its
    server, for good.
    """

    id: str
    members: tuple[Matched, ...]
    at: datetime
    ahead: bool = False
    waits_for: OpenSession | None = None
    players: int = 2  # the number of players, empty places included

    @property
    def labels(self) -> tuple[str, ...]:
        """The members' labels, in the order of their seats."""
        return tuple(member.label for member in self.members)


class Unmatched(Record, frozen=True):
    """A participant who was not matched within `patience`. `waited`: the seconds that they spent in the lobby."""

    label: str
    user_id: str
    at: datetime
    completion_code: str = ""
    waited: float | None = None


class Decisions(Record, frozen=True):
    """The document of decisions.

    `renewed`: when this document replaced one that could not be read. Then some sessions may be half written, and this
    document does not name them. Until the sweep has finished them, no session is proposed, and no participant becomes
    unmatched.

    `version` counts the document's versions. It makes each version's bytes unique, and so its ETag, which S3 makes of
    the content (S3 API Reference, "Object"). So a function that has read an earlier version cannot overwrite a later
    one whose other content is the same.
    """

    version: int = 0
    open: tuple[OpenSession, ...] = ()
    proposed: tuple[Proposal, ...] = ()
    formed: tuple[Formed, ...] = ()
    unmatched: tuple[Unmatched, ...] = ()
    renewed: datetime | None = None

    def labels(self) -> frozenset[str]:
        """Return the labels of all participants in the document."""
        return frozenset(
            [
                *(label for proposal in self.proposed for label in proposal.labels),
                *self.labels_formed(),
                *(member.label for member in self.unmatched),
            ]
        )

    def labels_formed(self) -> frozenset[str]:
        """Return the labels of the members of all formed sessions in the document."""
        return frozenset(member.label for session in self.formed for member in session.members)

    def proposal_of(self, label: str) -> Proposal | None:
        """Return the proposal with this participant; None if there is none."""
        return next((proposal for proposal in self.proposed if label in proposal.labels), None)

    def formed_of(self, label: str) -> Formed | None:
        """Return the formed session with this participant; None if there is none."""
        return next(
            (session for session in self.formed if any(member.label == label for member in session.members)), None
        )

    def unmatched_of(self, label: str) -> Unmatched | None:
        """Return the entry which says that this participant is unmatched; None if there is none."""
        return next((member for member in self.unmatched if member.label == label), None)

    def is_decided(self, label: str) -> bool:
        """Return whether the participant is unmatched, or a member of a session that has its server for good."""
        return self.decided_for(label) != Decisions()

    def decided_for(self, label: str) -> Decisions:
        """Return the part of the document that is decided for good about this participant; empty if nothing is."""
        formed, unmatched = self.formed_of(label), self.unmatched_of(label)
        has_server = formed is not None and formed.waits_for is None
        return Decisions(formed=(formed,) if formed and has_server else (), unmatched=(unmatched,) if unmatched else ())

    def without_server(self) -> list[Formed]:
        """Return the formed sessions that wait for a server, in the order in which they were formed."""
        return sorted((session for session in self.formed if session.waits_for), key=lambda each: each.at)

    def for_good(self) -> Decisions:
        """Return the part of the document that is decided for good.

        These are the sessions that have their server, and the unmatched participants.
        """
        has_server = tuple(session for session in self.formed if session.waits_for is None)
        return Decisions(formed=has_server, unmatched=self.unmatched)

    def session_ids(self) -> frozenset[str]:
        """Return the ids of all sessions in the document that may have a server."""
        proposed = (proposal.session_id for proposal in self.proposed if proposal.ahead)
        return frozenset([*(server.id for server in self.open), *proposed, *(session.id for session in self.formed)])


def key(project_id: str) -> str:
    """Return the key of a project's document of decisions."""
    return f"{LOBBIES}{project_id}.json"


def next_version(before: Decisions, after: Decisions) -> Decisions:
    """Return `after`; if it differs from `before`, with the next version number."""
    return before if after == before else msgspec.structs.replace(after, version=before.version + 1)


def by_age(sessions: Iterable[OpenSession]) -> tuple[OpenSession, ...]:
    """Return these open sessions in the order in which their servers were requested. The first is used first."""
    return tuple(sorted(sessions, key=lambda session: (session.requested, session.id)))
