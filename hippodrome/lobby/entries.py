"""What participants leave in the lobby's folder: who waits, who has confirmed, who is under way. Pure.

    _lobby/{projectId}/{label}.{joined}.{trait}   waits; joined: when they came, in ms; its LastModified: when last seen
    _lobby/{projectId}/{label}.yes.{proposal id}  has asked again since this session was proposed
    _lobby/{projectId}/{label}.left.{joined}      has closed the page
    _lobby/{projectId}/{label}.way                is on their way to the game
    _lobby/{projectId}/{session id}.done          all that follows from the decision on this session is written
    _lobby/{projectId}/{label}.done               the same, of an unmatched participant

Every time is the platform's: no clock of a browser is read. S3 cuts LastModified to whole seconds, so a participant may
seem to have been seen up to a second earlier than they were.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta

import msgspec

from hippodrome.model import ids
from hippodrome.model.records import Record, from_json, to_json
from hippodrome.ports import Entry
from protocol.session import is_session_id

FOLDER = "_lobby/"
PRESENT = timedelta(seconds=10)
"""A participant who has asked since then is there. The page asks every two seconds."""
REMEMBERED = timedelta(seconds=30)
"""A participant who has asked since then keeps the time at which they came; later they begin anew."""
DELETED = timedelta(seconds=60)
"""Older entries are deleted: well after `REMEMBERED`, so that no request on its way still writes to one."""
NO_TRAIT = "-"
_DONE = re.compile(r"(s[a-z2-7]{20}|s\.[0-9a-f]{20})\.done")
_NAME = re.compile(r"(s[a-z2-7]{20})\.(?:(way)|(yes|left)\.(.+)|([0-9]{13})\.(-|[0-9a-f]{10}))")


class WaitingDocument(Record, frozen=True, omit_defaults=False):
    """What stands in the document of a participant who waits."""

    user_id: str
    group: int | None = None


@dataclass(frozen=True, slots=True)
class Waiting:
    """A participant who waits. `joined` is in ms, as in the key; `seen` is when they last asked."""

    label: str
    joined: int
    trait: str
    seen: datetime

    @property
    def order(self) -> tuple[int, str]:
        """The order in which participants are matched: who came first is matched first."""
        return self.joined, self.label

    def is_present(self, now: datetime) -> bool:
        """Whether they have asked lately."""
        return now - self.seen < PRESENT


@dataclass(frozen=True, slots=True)
class Departure:
    """A participant who has closed the page. `joined` is when they had come."""

    joined: int
    at: datetime


@dataclass(frozen=True)
class Entries:
    """A listing of the folder. A participant who has left and not come back is in `left`, not in `waiting`."""

    waiting: Mapping[str, Waiting] = field(default_factory=dict)  # by label
    confirmed: Mapping[str, frozenset[str]] = field(default_factory=dict)  # labels, by the proposal's id
    left: Mapping[str, Departure] = field(default_factory=dict)  # by label
    under_way: frozenset[str] = frozenset()
    done: frozenset[str] = frozenset()  # ids of sessions, and labels of the unmatched
    keys: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # of all entries, by label
    outdated: tuple[str, ...] = ()  # keys to delete

    def with_waiting(self, one: Waiting) -> Entries:
        """The listing with this participant, who is there now."""
        left = {label: each for label, each in self.left.items() if label != one.label}
        return replace(self, waiting={**self.waiting, one.label: one}, left=left)

    def with_confirmation(self, proposal_id: str, label: str) -> Entries:
        """The listing with this confirmation, which was just written."""
        labels = self.confirmed.get(proposal_id, frozenset()) | {label}
        return replace(self, confirmed={**self.confirmed, proposal_id: labels})


def read(project_id: str, listed: Iterable[Entry], now: datetime, way: timedelta) -> Entries:
    """Read a listing of `folder(project_id)`. `way`: for how long a participant counts as under way."""
    prefix = folder(project_id)
    waiting: dict[str, Waiting] = {}
    confirmed: dict[str, set[str]] = {}
    left: dict[str, Departure] = {}
    under_way: set[str] = set()
    keys: dict[str, list[str]] = {}
    outdated: list[str] = []
    done: set[str] = set()
    for entry in listed:
        name = entry.key.removeprefix(prefix)
        if is_done := _DONE.fullmatch(name):
            done.add(is_done[1])
            continue
        found = _NAME.fullmatch(name)
        age = now - entry.modified
        if found is None:
            continue
        label, is_way, kind, text, joined, trait = found.groups()
        if age >= (way if is_way else DELETED):
            outdated.append(entry.key)
            continue
        keys.setdefault(label, []).append(entry.key)
        if is_way:
            under_way.add(label)
        elif kind == "yes" and is_session_id(text):  # the form of a proposal's id, too
            confirmed.setdefault(text, set()).add(label)
        elif kind == "left" and text.isdecimal():
            left[label] = Departure(int(text), entry.modified)
        elif joined and age <= REMEMBERED:
            one = Waiting(label, int(joined), trait, entry.modified)
            waiting[label] = _earlier(waiting[label], one) if label in waiting else one
    return Entries(
        waiting={label: one for label, one in waiting.items() if label not in left},
        confirmed={sid: frozenset(labels) for sid, labels in confirmed.items()},
        left=left,
        under_way=frozenset(under_way),
        done=frozenset(done),
        keys={label: tuple(found) for label, found in keys.items()},
        outdated=tuple(outdated),
    )


def _earlier(one: Waiting, other: Waiting) -> Waiting:
    """The same participant, who opened two pages at once: they came with the first and were seen in either."""
    first = min(one, other, key=lambda each: each.joined)
    return replace(first, seen=max(one.seen, other.seen))


def folder(project_id: str) -> str:
    """The folder of a project's lobby."""
    return f"{FOLDER}{project_id}/"


def prefix_of(project_id: str, label: str) -> str:
    """How the keys of all entries of a participant begin."""
    return f"{folder(project_id)}{label}."


def waiting_key(project_id: str, one: Waiting) -> str:
    """The key of a participant who waits."""
    return f"{prefix_of(project_id, one.label)}{one.joined:013}.{one.trait}"


def confirmation_key(project_id: str, label: str, proposal_id: str) -> str:
    """The key of a confirmation."""
    return f"{prefix_of(project_id, label)}yes.{proposal_id}"


def departure_key(project_id: str, label: str, joined: int) -> str:
    """The key that says that a participant has closed the page."""
    return f"{prefix_of(project_id, label)}left.{joined:013}"


def way_key(project_id: str, label: str) -> str:
    """The key of a participant who is on their way."""
    return f"{prefix_of(project_id, label)}way"


def done_key(project_id: str, decided: str) -> str:
    """The key that says that all is written of this session, by id, or of this unmatched participant, by label."""
    return f"{folder(project_id)}{decided}.done"


def milliseconds(now: datetime) -> int:
    """A time as keys have it: milliseconds since 1970."""
    return int(now.timestamp() * 1000)


def seconds_since(joined: int, now: datetime) -> float:
    """Seconds since a participant came; not below 0, however far clocks are apart."""
    return max(0, milliseconds(now) - joined) / 1000


def read_body(body: bytes) -> WaitingDocument | None:
    """Read the document of a participant who waits; None if it cannot be read."""
    try:
        found = from_json(body, WaitingDocument)
    except (msgspec.DecodeError, RecursionError):
        return None
    return found if ids.is_user_id(found.user_id) else None


def body(found: WaitingDocument) -> bytes:
    """The document of a participant who waits, as bytes."""
    return to_json(found)
