"""What the source lists, by participant and session, and what of it is new or changed here."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from export import keys, scrub
from export.keys import Item, KeyKind, Listed
from export.source import Source
from export.state import ExportState
from protocol import session as sessions
from protocol.keys import sessions_folder
from protocol.session import is_session_id


class Wanted(NamedTuple):
    """What a run is to bring."""

    recordings: bool = True
    raw: bool = False
    apart: bool = False


class Unit(NamedTuple):
    """All that the source has of one participant, or of a session; of the project itself where `user` is empty."""

    user: str
    items: list[Item]

    @property
    def is_session(self) -> bool:
        return is_session_id(self.user)


class Members(NamedTuple):
    """Who plays in a session. `people`: their numbers, by seat.

    `identities`: texts that would show who they are, each with what to write instead. `mark` changes with all of this,
    so that the session's recordings are converted again.
    """

    session: str
    mark: str = ""
    people: Mapping[int, str] = {}
    identities: Mapping[str, str] = {}


@dataclass
class Tally:
    """What a run did, or would do."""

    participants: int = 0
    new: int = 0
    changed: int = 0
    unchanged: int = 0
    gone: int = 0
    bytes: int = 0
    damaged: int = 0

    @property
    def to_fetch(self) -> int:
        return self.new + self.changed


def lines(source: Source, project: str, state: ExportState) -> Iterator[Listed]:
    """Everything that participants have left, then what their sessions have, if there are any."""
    found = state.has_sessions()
    for line in source.list(keys.prefix(project)):
        found = found or _is_session(line.key)
        yield line
    if found:
        yield from source.list(sessions_folder(project))


def members(state: ExportState, session: str) -> Members:
    """Who plays in a session, as far as it is known here by now."""
    version = next((known.version for key, known in state.files_of(session).items() if _is_session(key)), "")
    if not version:
        return Members(session)
    try:
        seated = sessions.parse(json.dumps(state.session(session)).encode()).members
    except sessions.BadSession:
        seated = ()
    people: dict[int, str] = {}
    identities: dict[str, str] = {}
    for member in seated:
        if participant := state.present(member.user_id):
            people[member.seat] = participant.number
            identities |= scrub.identities(participant)
    told = json.dumps([version, sorted(people.items()), sorted(identities.items())])
    mark = hashlib.blake2b(told.encode("utf-8", "replace"), digest_size=8).hexdigest()
    return Members(session, f"~{mark}", people, identities)


def _is_session(key: str) -> bool:
    return key.endswith("/session.json")


def units(project: str, listed: Iterable[Listed]) -> Iterator[Unit]:
    """The listing by participant and session: all lines of one, in any order, then all of the next."""
    user, items = "", list[Item]()
    for line in listed:
        item = keys.read(project, line)
        if item.user != user or (not user and len(items) >= 1000):
            if items:
                yield Unit(user, items)
            user, items = item.user, []
        items.append(item)
    if items:
        yield Unit(user, items)


def choose(
    state: ExportState, unit: Unit, wanted: Wanted, tally: Tally, damaged: frozenset[str], *, mark: str = ""
) -> tuple[list[Item], list[str]]:
    """What of a unit has to be fetched, and the keys that may stay as they are. `damaged` are paths of ours.

    `mark` is that of a session's members.
    """
    known = state.files_of(unit.user)
    fetch, seen = [], []
    everything = False
    for item in sorted(unit.items, key=lambda item: _ORDER.get(item.kind, len(_ORDER))):
        before = known.get(item.listed.key)
        skipped = item.kind is KeyKind.RECORDING and not wanted.recordings
        same = (
            before is not None
            and before.version == version_of(item, mark)
            and not everything
            and damaged.isdisjoint((before.path, before.raw))
        )
        raw_missing = wanted.raw and item.kind is not KeyKind.FOREIGN and (before is None or before.raw is None)
        if skipped or (same and not raw_missing):
            tally.unchanged += 1
            seen.append(item.listed.key)
            continue
        tally.new, tally.changed = tally.new + (before is None), tally.changed + (before is not None)
        tally.bytes += item.listed.size if item.kind is not KeyKind.FOREIGN else 0
        fetch.append(item)
        # With another participant.json a participant has other identities, which must leave all their files; with
        # another document a session may have other members.
        everything = everything or (item.kind in _NAMING and wanted.apart) or item.kind is KeyKind.SESSION
    tally.participants += bool(unit.user) and not unit.is_session
    return fetch, seen


_NAMING = (KeyKind.PARTICIPANT, KeyKind.MEMBERSHIP)
_ORDER = {kind: order for order, kind in enumerate((*_NAMING, KeyKind.SESSION))}
"""Documents of these kinds come first, in this order: what they say is needed to read the others."""


def version_of(item: Item, mark: str) -> str:
    """The version of what is made of a file: of a recording it changes with the session's members too."""
    return item.listed.version + (mark if item.kind is KeyKind.RECORDING else "")
