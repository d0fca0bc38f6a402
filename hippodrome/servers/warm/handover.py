"""Hands a warm server (`warmServers`) over to a participant: seconds instead of a minute.

The participant's record names the warm server first (`reserve`). One compare-and-swap on the warm server's own record
then decides (`assign`): nobody else gets it, and it can no longer be drained. The next delivery of the start message
repeats a handover that was interrupted: it finds the name in the record.
"""

from __future__ import annotations

import contextlib

from hippodrome.limits.slots import Release, Slots
from hippodrome.log import logger
from hippodrome.model import ids, server, warm_pool
from hippodrome.model.messages import StopServer, to_message
from hippodrome.model.project import Project
from hippodrome.model.records import to_json
from hippodrome.model.server import Reason, Server, State
from hippodrome.model.warm_pool import Handover
from hippodrome.ports import Conflict, Platform
from hippodrome.servers.warm.pools import Pools
from hippodrome.storage.repository import Repository, RetryLater, Versioned


class Handovers:
    """Reserves and assigns warm servers."""

    def __init__(self, platform: Platform, repository: Repository, slots: Slots, pools: Pools) -> None:
        self._platform = platform
        self._repository = repository
        self._slots = slots
        self._pools = pools

    def reserve(self, project: Project, stored: Versioned) -> Versioned | None:
        """The participant's record, which names a warm server now; None if none is ready. Four calls, one if none is.

        Raises `RetryLater` if the record was changed meanwhile: by another delivery of the message, or a stop.
        """
        if stored.server.warm_server:
            return stored
        if (taken := self._pools.take(project)) is None:
            return None
        warm_id, entry = taken
        found = self._repository.server(ids.server_label(project.id, warm_id))
        if found is None or found.server.state is not State.READY:
            return None  # it has gone, and its pool hears of it by and by
        warm_server, attempt = found.server, stored.server.attempt
        named = self._repository.update(
            stored,
            lambda r: server.reserving(r, warm_server) if r.is_open(attempt) and _may_name(r, warm_server) else None,
        )
        if named is None:
            self._pools.put_back(project, warm_id, entry)
            raise RetryLater("another delivery was faster")
        return named

    def assign(self, project: Project, named: Versioned) -> bool:
        """Hand over the warm server that the record names; False if it ended or went to another. About eight calls."""
        record = named.server
        warm_server = self._claim(record)
        if warm_server is None:
            return False
        stop = StopServer(record.project_id, record.user_id, record.attempt, Reason.DEADLINE)
        self._platform.timers.set(record.name, record.deadline, to_message(stop))
        self._tell_trial(project, record)
        now = self._platform.now()
        given = self._repository.update(
            named,
            lambda r: (
                server.given(r, warm_server, now) if r.name == record.name and r.state is State.STARTING else None
            ),
        )
        if given is None:
            self._undo(record)
        self._pools.ask(project.id)
        logger.info("a warm server was given away", extra={"server": record.name})
        return True

    def end(self, record: Server) -> None:
        """Remove what only a record with a warm server has, before it is closed."""
        if record.warm_server:
            self._pools.forget(record.project_id, record.warm_server)
            if record.state is State.STARTING:  # stopped in the midst of the handing over
                self._claim(record)

    def _claim(self, record: Server) -> Server | None:
        """Make the warm server's resources this record's, which holds a slot of its own; None if it ended first."""
        now, label = self._platform.now(), record.label
        found = self._repository.server(record.warm_server_label)
        taken = self._repository.update(
            found, lambda s: server.taken(s, label, now) if s.state is State.READY else None
        )
        present = taken or self._repository.server(record.warm_server_label)
        if present is None or present.server.taken_by != label:
            return None
        if present.server.counted:
            self._slots.give_back(record.project_id, [Release(present.server, Reason.TAKEN)])
        return present.server

    def _tell_trial(self, project: Project, record: Server) -> None:
        own = ids.server_name(record.label, record.attempt)
        handover = Handover(record.user_id, project.group(record.user_id), own)
        with contextlib.suppress(Conflict):  # told before
            self._platform.documents.create(warm_pool.handover_key(project.id, record.name), to_json(handover))

    def _undo(self, record: Server) -> None:
        """The server was stopped while it was given: what its end did not see goes as well."""
        present = self._repository.server(record.label)
        if present is None or present.server.name != record.name or present.server.is_closed:
            self._pools.forget(record.project_id, record.name)
            self._platform.timers.cancel(record.name)


def _may_name(record: Server, warm_server: Server) -> bool:
    """Whether it names no warm server yet; or this one, and only the reply to that was lost."""
    return record.state is State.STARTING and record.warm_server in (None, warm_server.name)
