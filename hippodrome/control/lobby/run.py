"""A run of the lobby (`lobby.py`): what it reads, and its decisions on any later version of the document."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial

from hippodrome.control.lobby import entries as lobby_entries
from hippodrome.control.lobby import rules, servers_ahead
from hippodrome.control.lobby.decisions import Decisions, Matched, Proposal
from hippodrome.control.lobby.entries import Entries, Waiting
from hippodrome.control.log import failure
from hippodrome.control.model import ids, sessions
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Server, ServerState, next_attempt
from hippodrome.control.ports import Platform
from hippodrome.control.storage.repository import Repository

FORMED_LATE = timedelta(seconds=4)
"""If a confirmed session was proposed longer ago than this, requests of other participants form it, too."""
FORMED_AT_ONCE = 10
"""The most sessions of other participants that one request forms."""
LOOKED_AT = 5
"""The most open sessions whose servers a request reads, if its own session is the first that waits for a server."""
LOOKED_AT_IN_NEED = 50
"""The most open sessions whose servers a request reads, if the server that its own session waits for has ended."""


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


class Lookups:
    """The reads of a run, besides the document of decisions and the listing of entries."""

    def __init__(self, platform: Platform, repository: Repository) -> None:
        self._platform = platform
        self._repository = repository

    def run(
        self,
        project: Project,
        decisions: Decisions,
        entries: Entries,
        proposals: Sequence[Proposal],
        *,
        servers: StartedAhead,
        chosen: Sequence[Sequence[str]] = (),
    ) -> LobbyRun:
        """Return a run that may form the sessions of these confirmed proposals. AWS calls: two reads per member.

        `servers` is the result of the method `servers`. `chosen` is as in `rules.decide`.
        """
        members, broken = self._members(project, proposals, entries)
        now, open_for = self._platform.now(), sessions.open_for(project, self._platform.settings)
        return LobbyRun(project, decisions, entries, members, broken, now, open_for, servers, chosen)

    def proposals_to_form(self, decisions: Decisions, entries: Entries, label: str) -> list[Proposal]:
        """Return the confirmed proposals that this participant's request forms.

        These are their own, and some that have waited for long: in a crowd more participants come than the document
        takes writes, so one write decides on several sessions.
        """
        now = self._platform.now()
        confirmed = rules.confirmed(decisions, entries)
        own = [proposal for proposal in confirmed if label in proposal.labels]
        late = [proposal for proposal in confirmed if label not in proposal.labels and now - proposal.at > FORMED_LATE]
        return [*own, *late[:FORMED_AT_ONCE]]

    # Servers that were started ahead

    def servers(
        self, project: Project, decisions: Decisions, label: str, proposals: Sequence[Proposal]
    ) -> StartedAhead:
        """Read the records of the servers that this participant's request may give to sessions.

        The result is empty unless the participant's session (formed, or one of `proposals`) waits for a server that was
        started ahead. Then it has the record of that server, and the records of open sessions' servers: of some
        (`LOOKED_AT`) if no other session has waited for longer, of more (`LOOKED_AT_IN_NEED`) if that server has ended.
        """
        formed = decisions.formed_of(label)
        own = (
            formed.waits_for
            if formed
            else next((proposal.ahead for proposal in proposals if label in proposal.labels), None)
        )
        if own is None:
            return StartedAhead({})
        waiting, now = decisions.without_server(), self._platform.now()
        is_first = not waiting or waiting[0] is formed
        open_for = sessions.open_for(project, self._platform.settings)
        usable = [server.id for server in decisions.open if server.is_usable(own.players, now, open_for)]
        some = usable[:LOOKED_AT] if is_first else []
        records = self._records(project, [own.id, *some])
        if own.id in records.over:
            others = self._records(project, usable[len(some) : LOOKED_AT_IN_NEED])
            return StartedAhead({**records.records, **others.records})
        return records

    def _records(self, project: Project, session_ids: Sequence[str]) -> StartedAhead:
        acts = [partial(self._server, project, session_id) for session_id in session_ids]
        return StartedAhead(dict(zip(session_ids, self._platform.run_all(acts), strict=True)))

    def _server(self, project: Project, session_id: str) -> Server | None:
        """The record of a session's server; None if there is none, or if it cannot be read this time."""
        try:
            return self._repository.server_of(project.id, session_id)
        except Exception as error:  # noqa: BLE001 - `run_all` takes functions that do not raise
            failure("the record of a server that was started ahead cannot be read", error, project=project.id)
            return None

    # Members

    def _members(
        self, project: Project, proposals: Sequence[Proposal], entries: Entries
    ) -> tuple[Mapping[str, Sequence[Matched]], Collection[str]]:
        """By the proposal's id, the members of each session that can be formed; and the ids of the other proposals.

        A session cannot be formed if a member has left, or has a membership already (a late request of a second tab may
        have brought them back into the lobby), or if the project has been registered with another number of players
        since it was proposed. A proposal with a member who cannot be read is in neither: the next run reads again.
        """
        waiting = [entries.waiting[label] for proposal in proposals for label in proposal.labels]
        looked = self._platform.run_all([partial(self._member, project, person) for person in waiting])
        by_label = {person.label: member for person, member in zip(waiting, looked, strict=True)}
        members, broken = {}, []
        for proposed in proposals:
            members_known = [by_label[label] for label in proposed.labels]
            if any(isinstance(one, Exception) for one in members_known):
                continue
            able = [one for one in members_known if isinstance(one, Matched)]
            if len(able) == len(members_known) and proposed.players == project.players:
                members[proposed.id] = able
            else:
                broken.append(proposed.id)
        return members, broken

    def _member(self, project: Project, waiting: Waiting) -> Matched | Exception | None:
        """The participant who waits, as a member; None if they have left or have a membership; the error of a read."""
        try:
            document = self._platform.documents.get(lobby_entries.waiting_key(project.id, waiting))
            written = lobby_entries.read_body(document.body) if document else None
            if written is None or ids.server_label(project.id, written.user_id) != waiting.label:
                return None
            membership = self._repository.membership(project.id, written.user_id)
        except Exception as error:  # noqa: BLE001 - `run_all` takes functions that do not raise
            failure("a participant who waits cannot be read", error, project=project.id)
            return error
        if membership:
            return None
        return Matched(
            waiting.label,
            written.user_id,
            written.group,
            lobby_entries.seconds_since(waiting.joined, self._platform.now()),
        )
