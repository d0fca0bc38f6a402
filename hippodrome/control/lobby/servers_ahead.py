"""Decides how many servers are started ahead of their sessions, and which session gets which server. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from datetime import datetime, timedelta

import msgspec

from hippodrome.control.lobby.decisions import Decisions, Formed, OpenSession, by_age
from hippodrome.control.lobby.entries import Entries
from hippodrome.control.model.project import Project

SERVER_WITHIN = timedelta(minutes=5)
"""If no server is ready for a session within this time, the session keeps the server that it waits for."""


def sessions_wanted(document: Decisions, entries: Entries, project: Project, also: Collection[str] = ()) -> int:
    """Return how many open sessions there should be: one for every `players` participants who are under way or wait.

    `also` are the labels of further participants who are under way. The result is at most `maxServers`, since no more
    servers can run; it is 0 in a project that is closed.
    """
    if not project.live:
        return 0
    people = {*entries.under_way, *entries.waiting, *also} - document.labels()
    needed = math.ceil(len(people) / project.players)
    return needed if project.max_servers is None else min(needed, project.max_servers)


def open_sessions(
    document: Decisions,
    wanted: int,
    by: str,
    now: datetime,
    new_id: Callable[[], str],
    *,
    players: int,
    open_for: timedelta,
) -> Decisions:
    """Return the document with new open sessions for `players`, as many as are needed to have `wanted` usable ones."""
    usable = sum(server.is_usable(players, now, open_for) for server in document.open)
    added = [OpenSession(new_id(), now, by, players) for _ in range(wanted - usable)]
    return msgspec.structs.replace(document, open=by_age([*document.open, *added])) if added else document


def with_ready_servers(
    document: Decisions,
    ready: Collection[str],
    over: Collection[str],
    now: datetime,
    *,
    coming: Collection[str] = (),
    open_for: timedelta,
) -> Decisions:
    """Give the servers that are ready to the sessions that were formed first, whichever server each has waited for.

    * `ready`: servers that are ready, by their sessions' ids. A session gets a ready server of an open session. If
      there is none, it exchanges servers with the session that was formed last among those whose server is ready.
    * `over`: servers that have ended and are not replaced. `coming`: servers that start. A session whose server is over
      waits for a server that starts, if an open session has one.
    * If there is no such server either, the session keeps its own, and its members are told why that server has ended.
      A session that has waited for `SERVER_WITHIN` keeps its own as well.
    * A session only gets a server that was started for the same number of players.
    """
    sessions = document.without_server()
    if not ready and not over and not (sessions and now - sessions[0].at >= SERVER_WITHIN):
        return document
    servers = [session.waits_for for session in sessions if session.waits_for]
    opened = list(document.open)
    usable = {server.id for server in opened if server.is_usable(server.players, now, open_for)}
    spare = len({*usable, *(server.id for server in servers)} & set(ready))  # ready servers that no session has got yet
    assigned: dict[tuple[str, ...], str] = {}  # by the labels of a session's members: the id of its server
    for at, session in enumerate(sessions):
        players = servers[at].players
        fits = [n for n, server in enumerate(opened) if server.id in usable and server.players == players]
        if spare and servers[at].id not in ready:
            fresh = (n for n in fits if opened[n].id in ready)
            later = (n for n in range(len(servers) - 1, at, -1) if servers[n].id in ready)
            later = (n for n in later if servers[n].players == players)
            if (n := next(fresh, None)) is not None:
                servers[at], opened[n] = opened[n], servers[at]
            elif servers[at].id not in over and (n := next(later, None)) is not None:
                servers[at], servers[n] = servers[n], servers[at]
        if servers[at].id in over and (n := next((n for n in fits if opened[n].id in coming), None)) is not None:
            servers[at], opened[n] = opened[n], servers[at]
        is_ready = servers[at].id in ready
        spare -= is_ready
        if is_ready or servers[at].id in over or now - session.at >= SERVER_WITHIN:
            assigned[session.labels] = servers[at].id
    if not assigned and servers == [session.waits_for for session in sessions]:
        return document
    having = {session.labels: server for session, server in zip(sessions, servers, strict=True)}

    def bound(formed: Formed) -> Formed:
        server = having.get(formed.labels) if formed.waits_for else None
        if server is None:
            return formed
        return msgspec.structs.replace(formed, id=server.id, waits_for=None if formed.labels in assigned else server)

    return msgspec.structs.replace(
        document, open=by_age(opened), formed=tuple(bound(session) for session in document.formed)
    )


def surplus(
    document: Decisions,
    wanted: int,
    over: Collection[str],
    now: datetime,
    *,
    players: int,
    open_for: timedelta,
) -> frozenset[str]:
    """Return the ids of the open sessions to remove.

    They are the sessions that can no longer be used, the sessions in `over`, and all but `wanted` of the others. Of the
    others, the sessions stay whose servers were requested first, since these will be ready first.
    """
    usable = [
        server.id for server in document.open if server.is_usable(players, now, open_for) and server.id not in over
    ]
    return frozenset(server.id for server in document.open) - frozenset(usable[: max(0, wanted)])


def without_open(document: Decisions, ids: Collection[str]) -> Decisions:
    """Return the document without these open sessions."""
    return msgspec.structs.replace(document, open=tuple(server for server in document.open if server.id not in ids))
