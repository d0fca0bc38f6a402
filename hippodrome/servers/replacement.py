"""How a lost server is replaced: by the participant's next attempt.

1. `termination.py` closes the record with the reason why the server ended, and calls `Replacement.request`.
2. `request` publishes the start message of the next attempt, if `next_attempt` names one.
3. `start.py` handles that message, and calls `Replacement.write_record`: the next attempt's record replaces the closed
   one. The trial on the new server resumes from the recordings (`trial/recordings/resume.py`).

After `AUTOMATIC_ATTEMPTS` the participant may request further attempts (`requestable_attempt`). If the message of step
2 is lost, the sweep sends it again (`overdue.py`), and so does the participant's next GET
(`participants/steps/game.py`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hippodrome.model import server
from hippodrome.model.messages import StartServer, to_message
from hippodrome.model.server import SPOT_ATTEMPTS, Reason, Server
from hippodrome.ports import Conflict, Topic

if TYPE_CHECKING:  # next_step needs the rules alone, and its zip holds what it imports
    from hippodrome.servers.services import ServerServices
    from hippodrome.storage.repository import Versioned

AUTOMATIC_ATTEMPTS = SPOT_ATTEMPTS + 1  # a lost server is replaced automatically up to this attempt, which is on demand
MAX_ATTEMPTS = 8  # and at the participant's request up to this one
REPLACED = (Reason.LOST, Reason.NO_CAPACITY)  # the reasons after which it makes sense to start another automatically


def next_attempt(closed: Server) -> int | None:
    """The attempt that replaces a closed server automatically; None if it stays closed, as a warm server does."""
    if closed.is_warm_server or not closed.is_closed or closed.attempt >= AUTOMATIC_ATTEMPTS:
        return None
    return closed.attempt + 1 if closed.reason in REPLACED else None


def requestable_attempt(record: Server) -> int | None:
    """The attempt that the participant may request, or None. An attempt that found no slot may be repeated."""
    if not record.is_closed or next_attempt(record) is not None:
        return None
    if record.reason is Reason.FULL:
        return record.attempt
    return record.attempt + 1 if record.attempt < MAX_ATTEMPTS else None


class Replacement:
    """Requests the next attempt of a closed server, and writes its record."""

    def __init__(self, services: ServerServices) -> None:
        self._services = services

    def request(self, closed: Server) -> None:
        """Publish the start message of the next attempt, unless the participant has finished all game steps."""
        following = next_attempt(closed)
        if following is None or self._has_played(closed):
            return
        start = StartServer(closed.project_id, closed.user_id, following)
        self._services.platform.bus.publish(Topic.START, to_message(start))

    def write_record(self, new: Server) -> Versioned:
        """Replace the closed record of the previous attempt. Raises `Conflict` if there is no such record."""
        before = self._services.repository.server(new.label)
        if before is None or before.server.attempt != new.attempt - 1 or not before.server.is_closed:
            raise Conflict
        return self._services.repository.save(server.replacing(before.server, new), before.etag)

    def _has_played(self, closed: Server) -> bool:
        """Whether all game steps are answered: a server may be lost between its last answer and its stop."""
        project = self._services.project_cache.live_project(closed.project_id)
        if project is None or not project.game_steps:
            return False
        progress = self._services.repository.progress(closed.project_id, closed.user_id)
        return all(step in progress.answered for step in project.game_steps)
