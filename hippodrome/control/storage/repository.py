"""Reads and writes the records of participants, sessions and servers (answers: `participants/answers.py`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

from hippodrome.control.log import logger
from hippodrome.control.model import ids, participant, server, sessions
from hippodrome.control.model.design import Assignment
from hippodrome.control.model.participant import Ended, Participant, Progress
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Server
from hippodrome.control.model.sessions import Membership
from hippodrome.control.ports import Conflict, Documents, RetryLater
from hippodrome.protocol import session
from hippodrome.protocol.keys import membership_key, participant_folder, session_key
from hippodrome.protocol.session import SessionDocument, assignment_key

CACHED_ASSIGNMENTS = 500
TRIES = 8  # for one change; after that the queue delivers the message again


@dataclass(frozen=True)
class Versioned:
    """A server's record, with the ETag of the version that was read or written."""

    server: Server
    etag: str


class Repository:
    """Reads and writes records by the documents port.

    A method makes one AWS call unless its docstring says otherwise.
    """

    def __init__(self, documents: Documents) -> None:
        self._documents = documents
        self._assignments: dict[tuple[str, datetime], Assignment] = {}

    # Participants

    def progress(self, project_id: str, user_id: str) -> Progress:
        """Return the participant's progress, by a listing of their folder."""
        folder = participant_folder(project_id, user_id)
        return Progress.from_listing(folder, self._documents.list(folder))

    def participant(self, project_id: str, user_id: str) -> Participant | None:
        """Return the participant's record; None if there is none or if it cannot be read."""
        document = self._documents.get(participant.participant_key(project_id, user_id))
        try:
            return from_json(document.body, Participant) if document else None
        except ValueError:
            logger.error("a participant's record cannot be read", extra={"project": project_id})
            return None

    def create_participant(self, record: Participant) -> bool:
        """Write the record of a participant's first visit; return False if there is one already."""
        return self._created(participant.participant_key(record.project_id, record.user_id), to_json(record))

    def assignment(self, project_id: str, owner: str, written: datetime | None = None) -> Assignment | None:
        """Return the levels and orders of a participant or a session; None if none were drawn.

        They never change, so they are cached if the time is given at which a listing says that they were `written`: who
        was erased and comes again gets others. Raises ValueError if the document cannot be read.
        """
        key = assignment_key(project_id, owner)
        if written is not None and (cached := self._assignments.get((key, written))):
            return cached
        document = self._documents.get(key)
        if document is None:
            return None
        assignment = from_json(document.body, Assignment)
        if written is not None:
            if len(self._assignments) >= CACHED_ASSIGNMENTS:
                self._assignments.clear()
            self._assignments[key, written] = assignment
        return assignment

    def create_assignment(self, project_id: str, owner: str, record: Assignment) -> bool:
        """Write the levels and orders of a participant or a session; return False if there are some already."""
        return self._created(assignment_key(project_id, owner), to_json(record))

    def ended(self, project_id: str, user_id: str) -> Ended | None:
        """Return the record of the end that the participant has reached; None if there is none."""
        document = self._documents.get(participant.end_key(project_id, user_id))
        return from_json(document.body, Ended) if document else None

    def create_ended(self, project_id: str, user_id: str, record: Ended) -> bool:
        """Write the record of the end that a participant has reached; return False if there is one already."""
        return self._created(participant.end_key(project_id, user_id), to_json(record))

    def assignment_of(self, project: Project, user_id: str, progress: Progress) -> Assignment | None:
        """Return the participant's levels and orders; None if the study has none, or if none were drawn.

        AWS calls: one read, unless they are cached or there are none.
        """
        has_one = project.assigns and progress.assigned is not None
        return self.assignment(project.id, user_id, progress.assigned) if has_one else None

    def path_of(self, project: Project, user_id: str) -> tuple[Progress, Project]:
        """Return the participant's progress, and the project with their own path.

        AWS calls: one listing, and one read if they have an assignment.
        """
        progress = self.progress(project.id, user_id)
        return progress, project.own(self.assignment_of(project, user_id, progress))

    def _created(self, key: str, body: bytes) -> bool:
        try:
            self._documents.create(key, body)
        except Conflict:
            return False
        return True

    # Sessions (`project.players`)

    def membership(self, project_id: str, user_id: str) -> Membership | None:
        """Return the participant's membership; None as long as it is not decided whether they play or are unmatched.

        Raises ValueError if the document cannot be read.
        """
        document = self._documents.get(membership_key(project_id, user_id))
        return sessions.read_membership(document.body) if document else None

    def session_id(self, project: Project, user_id: str) -> str | None:
        """Return the id of the session that the participant is a member of; None if there is none.

        AWS calls: none in a project without sessions. Raises the same errors as `membership`.
        """
        membership = self.membership(project.id, user_id) if project.has_sessions else None
        return membership.session if membership else None

    def session(self, project_id: str, session_id: str) -> SessionDocument | None:
        """Return the session's document; None if there is none. Raises `BadSession` if it cannot be read."""
        document = self._documents.get(session_key(project_id, session_id))
        return session.parse(document.body) if document else None

    # Servers

    def project_of_own_server(self, project: Project, user_id: str) -> Project | None:
        """Return the registration for one player, if a server of the participant's own still runs it; else None.

        The result is None too if that server has ended for good, or if the participant has a membership and plays with
        others (a function that had not read the new registration yet may have started the server). No AWS call is made
        if one player is registered now, or never was. Raises the same errors as `membership`.
        """
        before = project.for_session(1) if project.has_sessions else None
        record = self.server_of(project.id, user_id) if before else None
        if record is None or not server.plays_on(record):
            return None
        return None if self.membership(project.id, user_id) else before

    def server_of(self, project_id: str, user_id: str) -> Server | None:
        """Return the record of the server of this participant or session; None if there is none."""
        stored = self.stored_server(project_id, user_id)
        return stored.server if stored else None

    def stored_server(self, project_id: str, owner: str) -> Versioned | None:
        """Return the record of the server of this participant, session or warm server, with its ETag; None if none."""
        return self.server(ids.server_label(project_id, owner))

    def server(self, label: str) -> Versioned | None:
        """Return the record under a label, with its ETag; None if there is none."""
        document = self._documents.get(server.key(label))
        return Versioned(from_json(document.body, Server), document.etag) if document else None

    def owner(self, name: str) -> Versioned | None:
        """Return the record that owns the resources of this name, following handovers; None if there is none.

        The record may be at another attempt now: compare its `name`. AWS calls: one read; two for an assigned warm
        server.
        """
        return server.owner(name, self.server, lambda stored: stored.server)

    def create(self, record: Server) -> Versioned:
        """Create the record of a server. Raises `Conflict` if its participant or session has one already."""
        return Versioned(record, self._documents.create(server.key(record.label), to_json(record)))

    def save(self, record: Server, etag: str) -> Versioned:
        """Write the next version of a server's record. Raises `Conflict` if the present version has another ETag."""
        return Versioned(record, self._documents.replace(server.key(record.label), to_json(record), etag))

    def update(self, stored: Versioned | None, change: Callable[[Server], Server | None]) -> Versioned | None:
        """Apply `change` to the record and write the result; after a `Conflict`, read the record again and repeat.

        Returns the version written; None if `change` returns None or there is no record. Raises `RetryLater` after
        `TRIES` conflicts.
        """
        for _ in range(TRIES):
            after = change(stored.server) if stored else None
            if stored is None or after is None:
                return None
            try:
                return self.save(after, stored.etag)
            except Conflict:
                stored = self.server(after.label)
        raise RetryLater("the record keeps changing")
