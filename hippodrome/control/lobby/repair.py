"""The sweep's run in a lobby: it finishes interrupted runs, and keeps up the number of servers started ahead."""

from __future__ import annotations

from collections.abc import Collection
from datetime import timedelta

import msgspec

from hippodrome.control.lobby import rules, servers_ahead
from hippodrome.control.lobby.decisions import Decisions
from hippodrome.control.lobby.matcher import Matcher
from hippodrome.control.lobby.run import Lookups, StartedAhead
from hippodrome.control.lobby.store import LobbyStore
from hippodrome.control.log import logger
from hippodrome.control.model import ids
from hippodrome.control.model.messages import StopServer, to_message
from hippodrome.control.model.project import Project
from hippodrome.control.ports import Platform, Topic
from hippodrome.control.storage.repository import Repository

WRITTEN_WITHIN = timedelta(seconds=60)
"""No request takes longer to write a session (`next_step` ends after 29 seconds; sweeps are minutes apart)."""
NO_RECORD_AFTER = timedelta(minutes=3)
"""If a server that was requested ahead has no record after this time, its start message is sent again."""
CLOSED_FOR_GOOD = timedelta(minutes=3)
"""If the server of an open session has been closed for longer, it is not replaced any more."""


class Repair:
    """Repairs the lobbies of all projects."""

    def __init__(
        self, platform: Platform, repository: Repository, store: LobbyStore, matcher: Matcher, lookups: Lookups
    ) -> None:
        self._platform = platform
        self._repository = repository
        self._store = store
        self._matcher = matcher
        self._lookups = lookups

    def run(self, project: Project) -> Collection[str]:
        """Repair the lobby of this project; see `Lobby.repair`."""
        decisions, entries = self._store.read(project), self._store.entries(project)
        self._store.delete(entries.outdated)
        if project.asks_match:
            self._matcher.forget(project)
        # The decisions were lost. The requests that had read them have ended, so they write no session any more.
        may_finish = decisions.renewed is not None and self._platform.now() - decisions.renewed >= WRITTEN_WITHIN
        if may_finish:
            self._store.finish_sessions(project)
        self._store.carry_out(project, rules.without_done(decisions, entries.done).for_good(), entries)
        ahead = [*decisions.open, *(session.waits_for for session in decisions.formed if session.waits_for)]
        servers = {session.id: self._repository.server_of(project.id, session.id) for session in ahead}
        entries = self._store.entries(project)  # again, for the marks of what was just carried out
        run = self._lookups.run(
            project, decisions, entries, rules.confirmed(decisions, entries), servers=StartedAhead(servers)
        )
        closed = {name: server.closed for name, server in servers.items() if server and server.closed}
        over = [name for name, since in closed.items() if run.now - since > CLOSED_FOR_GOOD]
        sessions_ahead = servers_ahead.sessions_wanted(decisions, entries, project)
        ended = servers_ahead.surplus(
            decisions, sessions_ahead, over, run.now, players=project.players, open_for=run.open_for
        )

        def settle(document: Decisions) -> Decisions:
            if may_finish and document.renewed == decisions.renewed:
                document = msgspec.structs.replace(document, renewed=None)
            document = servers_ahead.without_open(run.decided(document), ended)
            number_ahead = servers_ahead.sessions_wanted(document, entries, project)
            return servers_ahead.open_sessions(
                document,
                number_ahead,
                "",
                run.now,
                ids.new_session_id,
                players=project.players,
                open_for=run.open_for,
            )

        after = self._store.change(project, settle)
        self._store.forget_done(project, after, entries)
        for session_id in sorted(ended - after.session_ids()):
            self._platform.bus.publish(Topic.STOP, to_message(StopServer(project.id, session_id)))
        waits_for = (session.waits_for for session in after.formed if session.waits_for)
        for open_session in [*after.open, *waits_for]:
            is_new = open_session.by == "" and open_session.requested == run.now
            is_lost = (
                open_session.id in servers
                and servers[open_session.id] is None
                and run.now - open_session.requested > NO_RECORD_AFTER
            )
            if is_new or is_lost:
                self._store.start_server(project, open_session.id, open_session.players)
        formed = tuple(session for session in after.for_good().formed if session not in decisions.formed)
        self._store.carry_out(project, Decisions(formed=formed), entries)
        if ended:
            logger.info(
                "servers that were started ahead and are not needed were stopped",
                extra={"project": project.id, "stopped": len(ended)},
            )
        return after.session_ids()
