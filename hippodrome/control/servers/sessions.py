"""Decides when a session (`project.players`) is over, and whether a member's stop message stops its server.

A session owns its server's record, so its server starts, ends and is replaced like other servers. A member cannot end
it for the others: a member's stop message stops it only if all members have reached the stop step. The stop message of
a participant who is no member yet only makes them leave the lobby.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hippodrome.control.log import failure
from hippodrome.control.model import participant
from hippodrome.control.model.messages import StopServer
from hippodrome.control.model.project import Project
from hippodrome.control.storage.repository import Repository
from hippodrome.protocol.session import BadSession, SessionDocument

if TYPE_CHECKING:  # sign_requests needs `members_of` alone, and each further import would be in its zip
    from hippodrome.control.servers.services import ServerServices


def readable_session(repository: Repository, project_id: str, session_id: str) -> SessionDocument | None:
    """Return the session's document. AWS calls: one read.

    The result is None if there is no document yet, or if it cannot be read, which is logged.
    """
    try:
        return repository.session(project_id, session_id)
    except BadSession as error:
        failure("a session's document cannot be read", error, project=project_id)
        return None


def members_of(repository: Repository, project_id: str, session_id: str) -> list[str]:
    """Return the ids of the session's members; none before the session is formed, or if its document cannot be read."""
    session = readable_session(repository, project_id, session_id)
    return session.user_ids if session else []


class Sessions:
    """Decides, by reading the members' documents, whether the servers of sessions are stopped."""

    def __init__(self, services: ServerServices) -> None:
        self._services = services
        self._repository = services.repository

    def has_sessions(self, project_id: str) -> bool:
        """Return whether several participants share a server in this project; False if it is not registered."""
        project = self._services.project_cache.project(project_id)
        return project is not None and project.has_sessions

    def stop_of(self, message: StopServer) -> StopServer | None:
        """Return the stop message for the session's server that follows from this message of one of its members.

        The result is None as long as other members play, or if the participant is no member yet. Deletes the
        participant's entries in the lobby, so that nobody is matched with them. The participant counts as one who has
        reached the stop step: the message is published before the answer that leads there is stored.
        """
        project = self._services.project_cache.project(message.project_id)
        if project is None:
            return None
        self._services.lobby.forget(project, message.user_id)
        session_id = self._repository.session_id(project, message.user_id)
        session = readable_session(self._repository, project.id, session_id) if session_id else None
        if session is None or not self.is_over(project, session, leaves=message.user_id):
            return None
        return StopServer(project.id, session.id, None, message.reason)

    def is_over(self, project: Project, session: SessionDocument, leaves: str = "") -> bool:
        """Return whether all members have reached the stop step. `leaves` is the id of a member who certainly has.

        The result is False in a project without a stop step: there the trial ends by itself. AWS calls: one listing for
        each other member.
        """
        return all(self._has_left(project, user_id) for user_id in session.user_ids if user_id != leaves)

    def _has_left(self, project: Project, user_id: str) -> bool:
        progress, own = self._repository.path_of(project, user_id)
        return progress.has_ended or participant.is_past_server(own, progress.due_step(own))
