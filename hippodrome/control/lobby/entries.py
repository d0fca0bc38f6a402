"""The entries in the lobby's folder: their keys, and what a listing of them says. Pure.

    _lobby/{projectId}/{label}.{joined}.{trait}   the participant waits since `joined` (ms); LastModified: last request
    _lobby/{projectId}/{label}.yes.{proposal id}  the participant has confirmed this proposal, by another request
    _lobby/{projectId}/{label}.left.{joined}      the participant has closed the page
    _lobby/{projectId}/{label}.way                the participant is under way to the game
    _lobby/{projectId}/{session id}.done          all documents that follow from this formed session are written
    _lobby/{projectId}/{label}.done               the same for an unmatched participant

Every time is the platform's: no clock of a browser is read. S3 cuts LastModified to whole seconds, so a request may
seem to be up to a second older than it is.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta

from hippodrome.control.model import ids
from hippodrome.control.model.records import Record, from_json, to_json
from hippodrome.control.ports import Entry
from hippodrome.protocol.session import is_session_id

FOLDER = "_lobby/"
PRESENT = timedelta(seconds=10)
"""A participant counts as present for this time after a request. The lobby's page sends one every two seconds."""
REMEMBERED = timedelta(seconds=30)
"""For this time after a request a participant keeps the time at which they came; later their waiting begins again."""
DELETED = timedelta(seconds=60)
"""Entries of this age are deleted: well after `REMEMBERED`, so that no request under way still writes one of them."""
NO_TRAIT = "-"  # the trait of all participants, if `matching` needs none
_DONE = re.compile(r"(s[a-z2-7]{20}|s\.[0-9a-f]{20})\.done")
_NAME = re.compile(r"(s[a-z2-7]{20})\.(?:(way)|(yes|left)\.(.+)|([0-9]{13})\.(-|[0-9a-f]{10}))")


class WaitingDocument(Record, frozen=True, omit_defaults=False):
    """The content of the entry which says that a participant waits."""

    user_id: str
    group: int | None = None


@dataclass(frozen=True, slots=True)
class Waiting:
    """A participant who waits in the lobby.

    `joined`: when they came, in ms since 1970, as in the key. `seen`: the time of their last request. `trait`: see
    `matchmaking.trait`.
    """

    label: str
    joined: int
    trait: str
    seen: datetime

    @property
    def order(self) -> tuple[int, str]:
        """The sort key of matching: the participant who came first is matched first."""
        return self.joined, self.label

    def is_present(self, now: datetime) -> bool:
        """Return whether the participant's last request is younger than `PRESENT`."""
        return now - self.seen < PRESENT


@dataclass(frozen=True, slots=True)
class Departure:
    """The entry which says that a participant has closed the page. `joined`: when they had come (ms); `at`: when they
    left.
    """

    joined: int
    at: datetime


@dataclass(frozen=True)
class Entries:
    """The entries in the lobby's folder, as one listing shows them.

    A participant who has left and not come back is in `left`, not in `waiting`.
    """

    waiting: Mapping[str, Waiting] = field(default_factory=dict)  # by the participant's label
    confirmed: Mapping[str, frozenset[str]] = field(default_factory=dict)  # by the proposal's id: who has confirmed it
    left: Mapping[str, Departure] = field(default_factory=dict)  # by the label of a participant who has left
    under_way: frozenset[str] = frozenset()
    done: frozenset[str] = frozenset()  # ids of sessions, and labels of unmatched participants
    keys: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # by label: the keys of the participant's entries
    outdated: tuple[str, ...] = ()  # the keys of old entries, which may be deleted

    def with_waiting(self, waiting: Waiting) -> Entries:
        """Return the listing with this participant, who waits now, added."""
        departures = {label: departure for label, departure in self.left.items() if label != waiting.label}
        return replace(self, waiting={**self.waiting, waiting.label: waiting}, left=departures)

    def with_confirmation(self, proposal_id: str, label: str) -> Entries:
        """Return the listing with this confirmation, which has just been written, added."""
        labels = self.confirmed.get(proposal_id, frozenset()) | {label}
        return replace(self, confirmed={**self.confirmed, proposal_id: labels})


