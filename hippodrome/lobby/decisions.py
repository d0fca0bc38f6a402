"""What is decided of a project's lobby: the one document, and the records in it. Pure: no clock, no I/O.

`_lobbies/{projectId}.json` is changed by compare-and-swap alone. A participant stands in it at most once: as a member
of a session that is *proposed*, or of one that is *formed* (decided for good), or as *unmatched*. So whatever several
functions decide at once from listings of different age, no participant gets into two sessions. What is formed leaves
the document only when the documents that say so have been written (`store.py`).
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timedelta

import msgspec

from hippodrome.model.records import Record

LOBBIES = "_lobbies/"


class Ahead(Record, frozen=True):
    """A session without members, whose server was started ahead. `by`: the label of the participant it was asked for.

    `players`: for how many participants; its server runs the trial of that registration. 0 in documents of earlier
    versions, which do not say it.
    """

    id: str
    asked: datetime
    by: str = ""
    players: int = 0

    def is_usable(self, players: int, now: datetime, open_for: timedelta) -> bool:
        """Whether a session of so many players may get its server now."""
        return now - self.asked < open_for and self.players in (0, players)


class Proposal(Record, frozen=True):
    """A session that may be formed, by its members' labels, in the order in which they came.

    `ahead` is its server, if one was started ahead.
    `id` is the proposal's own, under which its members confirm: another proposal may get the same server later.
    `players` is what the project said then; 0 in documents of earlier versions.
    """

    id: str
    labels: tuple[str, ...]
    at: datetime
    ahead: Ahead | None = None
    players: int = 0

    @property
    def session_id(self) -> str:
        """The id of the session if it is formed."""
        return self.ahead.id if self.ahead else self.id


class Matched(Record, frozen=True):
    """A matched participant: a member of a formed session. `waited`: seconds in the lobby."""

    label: str
    user_id: str
    group: int | None = None
    waited: float | None = None


class Formed(Record, frozen=True):
    """A session whose members are decided. Seats are counted in the order of `members`.

    `ahead`: its server was started ahead. As long as that is not ready, it stands in `waits_for`, and the session may
    get another one instead (`with_ready_servers`). Without `waits_for` the session has its id, and so its server, for
    good.
    """

    id: str
    members: tuple[Matched, ...]
    at: datetime
    ahead: bool = False
    waits_for: Ahead | None = None
    players: int = 0  # with the empty places; 0 in documents of earlier versions

    @property
    def labels(self) -> tuple[str, ...]:
        """The members' labels, in the order of their seats."""
        return tuple(member.label for member in self.members)


class Unmatched(Record, frozen=True):
    """A participant whose patience was over. `waited`: seconds in the lobby."""

    label: str
    user_id: str
    at: datetime
    completion_code: str = ""
    waited: float | None = None


class Decisions(Record, frozen=True):
    """The document. `version` counts its versions. `renewed`: when it was made anew, because it could not be read.

    Then sessions may be half written of which the document says nothing any more. Until they are finished nobody is
    proposed, or unmatched.

    The count makes each version's bytes unique, and so its ETag, which S3 makes of the content (S3 API Reference,
    "Object"): a function that read an earlier version with otherwise the same content cannot overwrite a later one.
    """

    version: int = 0
    open: tuple[Ahead, ...] = ()
    proposed: tuple[Proposal, ...] = ()
    formed: tuple[Formed, ...] = ()
    unmatched: tuple[Unmatched, ...] = ()
    renewed: datetime | None = None

    def labels(self) -> frozenset[str]:
        """The labels of all participants in the document."""
        return frozenset(
            [
                *(label for each in self.proposed for label in each.labels),
                *self.labels_formed(),
                *(each.label for each in self.unmatched),
            ]
        )

    def labels_formed(self) -> frozenset[str]:
        """The labels of the members of all formed sessions in the document."""
        return frozenset(member.label for each in self.formed for member in each.members)

    def proposal_of(self, label: str) -> Proposal | None:
        """The proposed session of this participant."""
        return next((each for each in self.proposed if label in each.labels), None)

    def formed_of(self, label: str) -> Formed | None:
        """The formed session of this participant."""
        return next((each for each in self.formed if any(member.label == label for member in each.members)), None)

    def unmatched_of(self, label: str) -> Unmatched | None:
        """The decision that this participant is unmatched; None if there is none."""
        return next((each for each in self.unmatched if each.label == label), None)

    def is_decided(self, label: str) -> bool:
        """Whether it is decided for good that they are unmatched, or play in a session that has its server."""
        return self.of(label) != Decisions()

    def of(self, label: str) -> Decisions:
        """The part of the document that is decided for good about this participant."""
        formed, unmatched = self.formed_of(label), self.unmatched_of(label)
        has_server = formed is not None and formed.waits_for is None
        return Decisions(formed=(formed,) if formed and has_server else (), unmatched=(unmatched,) if unmatched else ())

    def without_server(self) -> list[Formed]:
        """The sessions that wait until a server is ready, in the order in which they were formed."""
        return sorted((each for each in self.formed if each.waits_for), key=lambda each: each.at)

    def for_good(self) -> Decisions:
        """The part of the document that is decided for good."""
        has_server = tuple(each for each in self.formed if each.waits_for is None)
        return Decisions(formed=has_server, unmatched=self.unmatched)

    def session_ids(self) -> frozenset[str]:
        """The ids of all sessions in the document, each of which may have a server."""
        begun = (each.session_id for each in self.proposed if each.ahead)
        return frozenset([*(each.id for each in self.open), *begun, *(each.id for each in self.formed)])


def key(project_id: str) -> str:
    """The key of a project's document of decisions."""
    return f"{LOBBIES}{project_id}.json"


def next_version(before: Decisions, after: Decisions) -> Decisions:
    """`after`, with the next version number if it differs from `before`."""
    return before if after == before else msgspec.structs.replace(after, version=before.version + 1)


def by_age(sessions: Iterable[Ahead]) -> tuple[Ahead, ...]:
    """Open sessions in the order in which their servers were asked for: the first is used first."""
    return tuple(sorted(sessions, key=lambda each: (each.asked, each.id)))
