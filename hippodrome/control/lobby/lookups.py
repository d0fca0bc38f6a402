"""The reads of a run of the lobby (`lobby.py`) before it decides: who can be a member, and which servers are ready."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from datetime import timedelta
from functools import partial

from hippodrome.control.lobby import entries as lobby_entries
from hippodrome.control.lobby import rules
from hippodrome.control.lobby.decisions import Decisions, Matched, Proposal
from hippodrome.control.lobby.entries import Entries, Waiting
from hippodrome.control.lobby.run import LobbyRun, StartedAhead
from hippodrome.control.log import failure
from hippodrome.control.model import ids, sessions
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Server
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
