"""Reads and writes the lobby's documents: of decisions, entries, and the sessions that follow from decisions.

Every write may be repeated, by the same function or by others at the same time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from datetime import timedelta

from hippodrome.control.lobby import decisions
from hippodrome.control.lobby import entries as lobby_entries
from hippodrome.control.lobby.decisions import Decisions, Formed
from hippodrome.control.lobby.entries import Entries
from hippodrome.control.log import failure, logger
from hippodrome.control.model import participant, sessions
from hippodrome.control.model.messages import StartServer, to_message
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import to_json
from hippodrome.control.model.sessions import Membership
from hippodrome.control.ports import Conflict, Platform, Topic
from hippodrome.control.storage.compare_and_swap import SharedDocuments
from hippodrome.control.storage.repository import Repository
from hippodrome.protocol import answer, session
from hippodrome.protocol.keys import answer_key, membership_key, session_key, sessions_folder
from hippodrome.protocol.session import BadSession, SessionDocument
from hippodrome.protocol.times import time_text

FORMED_LATELY = timedelta(hours=1)
"""Sessions formed within this time may not be written completely. A sweep has completed all older sessions."""


class LobbyStore:
    """Reads and writes the documents of all lobbies."""

    def __init__(self, platform: Platform, repository: Repository) -> None:
        self._platform = platform
        self._documents = platform.documents
        self._repository = repository
        self._shared = SharedDocuments(platform.documents)

    # Decisions

    def read(self, project: Project) -> Decisions:
        """Return the document of decisions. If it cannot be read, replace it by an empty one."""
        try:
            return self._shared.read(decisions.key(project.id), Decisions)
        except ValueError as error:
            failure("the lobby's document cannot be read and is made anew", error, project=project.id)
            return self.change(project, lambda document: document)

    def change(self, project: Project, change: Callable[[Decisions], Decisions]) -> Decisions:
        """Change the document of decisions, give it the next version number, and return it. Raises `RetryLater`."""

        def counted(document: Decisions) -> Decisions:
            return decisions.next_version(document, change(document))

        anew = Decisions(renewed=self._platform.now())
        return self._shared.change(decisions.key(project.id), Decisions, counted, anew=anew).after

    # Entries

    def entries(self, project: Project, label: str | None = None) -> Entries:
        """Return the entries of all participants in the lobby, or of the participant with this label.

        A participant counts as under way as long as the server that was started ahead for them can be used. So a
        participant who never comes costs no second server. AWS calls: one listing.
        """
        prefix = lobby_entries.prefix_of(project.id, label) if label else lobby_entries.folder(project.id)
        way = min(timedelta(minutes=project.max_runtime), sessions.open_for(project, self._platform.settings))
        return lobby_entries.read(project.id, self._documents.list(prefix), self._platform.now(), way)

    def delete(self, keys: Iterable[str]) -> None:
        """Delete these entries."""
        for key in keys:
            self._documents.delete(key)

    # Decisions for good

    def carry_out(self, project: Project, decided: Decisions, entries: Entries) -> Mapping[str, Membership]:
        """Write the sessions' documents and all memberships, delete the entries, and mark the decisions as done.

        Returns the memberships by label. A session's memberships are written after everything else that the session
        needs, and its mark is written last: until the mark is there, any run does all of this again. The marked
        decisions leave the document with its next other change, so that a crowd does not wait for one more write. The
        answers of unmatched participants are written at their next request (`Lobby.visit`): the sweep's role may write
        no answers.
        """
        memberships: dict[str, Membership] = {}
        for formed in decided.formed:
            memberships |= self._write_session(project, formed)
        for member in decided.unmatched:
            membership = Membership(unmatched=True, completion_code=member.completion_code, waited=member.waited)
            memberships[member.label] = self._write_membership(project, member.user_id, membership)
        self.delete(key for label in memberships for key in entries.keys.get(label, ()))
        for name in [*(formed.id for formed in decided.formed), *(member.label for member in decided.unmatched)]:
            self._documents.put(lobby_entries.done_key(project.id, name), b"")
        return memberships

    def finish_sessions(self, project: Project) -> None:
        """Write the missing memberships of sessions that were formed lately, and send start messages that may be lost.

        This is for a lobby whose document was lost while they were written: a session's own document names all its
        members. AWS calls: one listing of all sessions' documents and recordings, and a read for each session formed
        lately.
        """
        since = self._platform.now() - FORMED_LATELY
        for entry in self._documents.list(sessions_folder(project.id)):
            session_id = entry.key.split("/")[2]
            if entry.key != session_key(project.id, session_id) or entry.modified < since:
                continue
            try:
                session = self._repository.session(project.id, session_id)
            except BadSession as error:
                failure("a session's document cannot be read", error, project=project.id)
                continue
            if session is not None:
                self._finish_session(project, session)

    def _finish_session(self, project: Project, session_document: SessionDocument) -> None:
        missing = [member for member in session_document.members if member.user_id]
        missing = [name for name in missing if self._repository.membership(project.id, name.user_id) is None]
        if missing and self._repository.server_of(project.id, session_document.id) is None:
            self.start_server(project, session_document.id, session_document.players)
        for each in missing:
            membership = Membership(
                session_document.id, each.seat, len(session_document.members), players=session_document.players
            )
            self._write_membership(project, each.user_id, membership)

    def forget_done(self, project: Project, document: Decisions, entries: Entries) -> None:
        """Delete the marks of decisions that are not in `document`, which must have been read after the listing."""
        done = {*(session.id for session in document.formed), *(member.label for member in document.unmatched)}
        self.delete(lobby_entries.done_key(project.id, name) for name in sorted(entries.done - done))

    def answer_as_unmatched(self, project: Project, user_id: str) -> None:
        """Store the answer `unmatched` at each game step, which moves the participant on. An earlier answer stays."""
        answers = {"outcome": answer.UNMATCHED}
        for step in project.steps:
            if step.type.on_server:
                record = participant.new_answer(project, user_id, step, answers, self._platform.now())
                self._create(answer_key(project.id, user_id, step.key), answer.to_json(record))

    def start_server(self, project: Project, session_id: str, players: int) -> None:
        """Send the start message of this session's server. `players`: the number of players of the session."""
        self._platform.bus.publish(Topic.START, to_message(StartServer(project.id, session_id, players=players)))

    def _write_session(self, project: Project, formed: Formed) -> Mapping[str, Membership]:
        members = tuple(
            session.Member(member.user_id, member.group, seat) for seat, member in enumerate(formed.members)
        )
        session_document = SessionDocument(
            formed.id,
            formed.players,
            members,
            group=next((member.group for member in formed.members if member.label), None),
            formed=time_text(formed.at),
        )
        self._create(session_key(project.id, formed.id), session_document.to_json())
        if not formed.ahead or self._repository.server_of(project.id, formed.id) is None:
            self.start_server(project, formed.id, session_document.players)
        return {
            member.label: self._write_membership(
                project,
                member.user_id,
                Membership(formed.id, seat, len(members), waited=member.waited, players=session_document.players),
            )
            for seat, member in enumerate(formed.members)
            if member.label
        }

    def _write_membership(self, project: Project, user_id: str, membership: Membership) -> Membership:
        """Write the participant's membership and return it. An earlier membership stays, and is returned instead."""
        if self._create(membership_key(project.id, user_id), to_json(membership)):
            return membership
        earlier = self._repository.membership(project.id, user_id)
        if earlier is not None and earlier != membership:
            logger.error("a participant has another membership already", extra={"project": project.id})
        return earlier or membership

    def _create(self, key: str, body: bytes) -> bool:
        """Create a document; return False if there is one already."""
        try:
            self._documents.create(key, body)
        except Conflict:
            return False
        return True
