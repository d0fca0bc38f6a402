"""Erases one participant's documents from one project: in a bucket, in all their versions, or in a data folder.

First all documents that others share are written anew without the participant, and their earlier versions deleted.
Then the participant's own documents are deleted; last the record of their server, which leads to others. So a run that
is cut off anywhere is simply repeated: what is left leads to all the rest.

A session's documents belong to all its members. Each recording and tape is written anew without what this participant
alone has sent (`hippodrome/export/without_member.py`), then the session's document without their id. When all members
are erased, the session is deleted.
"""

from __future__ import annotations

import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from hippodrome.control.limits.rules import ParticipantSlots, participant_slots_folder
from hippodrome.control.lobby import decisions, entries, rules
from hippodrome.control.lobby.decisions import Decisions
from hippodrome.control.model import ids, server
from hippodrome.control.model.balance import Cells, cells_key
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Server
from hippodrome.control.model.sessions import read_membership
from hippodrome.deployment.aws.object_version import Version
from hippodrome.deployment.core.server_records import keys_of_warm_servers, warm_servers_of
from hippodrome.export import without_member
from hippodrome.protocol import session as sessions
from hippodrome.protocol.keys import (
    groups_folder,
    membership_key,
    participant_folder,
    questions_folder,
    session_folder,
    session_key,
    sessions_folder,
)

AT_ONCE = 10  # documents that are read at the same time
TRIES = 5  # at a document that a function writes again and again
_PLAYED = re.compile(r"\.jsonl\.gz(\.part)?$|/trials/[^/]+/[^/]+-talk-[0-9]+\.json$")  # a recording, a piece of a tape
_SERVER = re.compile(r"s[a-z2-7]{20}(?=[-.])")


class Store(Protocol):
    """Where documents lie: `VersionedBucket`, or `DataFolder`, in which each has one version. For several threads."""

    def versions(self, prefix: str) -> Iterator[Version]:
        """Return every version and delete marker whose key has this prefix."""

    def uploads(self, prefix: str) -> Iterator[Version]:
        """Return every unfinished upload whose key has this prefix."""

    def read(self, version: Version) -> bytes:
        """Return the content of a version; empty if it is gone or is a delete marker."""

    def fetch(self, version: Version, to: Path) -> None:
        """Write the content of a version into a file."""

    def store(self, key: str, file: Path) -> None:
        """Store a file's content as the newest version, whole or not at all."""

    def replace(self, key: str, before: bytes, after: bytes) -> bool:
        """Store a small document if its newest version is still `before`. Return whether it was stored."""

    def delete(self, versions: Iterable[Version], note: Callable[[Sequence[Version]], None]) -> object:
        """Delete these versions for good. `note` gets those that are deleted."""


@dataclass(frozen=True)
class FoundSession:
    """A session of the participant. `others`: whether other members stay in it."""

    id: str
    seat: int
    others: bool


class Found(NamedTuple):
    """What one look found: versions of own documents, keys of documents that others share, and sessions."""

    own: list[Version]
    shared: list[str]
    sessions: list[FoundSession]

    def counts(self) -> dict[str, int]:
        """Return how much was found, by kind."""
        return {"documents": len(self.own) + len(self.shared), "sessions": len(self.sessions)}


