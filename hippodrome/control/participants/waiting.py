"""Makes the state of a participant's server, as JSON data for the game page."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from hippodrome.control.model.design import Step
from hippodrome.control.model.server import (
    Reason,
    Server,
    ServerState,
    may_go_without,
    next_attempt,
    requestable_attempt,
)
from hippodrome.control.participants.visit import Visit
from hippodrome.control.ports import Platform
from hippodrome.control.storage.secret import SecretCache

MAX_START_TIMES = 50  # so many of the latest starts count for `typical`
FAILURES = (Reason.LOST, Reason.REFUSED, Reason.NO_CAPACITY, Reason.FULL)


class ServerStates:
    """Makes the states of servers (docs/pages.md), and remembers how long their latest starts took."""

    def __init__(self, platform: Platform, secrets: SecretCache) -> None:
        self._platform = platform
        self._secrets = secrets
        self._start_times: list[float] = []  # seconds from request to ready

    def state(
        self,
        visit: Visit,
        step: Step | None,
        record: Server | None,
        since: datetime | None = None,
        *,
        asked: int | None = None,
    ) -> dict[str, Any]:
        """Return the state of the participant's server as JSON data for the game page (docs/pages.md).

        `since` is when the participant reached the step. As long as there is no record, the state's `seconds` count
        from then; after that they count from the server's request. `asked` is an attempt that was requested after an
        earlier one had ended (`attempt_after_pause`): before its record is there, it is queued.
        """
        state: dict[str, Any] = {
            "state": ServerState.QUEUED,
            "attempt": 1,
            "again": False,
            "without": False,
            "reason": None,
            "replaces": False,
            "userId": visit.user_id,
            "step": step.key if step else next(iter(visit.project.game_steps), None),
        }
        if record is not None and record.is_closed and asked is not None and record.attempt < asked:
            state["attempt"] = asked
        elif record is not None:
            since = record.requested
            state.update(state=record.state, attempt=record.attempt, reason=record.reason, replaces=_replaces(record))
            if record.is_closed:
                state.update(_closed(record))
            elif step is not None and step.type.on_server and record.lacks(step.key):
                state["state"] = ServerState.QUEUED  # `GameStep` has this server stopped, and another will start
            elif record.state is ServerState.READY and (host := record.browser_host(self._platform.dns)):
                self._remember(record)
                state["url"] = self._platform.settings.game_address(host, record.port)
                state["token"] = self._secrets.token(record)
        state["seconds"] = max(0, round((visit.now - since).total_seconds())) if since else 0
        state["typical"] = round(sorted(self._start_times)[len(self._start_times) // 2]) if self._start_times else None
        return state

    def _remember(self, record: Server) -> None:
        """Keep the time that this start took, for `typical`."""
        if record.ready:
            self._start_times = [
                *self._start_times[1 - MAX_START_TIMES :],
                (record.ready - record.requested).total_seconds(),
            ]


def _closed(record: Server) -> dict[str, Any]:
    """The part of the state that follows from a closed record."""
    if next_attempt(record) is not None:
        return {"state": ServerState.QUEUED, "attempt": record.attempt + 1, "replaces": record.reason is Reason.LOST}
    over = "failed" if record.reason in FAILURES else "ended"
    again, without = requestable_attempt(record) is not None, may_go_without(record)
    return {"state": over, "again": again, "without": without, "replaces": False}


def _replaces(record: Server) -> bool:
    """Whether the server replaces one that was lost."""
    return bool(record.earlier) and record.earlier[-1].reason is Reason.LOST
