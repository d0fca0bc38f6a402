"""Takes one participant out of the sessions in which they played with others.

A session's documents belong to all its members. So each recording is written anew without the lines and values that are
this participant's alone (`hippodrome/export/without_member.py`), and its older versions are deleted. Then the session's
document is written anew, with an empty id at the participant's seat. The document leads to the recordings, so it is
written last: a run after an interruption finds the session again. When all members are erased, all documents of the
session are deleted.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from hippodrome.control.model import memberships
from hippodrome.deployment.aws.object_version import Version
from hippodrome.deployment.operate.storage import Note, Storage, newest, older, read_all
from hippodrome.export import without_member
from hippodrome.export.tape_without_member import without_member as without_member_of_tape
from hippodrome.protocol import session as sessions
from hippodrome.protocol.keys import membership_key, session_folder, session_key, sessions_folder
from hippodrome.protocol.session import BadSession, SessionDocument, is_session_id

_RECORDING = ".jsonl.gz"
_PIECE = re.compile(r"/trials/[^/]+/[^/]+-talk-[0-9]+\.json$")


@dataclass(frozen=True)
class FoundSession:
    """A session whose document names the participant, in any version. `others`: whether other members stay in it."""

    id: str
    seat: int
    others: bool


class SessionEraser:
    """Takes one participant out of one project's sessions. May be interrupted anywhere and called again."""

    def __init__(self, storage: Storage, project: str, user: str) -> None:
        self._storage = storage
        self._project = project
        self._user = user
        self.rewritten = 0
        """The number of recordings that were written anew."""
        self.unreadable: list[str] = []
        """The keys of documents that may name the participant and cannot be read."""

    # -- looking

    def sessions(self) -> list[FoundSession]:
        """Find the sessions whose documents name the participant."""
        documents: dict[str, list[Version]] = {}
        existing = set()
        folder = sessions_folder(self._project)
        for version in self._storage.versions(folder):
            session, _, name = version.key.removeprefix(folder).partition("/")
            if is_session_id(session):
                existing.add(session)
                if name == "session.json" and not version.marker:
                    documents.setdefault(session, []).append(version)
        self.unreadable = []
        every = [(session, version) for session, versions in documents.items() for version in versions]
        bodies = read_all(self._storage, [version for _, version in every])
        by_id: dict[str, FoundSession] = {}
        for (session, version), body in zip(every, bodies, strict=True):
            self._look(session, version.key, body, by_id)
        theirs = self._membership() if existing else None
        if theirs is not None and theirs.id in existing and theirs.id not in by_id and theirs.id not in documents:
            by_id[theirs.id] = theirs
        return sorted(by_id.values(), key=lambda session: session.id)

    def _look(self, session: str, key: str, body: bytes, by_id: dict[str, FoundSession]) -> None:
        try:
            parsed = sessions.parse(body)
        except BadSession:
            if self._user.encode() in body:
                self.unreadable.append(key)
            return
        member = parsed.member(self._user)
        if member is not None:
            others = any(member.user_id not in ("", self._user) for member in parsed.members)
            before = by_id.get(session)
            by_id[session] = FoundSession(session, member.seat, others and (before is None or before.others))

    def _membership(self) -> FoundSession | None:
        """Find the session by the participant's membership document, if the session's own document is lost."""
        try:
            for version in self._storage.versions_of(membership_key(self._project, self._user)):
                if not version.marker:
                    membership = memberships.read(self._storage.read(version))
                    return (
                        FoundSession(membership.session, membership.seat, others=True) if membership.session else None
                    )
        except ValueError:
            return None
        return None

    # -- erasing

    def leave_sessions(self, note: Note = lambda _: None) -> None:
        """Take the participant out of all their sessions. No server of these sessions may run."""
        for session in self.sessions():
            self.leave(session, note)

    def leave(self, session: FoundSession, note: Note) -> None:
        """Take the participant out of one session, whose server must not run."""
        if session.others:
            self.take_out(session, note)
            self.take_name(session, note)
        else:
            self.delete_session(session, note)

    def take_out(self, session: FoundSession, note: Note) -> None:
        """Write the session's recordings without the participant, and delete their earlier versions."""
        folder = session_folder(self._project, session.id)
        for key in dict.fromkeys(version.key for version in self._storage.versions(folder)):
            if key.endswith(_RECORDING) or _PIECE.search(key):
                self._rewrite(key, session.seat)
                self._storage.delete(older(self._storage, key), note)
        self._storage.delete([*self._storage.uploads(folder)], note)

    def take_name(self, session: FoundSession, note: Note) -> None:
        """Write the session's document without the participant's id. This is the last step."""
        key = session_key(self._project, session.id)
        last = newest(self._storage, key)
        if last is None:
            return
        body = self._storage.read(last)
        try:
            parsed = sessions.parse(body)
        except BadSession:
            return
        if parsed.member(self._user) is not None and not self._storage.replace(key, body, self._without(parsed)):
            return
        self._storage.delete(older(self._storage, key), note)

    def _without(self, parsed: SessionDocument) -> bytes:
        members = (replace(member, user_id="") if member.user_id == self._user else member for member in parsed.members)
        return replace(parsed, members=tuple(members)).to_json()

    def delete_session(self, session: FoundSession, note: Note) -> None:
        """Delete all documents of a session without other members; the session's own document comes last."""
        folder, last = session_folder(self._project, session.id), session_key(self._project, session.id)
        self._storage.delete([*self._storage.uploads(folder)], note)
        self._storage.delete([version for version in self._storage.versions(folder) if version.key != last], note)
        self._storage.delete([*self._storage.versions_of(last)], note)

    def _rewrite(self, key: str, seat: int) -> None:
        last = newest(self._storage, key)
        if last is None:
            return
        with tempfile.TemporaryDirectory(prefix="hippodrome-") as folder:
            before, after = Path(folder, "before"), Path(folder, "after")
            self._storage.fetch(last, before)
            if key.endswith(_RECORDING):
                differs = without_member.rewrite(before, after, seat, self._user)
            else:
                piece = before.read_bytes()
                after.write_bytes(without_member_of_tape(piece, seat, self._user))
                differs = piece != after.read_bytes()
            if differs:
                self._storage.store(key, after)
                self.rewritten += 1