class Eraser:
    """Erases one participant's documents from one project. None of their servers may run."""

    def __init__(
        self, store: Store, project: str, user: str, *, plays: Callable[[str], bool] = lambda session: False
    ) -> None:
        """`plays` says whether a session plays again. Its document is then kept, and with it the way to its data."""
        self.project, self.user = project, user
        self.deleted = Counter[str]()  # deleted versions, by their keys without the participant's id
        self.rewritten: dict[str, None] = {}  # the keys of documents that others share and that were written anew
        self.unreadable: dict[str, None] = {}  # the keys of documents that name the participant and cannot be read
        self._store, self._plays = store, plays
        self._advance: Callable[[int], object] = lambda number: None
        self._label = ids.server_label(project, user)
        self._folder = participant_folder(project, user)

    # -- looking

    def look(self) -> Found:
        """Find everything about this participant. Changes nothing."""
        own = [*self._in_lobby(), *self._own()]
        shared = [key for key in self._shared() if key not in self.unreadable and self._naming(self._versions_of(key))]
        return Found(own, shared, self.sessions())

    def sessions(self) -> list[FoundSession]:
        """Find the sessions whose documents name the participant, in any version; and by their membership."""
        found: dict[str, FoundSession] = {}
        folder = sessions_folder(self.project)
        versions = [version for version in self._store.versions(folder) if version.key.endswith("/session.json")]
        for version, body in zip(versions, self._read(versions), strict=True):
            try:
                document = sessions.parse(body)
            except sessions.BadSession:
                if self._names(body):
                    self.unreadable[version.key] = None
                continue
            if member := document.member(self.user):
                others = any(user != self.user for user in document.user_ids)
                before = found.get(document.id)
                found[document.id] = FoundSession(document.id, member.seat, others and (not before or before.others))
        theirs = self._membership()
        if theirs and theirs.id not in found and any(self._store.versions(session_folder(self.project, theirs.id))):
            found[theirs.id] = theirs  # its own document is lost, or a run was cut off after that was written anew
        return sorted(found.values(), key=lambda session: session.id)

    def record(self, owner: str) -> Server | None:
        """Read the record of the server of the participant, or of a session; None if none can be read."""
        try:
            return from_json(self._body(server.key(ids.server_label(self.project, owner))), Server)
        except ValueError:
            return None

    def _membership(self) -> FoundSession | None:
        try:
            membership = read_membership(self._body(membership_key(self.project, self.user)))
        except ValueError:
            return None
        return FoundSession(membership.session, membership.seat, others=True) if membership.session else None

    def _own(self) -> Iterator[Version]:
        folder = self._folder
        return chain(self._store.versions(folder), self._store.uploads(folder), self._of_server(self.user))

    def _of_server(self, owner: str) -> Iterator[Version]:
        """Yield the documents of the warm servers that this owner was given, then the record, which leads to them."""
        keys = keys_of_warm_servers(self.project, warm_servers_of(self.record(owner)))
        for key in (*keys, server.key(ids.server_label(self.project, owner))):
            yield from self._versions_of(key)

    def _in_lobby(self) -> list[Version]:
        """Return their entries, and the questions to the function `match`, and its answers, that name them."""
        folders = (questions_folder(self.project), groups_folder(self.project))
        asked = [version for folder in folders for version in self._store.versions(folder)]
        return [*self._store.versions(entries.prefix_of(self.project, self._label)), *self._naming(asked)]

    def _shared(self) -> dict[str, Callable[[bytes], bytes]]:
        """Return the keys of small documents that all participants share, each with the function that erases in it.

        The functions raise ValueError for a document that they cannot read.
        """
        slots = {version.key for version in self._store.versions(participant_slots_folder(self.project))}
        return {
            decisions.key(self.project): self._out_of_decisions,
            cells_key(self.project): lambda body: to_json(from_json(body, Cells).without(self.user)),
            **dict.fromkeys(slots, lambda body: to_json(from_json(body, ParticipantSlots).without(self._label))),
        }

    def _names(self, body: bytes) -> bool:
        return self._label.encode() in body or f'"{self.user}"'.encode() in body

    def _naming(self, versions: Sequence[Version]) -> list[Version]:
        """Return those of these versions that name the participant. It keeps no content: there may be thousands."""
        with ThreadPoolExecutor(AT_ONCE) as pool:
            named = pool.map(lambda version: self._names(self._store.read(version)), versions)
            return [version for version, names in zip(versions, named, strict=True) if names]

    def _versions_of(self, key: str) -> list[Version]:
        return [version for version in self._store.versions(key) if version.key == key]

    def _newest(self, key: str) -> Version | None:
        return next((version for version in self._versions_of(key) if version.latest and not version.marker), None)

    def _body(self, key: str) -> bytes:
        newest = self._newest(key)
        return self._store.read(newest) if newest else b""

    def _read(self, versions: Sequence[Version]) -> list[bytes]:
        with ThreadPoolExecutor(AT_ONCE) as pool:
            return list(pool.map(self._store.read, versions))

    # -- erasing

    def erase(self, advance: Callable[[int], object] = lambda number: None) -> None:
        """Erase the participant. `advance` gets the numbers of versions that were deleted.

        What somebody else has changed or stored meanwhile is left; a look finds it, and a second call erases it.
        """
        self._advance = advance
        for session in self.sessions():
            self.leave(session)
        for key, without in self._shared().items():
            self._rewrite(key, without)
        self._delete(self._in_lobby())  # the lobby asks `match` again, without the participant
        self._delete(self._own())

    def leave(self, session: FoundSession) -> None:
        """Take the participant out of this session's documents; after the last member, delete the session."""
        folder, document = session_folder(self.project, session.id), session_key(self.project, session.id)
        keys = dict.fromkeys(version.key for version in self._store.versions(folder))
        for key in filter(_PLAYED.search, keys):
            self._rewrite_played(key, session.seat)
        self._delete(self._store.uploads(folder))
        if self._plays(session.id):
            return
        if session.others:
            self._rewrite(document, self._out_of_session)
            return
        self._delete(version for version in self._store.versions(folder) if version.key != document)
        self._delete(self._of_server(session.id))
        self._delete(self._versions_of(document))

    def _rewrite(self, key: str, without: Callable[[bytes], bytes]) -> None:
        """Write a document anew if it names the participant, and delete its history.

        After `TRIES` that others' writes have refused, its newest version still names them, and a look finds it.
        """
        for _ in range(TRIES):
            body = self._body(key)
            if not self._names(body):
                break
            try:
                after = without(body)
            except ValueError:
                self.unreadable[key] = None
                return
            if self._store.replace(key, body, after):
                self.rewritten[self._nameless(key)] = None
                break
        self._delete_earlier(key)

    def _rewrite_played(self, key: str, seat: int) -> None:
        newest = self._newest(key)
        with tempfile.TemporaryDirectory(prefix="hippodrome-") as folder:
            before, after = Path(folder, Path(key).name), Path(folder, "after")
            if newest:
                self._store.fetch(newest, before)
                if without_member.rewrite(before, after, seat, self.user):
                    self._store.store(key, after)
                    self.rewritten[self._nameless(key)] = None
        self._delete_earlier(key)

    def _delete_earlier(self, key: str) -> None:
        """Delete all versions of a document but the newest; if that is a delete marker, all of them."""
        versions = self._versions_of(key)
        gone = any(version.latest and version.marker for version in versions)
        self._delete(version for version in versions if gone or not version.latest)

    def _delete(self, versions: Iterable[Version]) -> None:
        self._store.delete(list(versions), self._note)

    def _note(self, deleted: Sequence[Version]) -> None:
        self.deleted.update(self._nameless(version.key) for version in deleted)
        self._advance(len(deleted))

    def _nameless(self, key: str) -> str:
        """Return the key without the participant's id, and without labels of servers, which are hashes of ids."""
        rest = key.removeprefix(self._folder)
        parts = ["{userId}" if self.user in part else _SERVER.sub("{server}", part) for part in rest.split("/")]
        return "/".join(parts if rest == key else [self.project, "users", "{userId}", *parts])

    def _out_of_decisions(self, body: bytes) -> bytes:
        decided = from_json(body, Decisions)
        return to_json(decisions.next_version(decided, rules.without(decided, self._label)))

    def _out_of_session(self, body: bytes) -> bytes:
        document = sessions.parse(body)
        members: tuple[Any, ...] = tuple(
            replace(member, user_id="") if member.user_id == self.user else member for member in document.members
        )
        return replace(document, members=members).to_json()
