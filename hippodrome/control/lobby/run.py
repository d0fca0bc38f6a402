"""A run of the lobby (`lobby.py`): what it has read, and its decisions on any later version of the document. Pure."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from hippodrome.control.lobby import rules, servers_ahead
from hippodrome.control.lobby.decisions import Decisions, Matched
from hippodrome.control.lobby.entries import Entries
from hippodrome.control.model import ids
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Server, ServerState, next_attempt


@dataclass(frozen=True)
class StartedAhead:
    """The records of servers that were started ahead, by their sessions' ids; None for a server without a record."""

    records: Mapping[str, Server | None]

    @property
    def ready(self) -> frozenset[str]:
        """The ids of sessions whose servers are ready."""
        return frozenset(name for name, record in self.records.items() if record and record.state is ServerState.READY)

    @property
    def over(self) -> frozenset[str]:
        """The ids of sessions whose servers have ended and are not replaced."""
        closed = ((name, record) for name, record in self.records.items() if record and record.is_closed)
        return frozenset(name for name, record in closed if next_attempt(record) is None)

    @property
    def coming(self) -> frozenset[str]:
        """The ids of sessions whose servers start now or are replaced, and so may become ready."""
        return frozenset(name for name, record in self.records.items() if record) - self.ready - self.over

    def given(self, document: Decisions, now: datetime, open_for: timedelta) -> Decisions:
        """Return the document after these servers have been given to the sessions that wait for a server."""
        return servers_ahead.with_ready_servers(
            document, self.ready, self.over, now, coming=self.coming, open_for=open_for
        )


@dataclass(frozen=True)
class LobbyRun:
    """What a run has read. `decided` applies its decisions to a version of the document."""

    project: Project
    known: Decisions
    entries: Entries
    members: Mapping[str, Sequence[Matched]]  # by proposal: the members of each session that this run can form
    broken: Collection[str]  # the proposals of sessions that cannot be formed
    now: datetime
    open_for: timedelta
    servers: StartedAhead
    chosen: Sequence[Sequence[str]] = ()  # the sessions that the function `match` has chosen, by their members' labels

    def decided(self, document: Decisions) -> Decisions:
        """Return the document with all decisions that this run can make."""
        document = rules.without_done(document, self.entries.done)
        document = rules.without_proposals(document, self.broken)
        for proposal_id, member in self.members.items():
            document = rules.form(document, proposal_id, member, self.now, self.project.seats)
        document = rules.decide(
            document,
            self.entries,
            self.project,
            self.now,
            ids.new_session_id,
            open_for=self.open_for,
            known=self.known,
            chosen=self.chosen,
        )
        return self.servers.given(document, self.now, self.open_for)
