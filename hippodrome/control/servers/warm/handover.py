"""Hands a warm server (`warmServers`) over to a participant or a session, in seconds instead of a minute.

`reserve` first writes the warm server's name into the participant's record. `assign` then decides by one
compare-and-swap on the warm server's own record: after it no other participant gets the server, and it cannot be
drained. If a handover is interrupted, the next delivery of the start message finds the name and repeats the handover.
"""

from __future__ import annotations

import contextlib

from hippodrome.control.limits.slots import Release, Slots
from hippodrome.control.log import logger
from hippodrome.control.model import ids, server
from hippodrome.control.model.messages import StopServer, to_message
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.ports import Conflict, Platform, RetryLater
from hippodrome.control.servers.warm.pools import Pools
from hippodrome.control.storage.repository import Repository, Versioned
from hippodrome.protocol.handover import Handover
from hippodrome.protocol.keys import handover_key


class Handovers:
    """Reserves and assigns warm servers."""

    def __init__(self, platform: Platform, repository: Repository, slots: Slots, pools: Pools) -> None:
        self._platform = platform
        self._repository = repository
        self._slots = slots
        self._pools = pools

    def reserve(self, project: Project, stored: Versioned) -> Versioned | None:
        """Write a ready warm server's name into the participant's record, and return that record.

        The result is None if no warm server is ready. AWS calls: four; one if none is ready. Raises `RetryLater` if the
        record was changed at the same time, by another delivery of the message or by a stop.
        """
        if stored.server.warm_server_name:
            return stored
        if (found_in_pool := self._pools.take(project)) is None:
            return None
        warm_id, entry = found_in_pool
        found = self._repository.stored_server(project.id, warm_id)
        if found is None or found.server.state is not ServerState.READY:
            return None  # the warm server has ended; the sweep removes it from its pool
        warm_server, attempt = found.server, stored.server.attempt
        reserved_record = self._repository.update(
            stored,
            lambda r: server.reserving(r, warm_server) if r.is_open(attempt) and _may_reserve(r, warm_server) else None,
        )
        if reserved_record is None:
            self._pools.put_back(project, warm_id, entry)
            raise RetryLater("another delivery was faster")
        return reserved_record

    def assign(self, project: Project, versioned: Versioned) -> bool:
        """Hand over the reserved warm server. AWS calls: about eight.

        Returns False if the warm server has ended or is another participant's.
        """
        record = versioned.server
        warm_server = self._take_over(record)
        if warm_server is None:
            return False
        stop = StopServer(record.project_id, record.user_id, record.attempt, Reason.DEADLINE)
        self._platform.timers.set(record.name, record.deadline, to_message(stop))
        self._write_handover(project, record)
        now = self._platform.now()
        assigned = self._repository.update(
            versioned,
            lambda r: (
                server.assigned(r, warm_server, now)
                if r.name == record.name and r.state is ServerState.STARTING
                else None
            ),
        )
        if assigned is None:
            self._undo_if_stopped(record)
        self._pools.request_adjustment(project.id)
        logger.info("a warm server was assigned", extra={"server": record.name})
        return True

    def release(self, record: Server) -> None:
        """Delete the handover document of the record's warm server, if there is one, before the record is closed."""
        if record.warm_server_name:
            self._pools.delete_handover(record.project_id, record.warm_server_name)
            if record.state is ServerState.STARTING:  # the handover was interrupted by a stop
                self._take_over(record)

    def _take_over(self, record: Server) -> Server | None:
        """Give the warm server's resources to this record, and free the warm server's slot; return its closed record.

        None if the warm server has ended, or another participant has it. This record holds a slot of its own.
        """
        now, label = self._platform.now(), record.label
        warm_record = self._repository.server(record.warm_server_label)
        handed = self._repository.update(
            warm_record, lambda s: server.handed_over(s, label, now) if s.state is ServerState.READY else None
        )
        present = handed or self._repository.server(record.warm_server_label)
        if present is None or present.server.assigned_to != label:
            return None
        if present.server.counted:
            self._slots.release(record.project_id, [Release(present.server, Reason.ASSIGNED)])
        return present.server

    def _write_handover(self, project: Project, record: Server) -> None:
        own = ids.server_name(record.label, record.attempt)
        # For a session the handover names no group: it is in the session's document.
        group = None if record.is_of_session else project.group(record.user_id)
        handover = Handover(record.user_id, group, own)
        with contextlib.suppress(Conflict):  # an earlier delivery of the message has written it
            self._platform.documents.create(handover_key(project.id, record.name), handover.to_json())

    def _undo_if_stopped(self, record: Server) -> None:
        """If the server was stopped during the handover, delete the document and the timer that the stop has missed."""
        present = self._repository.server(record.label)
        if present is None or present.server.name != record.name or present.server.is_closed:
            self._pools.delete_handover(record.project_id, record.name)
            self._platform.timers.cancel(record.name)


def _may_reserve(record: Server, warm_server: Server) -> bool:
    """Whether the record names no warm server yet, or this one (the reply to that write was lost)."""
    return record.state is ServerState.STARTING and record.warm_server_name in (None, warm_server.name)
