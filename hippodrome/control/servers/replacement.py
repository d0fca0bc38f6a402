"""Replaces a lost server by the next attempt of its participant or session.

1. `termination.py` closes the record with the reason why the server ended, and calls `Replacement.request`.
2. `request` publishes the start message of the next attempt, if `next_attempt` names one.
3. `start.py` handles that message, and calls `Replacement.write_record`: the next attempt's record replaces the closed
   one. The trial on the new server resumes from the recordings (`hippodrome/trial/recordings/resume.py`).

After `AUTOMATIC_ATTEMPTS` attempts (two on Spot, one on demand) the participant may request further ones, up to
`MAX_ATTEMPTS` (`requestable_attempt`). These rules are in `model/server.py`. If the message of step 2 is lost, the
sweep sends it again (`overdue.py`), and so does the participant's next GET (`participants/steps/game.py`).
"""

from __future__ import annotations

from hippodrome.control.model import server
from hippodrome.control.model.messages import StartServer, to_message
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Server, next_attempt
from hippodrome.control.ports import Conflict, Topic
from hippodrome.control.servers.services import ServerServices
from hippodrome.control.servers.sessions import members_of
from hippodrome.control.storage.repository import Versioned


class Replacement:
    """Requests the next attempt of a closed server, and writes its record."""

    def __init__(self, services: ServerServices) -> None:
        self._services = services

    def request(self, closed: Server) -> None:
        """Publish the start message of the next attempt, if the closed server is replaced.

        Nothing is published if all its participants have answered all game steps.
        """
        following = next_attempt(closed)
        if following is None or self._has_played(closed):
            return
        start = StartServer(closed.project_id, closed.user_id, following)
        self._services.platform.bus.publish(Topic.START, to_message(start))

    def write_record(self, new: Server) -> Versioned:
        """Replace the closed record of the previous attempt by this one.

        Raises `Conflict` if there is no such record.
        """
        before = self._services.repository.server(new.label)
        if before is None or before.server.attempt != new.attempt - 1 or not before.server.is_closed:
            raise Conflict
        return self._services.repository.save(server.replacing(before.server, new), before.etag)

    def _has_played(self, closed: Server) -> bool:
        """Whether all participants of this server have answered all game steps, so that it needs no replacement.

        A server may be lost between its last answer and its stop.
        """
        project = self._services.project_cache.live_project(closed.project_id)
        if project is None or not project.game_steps:
            return False
        players = self._players(closed)
        return bool(players) and all(self._has_finished(project, user_id) for user_id in players)

    def _players(self, closed: Server) -> list[str]:
        """The ids of the participants who play on this server; none if its session is not formed yet."""
        if not closed.is_of_session:
            return [closed.user_id]
        return members_of(self._services.repository, closed.project_id, closed.user_id)

    def _has_finished(self, project: Project, user_id: str) -> bool:
        progress, own = self._services.repository.path_of(project, user_id)
        return progress.has_ended or all(step in progress.answered for step in own.game_steps)