def read(project_id: str, listed: Iterable[Entry], now: datetime, way: timedelta) -> Entries:
    """Read a listing of `folder(project_id)`.

    An entry which says that a participant is under way counts only until it is older than `way`.
    """
    prefix = folder(project_id)
    waiting: dict[str, Waiting] = {}
    confirmed: dict[str, set[str]] = {}
    departures: dict[str, Departure] = {}
    under_way: set[str] = set()
    keys: dict[str, list[str]] = {}
    outdated: list[str] = []
    done: set[str] = set()
    for entry in listed:
        name = entry.key.removeprefix(prefix)
        if is_done := _DONE.fullmatch(name):
            done.add(is_done[1])
            continue
        match = _NAME.fullmatch(name)
        if match is None:
            continue
        age = now - entry.modified
        label, is_way, kind, text, joined, trait = match.groups()
        if age >= (way if is_way else DELETED):
            outdated.append(entry.key)
            continue
        keys.setdefault(label, []).append(entry.key)
        if is_way:
            under_way.add(label)
        elif kind == "yes" and is_session_id(text):  # a proposal's id has the form of a session's
            confirmed.setdefault(text, set()).add(label)
        elif kind == "left" and text.isdecimal():
            departures[label] = Departure(int(text), entry.modified)
        elif joined and age <= REMEMBERED:
            entry_waiting = Waiting(label, int(joined), trait, entry.modified)
            waiting[label] = _earlier(waiting[label], entry_waiting) if label in waiting else entry_waiting
    return Entries(
        waiting={label: person for label, person in waiting.items() if label not in departures},
        confirmed={sid: frozenset(labels) for sid, labels in confirmed.items()},
        left=departures,
        under_way=frozenset(under_way),
        done=frozenset(done),
        keys={label: tuple(found) for label, found in keys.items()},
        outdated=tuple(outdated),
    )


def _earlier(waiting: Waiting, other: Waiting) -> Waiting:
    """Join the two entries of a participant who opened two pages at once: the earlier `joined`, the later `seen`."""
    first = min(waiting, other, key=lambda person: person.joined)
    return replace(first, seen=max(waiting.seen, other.seen))


def folder(project_id: str) -> str:
    """Return the folder of a project's lobby."""
    return f"{FOLDER}{project_id}/"


def prefix_of(project_id: str, label: str) -> str:
    """Return the prefix with which the keys of all entries of a participant begin."""
    return f"{folder(project_id)}{label}."


def waiting_key(project_id: str, waiting: Waiting) -> str:
    """Return the key of the entry which says that this participant waits."""
    return f"{prefix_of(project_id, waiting.label)}{waiting.joined:013}.{waiting.trait}"


def confirmation_key(project_id: str, label: str, proposal_id: str) -> str:
    """Return the key of the entry which says that a participant has confirmed this proposal."""
    return f"{prefix_of(project_id, label)}yes.{proposal_id}"


def departure_key(project_id: str, label: str, joined: int) -> str:
    """Return the key of the entry which says that a participant, who came at `joined`, has closed the page."""
    return f"{prefix_of(project_id, label)}left.{joined:013}"


def way_key(project_id: str, label: str) -> str:
    """Return the key of the entry which says that a participant is under way."""
    return f"{prefix_of(project_id, label)}way"


def done_key(project_id: str, decided: str) -> str:
    """Return the key of the mark which says that a decision is carried out.

    `decided` is the id of the formed session, or the label of the unmatched participant.
    """
    return f"{folder(project_id)}{decided}.done"


def milliseconds(now: datetime) -> int:
    """Return a time as keys have it: milliseconds since 1970."""
    return int(now.timestamp() * 1000)


def seconds_since(joined: int, now: datetime) -> float:
    """Return the seconds since `joined` (ms since 1970); 0 if another machine's clock makes them negative."""
    return max(0, milliseconds(now) - joined) / 1000


def read_body(body: bytes) -> WaitingDocument | None:
    """Read the content of the entry which says that a participant waits; None if it cannot be read."""
    try:
        waiting_document = from_json(body, WaitingDocument)
    except ValueError:
        return None
    return waiting_document if ids.is_user_id(waiting_document.user_id) else None


def body(document: WaitingDocument) -> bytes:
    """Return the bytes of the entry which says that a participant waits."""
    return to_json(document)
