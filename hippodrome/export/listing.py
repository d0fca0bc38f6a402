"""Groups the listing of the source by participant and session, and finds the files that are new or changed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from hippodrome.export import keys, scrub
from hippodrome.export.keys import Item, KeyKind, Listed
from hippodrome.export.source import Source
from hippodrome.export.state import ExportState
from hippodrome.protocol import session as sessions
from hippodrome.protocol.keys import sessions_folder
from hippodrome.protocol.session import is_session_id


class Wanted(NamedTuple):
    """The data that a run fetches."""

    recordings: bool = True
    raw: bool = False  # whether the source's files are also copied unchanged
    apart: bool = False  # whether ids are kept apart, in `private/`


class Unit(NamedTuple):
    """All files of one participant or one session in the source. `user` is "" for files of neither."""

    user: str
    items: list[Item]

    @property
    def is_session(self) -> bool:
        return is_session_id(self.user)


class Members(NamedTuple):
    """The members of a session. `people` has their numbers by seat.

    `identities` has the texts that identify them, each with its replacement. `mark` changes with all of this, so that
    the session's recordings are converted again.
    """

    session: str
    mark: str = ""
    people: Mapping[int, str] = {}
    identities: Mapping[str, str] = {}


@dataclass
class Tally:
    """What a run has done, or would do: numbers of participants, files and bytes."""

    participants: int = 0
    new: int = 0
    changed: int = 0
    unchanged: int = 0
    gone: int = 0  # files that are no longer in the source
    bytes: int = 0  # the bytes to fetch
    damaged: int = 0  # files in the folder that have changed or are missing

    @property
    def to_fetch(self) -> int:
        return self.new + self.changed


def lines(source: Source, project: str, state: ExportState) -> Iterator[Listed]:
    """Yield all participants' files, then the sessions' files, if the study has sessions."""
    found = state.has_sessions()
    for line in source.list(keys.prefix(project)):
        found = found or _is_session(line.key)
        yield line
    if found:
        yield from source.list(sessions_folder(project))


def members(state: ExportState, session: str) -> Members:
    """Return those members of a session who are in the state; none if the state lacks the session's document."""
    version = next((known.version for key, known in state.files_of(session).items() if _is_session(key)), "")
    if not version:
        return Members(session)
    try:
        in_document = sessions.parse(json.dumps(state.session(session)).encode()).members
    except sessions.BadSession:
        in_document = ()
    people: dict[int, str] = {}
    identities: dict[str, str] = {}
    for member in in_document:
        if participant := state.present(member.user_id):
            people[member.seat] = participant.number
            identities |= scrub.identities(participant)
    facts = json.dumps([version, sorted(people.items()), sorted(identities.items())])
    mark = hashlib.blake2b(facts.encode("utf-8", "replace"), digest_size=8).hexdigest()
    return Members(session, f"~{mark}", people, identities)


def _is_session(key: str) -> bool:
    return key.endswith("/session.json")


def units(project: str, listed: Iterable[Listed]) -> Iterator[Unit]:
    """Group the listing by participant and session. In `listed` all files of one of them must be adjacent."""
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
    """Return the files of a unit that have to be fetched, and the keys of its other files. Counts them in `tally`.

    `damaged` are paths in the folder whose files have changed or are missing. `mark`: see `Members`.
    """
    known = state.files_of(unit.user)
    fetch, unchanged = [], []
    everything = False
    for item in sorted(unit.items, key=lambda item: _ORDER.get(item.kind, len(_ORDER))):
        before = known.get(item.listed.key)
        skipped = item.kind in _PLAYED and not wanted.recordings
        same = (
            before is not None
            and before.version == version_of(item, mark)
            and not everything
            and damaged.isdisjoint((before.path, before.raw))
        )
        raw_missing = wanted.raw and item.kind is not KeyKind.FOREIGN and (before is None or before.raw is None)
        if skipped or (same and not raw_missing):
            tally.unchanged += 1
            unchanged.append(item.listed.key)
            continue
        if before is None:
            tally.new += 1
        else:
            tally.changed += 1
        if item.kind is not KeyKind.FOREIGN:
            tally.bytes += item.listed.size
        fetch.append(item)
        # A changed participant.json may have other identities, which must be replaced in all files of the participant.
        # A changed document of a session may have other members.
        everything = everything or (item.kind in _NAMING and wanted.apart) or item.kind is KeyKind.SESSION
    if unit.user and not unit.is_session:
        tally.participants += 1
    return fetch, unchanged


_PLAYED = (KeyKind.RECORDING, KeyKind.TAPE)
_NAMING = (KeyKind.PARTICIPANT, KeyKind.MEMBERSHIP)
_ORDER = {kind: order for order, kind in enumerate((*_NAMING, KeyKind.SESSION))}
"""Documents of these kinds come first, in this order: the other files are read with their content."""


def version_of(item: Item, mark: str) -> str:
    """Return the version of the exported file: for a recording or a tape it also changes with the session's members."""
    return item.listed.version + (mark if item.kind in _PLAYED else "")
