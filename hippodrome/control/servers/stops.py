"""Handles the messages of the stop topic: for one server, or, as HIPPO sends them, for all servers of a participant.

A principal that may publish to the stop topic may stop any server of the installation. So a message without a project
is for all projects. It costs a read of the master list, and for each project a read of one record. A participant's
message does not stop the server of a session on which others still play (`sessions.py`).
"""

from __future__ import annotations

from collections.abc import Sequence

from hippodrome.control.log import failure, logger
from hippodrome.control.model.messages import StopServer, StopUser
from hippodrome.control.servers.batches import for_each
from hippodrome.control.servers.services import ServerServices
from hippodrome.control.servers.sessions import Sessions
from hippodrome.control.servers.termination import Termination

MAX_READS = 2_000  # reads of records in one invocation. Messages beyond them come again; one is always handled


class Stops:
    """Handles the messages of `stop_server`."""

    def __init__(self, services: ServerServices) -> None:
        self._services = services
        self._termination = Termination(services)
        self._sessions = Sessions(services)

    def handle(self, batch: Sequence[StopServer | StopUser]) -> list[StopServer | StopUser]:
        """Stop servers; return the messages that should be delivered again."""
        again = self._termination.stop([message for message in batch if isinstance(message, StopServer)])
        return [*again, *self._stop_everywhere([message for message in batch if isinstance(message, StopUser)])]

    def _stop_everywhere(self, batch: Sequence[StopUser]) -> list[StopUser]:
        """Stop the open servers of these participants; return the messages that should be delivered again."""
        if not batch:
            return []
        try:
            projects = self._services.project_cache.ids()
        except Exception as error:  # noqa: BLE001 - the messages for single servers need no list, and are handled
            failure("the list of projects cannot be read", error)
            return list(batch)
        messages = list(dict.fromkeys(batch))
        now = messages[: max(1, MAX_READS // max(1, len(projects)))]
        candidates = [StopServer(project_id, message.user_id) for message in now for project_id in projects]
        opened, unread = for_each(self._services.platform, candidates, self._open, "a record cannot be read")
        stops = [stop for _, stop in opened]
        logger.info("participants are stopped in all projects", extra={"participants": len(now), "servers": len(stops)})
        failed = {stop.user_id for stop in [*self._termination.stop(stops), *unread]}
        return [message for message in messages if message not in now or message.user_id in failed]

    def _open(self, stop: StopServer) -> StopServer | None:
        """The message, if the participant has an open server in the project or may have a session; else None."""
        stored = self._services.repository.stored_server(stop.project_id, stop.user_id)
        if stored is not None and not stored.server.is_closed:
            return stop
        return stop if self._sessions.has_sessions(stop.project_id) else None
