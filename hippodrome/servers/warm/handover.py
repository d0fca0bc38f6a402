"""Gives a participant one of the servers that wait (`warmServers`): seconds instead of a minute.

The participant's record names the spare before the spare's own record is asked, and one compare-and-swap on the latter
decides: nobody else gets it, and it cannot be told to go any more. Whatever is cut off is gone through again with the
next delivery of the start message, which finds the name in the record.
"""

from __future__ import annotations

import contextlib

from hippodrome.limits.slots import Leaving, Places
from hippodrome.log import logger
from hippodrome.model import ids, server, warm_pool
from hippodrome.model.messages import StopServer, to_message
from hippodrome.model.project import Project
from hippodrome.model.records import to_json
from hippodrome.model.server import Reason, Server, State
from hippodrome.model.warm_pool import Handover
from hippodrome.ports import Conflict, Platform
from hippodrome.servers.warm.pools import Pools
from hippodrome.storage.repository import Later, Ledger, Stored


class Giving:
    """Gives spares to participants."""

    def __init__(self, platform: Platform, ledger: Ledger, places: Places, pools: Pools) -> None:
        self._platform = platform
        self._ledger = ledger
        self._places = places
        self._pools = pools

    def choose(self, project: Project, stored: Stored) -> Stored | None:
        """The participant's record with the name of a spare in it; None if none is ready: one call then, else four.

        Raises `Later` if the record was changed meanwhile: by another delivery of the message, or a stop.
        """
        if stored.server.spare:
            return stored
        if (taken := self._pools.take(project)) is None:
            return None
        spare_id, entry = taken
        found = self._ledger.server(ids.server_label(project.id, spare_id))
        if found is None or found.server.state is not State.READY:
            return None  # it has gone, and its pool hears of it by and by
        spare, attempt = found.server, stored.server.attempt
        named = self._ledger.update(
            stored, lambda r: server.wanting(r, spare) if r.is_open(attempt) and _may_name(r, spare) else None
        )
        if named is None:
            self._pools.put_back(project, spare_id, entry)
            raise Later("another delivery was faster")
        return named

    def give(self, project: Project, named: Stored) -> bool:
        """Hand over the spare that the record names; False if it was not to be had any more. About eight calls."""
        record = named.server
        spare = self._claim(record)
        if spare is None:
            return False
        stop = StopServer(record.project_id, record.user_id, record.attempt, Reason.DEADLINE)
        self._platform.timers.set(record.name, record.deadline, to_message(stop))
        self._tell_trial(project, record)
        now = self._platform.now()
        given = self._ledger.update(
            named,
            lambda r: server.given(r, spare, now) if r.name == record.name and r.state is State.STARTING else None,
        )
        if given is None:
            self._undo(record)
        self._pools.ask(project.id)
        logger.info("a server that waited was given away", extra={"server": record.name})
        return True

    def end(self, record: Server) -> None:
        """Before a record is closed that names a spare: what it has of it besides what all servers have."""
        if record.spare:
            self._pools.forget(record.project_id, record.spare)
            if record.state is State.STARTING:  # stopped in the midst of the handing over
                self._claim(record)

    def _claim(self, record: Server) -> Server | None:
        """Make the spare's things this record's, which has a place of its own; the spare, or None if it went first."""
        now, label = self._platform.now(), record.label
        found = self._ledger.server(record.spare_label)
        taken = self._ledger.update(found, lambda s: server.taken(s, label, now) if s.state is State.READY else None)
        present = taken or self._ledger.server(record.spare_label)
        if present is None or present.server.taken_by != label:
            return None
        if present.server.counted:
            self._places.give_back(record.project_id, [Leaving(present.server, Reason.TAKEN)])
        return present.server

    def _tell_trial(self, project: Project, record: Server) -> None:
        own = ids.server_name(record.label, record.attempt)
        handover = Handover(record.user_id, project.group(record.user_id), own)
        with contextlib.suppress(Conflict):  # told before
            self._platform.documents.create(warm_pool.handover_key(project.id, record.name), to_json(handover))

    def _undo(self, record: Server) -> None:
        """The server was stopped while it was given: what its end did not see goes as well."""
        present = self._ledger.server(record.label)
        if present is None or present.server.name != record.name or present.server.is_closed:
            self._pools.forget(record.project_id, record.name)
            self._platform.timers.cancel(record.name)


def _may_name(record: Server, spare: Server) -> bool:
    """Whether it names no spare yet; or this one, and only the reply to that was lost."""
    return record.state is State.STARTING and record.spare in (None, spare.name)
