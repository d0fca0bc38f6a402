"""Keeps a project's pool of warm servers: fills it, takes from it, and takes it down when the study closes.

The pool only offers warm servers. Each one's own record decides who gets it (`handover.py`), so a pool that a
crash has left behind the truth costs a warm server at worst; `mend`, which the sweep calls, brings it up to date.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from datetime import timedelta

from hippodrome.limits import rules as limits
from hippodrome.limits.rules import Running
from hippodrome.log import failure, logger
from hippodrome.model import ids, warm_pool
from hippodrome.model.messages import KeepWarm, StartServer, StopServer, to_message
from hippodrome.model.project import Project
from hippodrome.model.server import Reason, State
from hippodrome.model.warm_pool import Pool, WarmServer
from hippodrome.ports import Platform, Topic
from hippodrome.servers.batches import each
from hippodrome.storage.compare_and_swap import Changed, SharedDocuments
from hippodrome.storage.project_cache import ProjectCache
from hippodrome.storage.repository import Repository

UNHEARD = timedelta(minutes=5)  # a warm server that was asked for so long ago and has no record is asked for again
STUCK = timedelta(minutes=20)  # and one that is still not ready is told to go
ATTEMPT = 1  # the only one of a warm server


class Pools:
    """The pools of all projects. One per running function."""

    def __init__(self, platform: Platform, project_cache: ProjectCache) -> None:
        self._platform = platform
        self._project_cache = project_cache
        self._shared = SharedDocuments(platform.documents)

    def take(self, project: Project) -> tuple[str, WarmServer] | None:
        """Take one out of the pool; None if none is ready. Two calls, or one if there is none."""
        pool = self._change(project.id, lambda pool: pool.without_first(project.version)).before
        first = pool.first(project.version)
        return (first, pool.warm_servers[first]) if first else None

    def put_back(self, project: Project, warm_id: str, warm_server: WarmServer) -> None:
        """One that was taken and is not needed. Two calls."""
        self._change(project.id, lambda pool: pool.back(warm_id, warm_server))

    def ready(self, project_id: str, warm_id: str) -> None:
        """This warm server may be given out now. Two calls."""
        self._change(project_id, lambda pool: pool.made_ready([warm_id]))

    def gone(self, project_id: str, warm_id: str) -> None:
        """This warm server is no more. Two calls, or one if the pool does not know it."""
        self._change(project_id, lambda pool: pool.without([warm_id]))

    def ask(self, project_id: str) -> None:
        """Have the pool looked after, by whoever gets the message."""
        self._platform.bus.publish(Topic.START, to_message(KeepWarm(project_id)))

    def keep(self, project_id: str) -> None:
        """Bring the pool to the number it should have: ask for new warm servers, let others go.

        The pool is written first. If what follows is cut off, `mend` asks again for what has no record, and the sweep
        ends what is in no pool.
        """
        settings, now = self._platform.settings, self._platform.now()
        project = self._project_cache.project(project_id, fresh=timedelta(0))
        room = self._room(project) if project else None

        def settle(pool: Pool) -> Pool:
            return pool.settled(project, warm_pool.wanted(project, settings, len(pool.fit(project)), room), now)

        before, after = self._change(project_id, settle)
        new, going = (
            after.warm_servers.keys() - before.warm_servers.keys(),
            before.warm_servers.keys() - after.warm_servers.keys(),
        )
        self._start(project_id, sorted(new))
        self._let_go(project_id, sorted(going))
        if new or going:
            logger.info("warm servers", extra={"project": project_id, "asked": len(new), "told to go": len(going)})

    def mend(self, repository: Repository) -> Collection[str]:
        """Repair every pool there is or should be, where messages were lost; the ids of all warm servers in them.

        A listing, and for each pool a read, one for each warm server and a message. If a pool cannot be read, the
        others are repaired all the same, and then the error is raised.
        """
        should = self._should_have()
        known: set[str] = set()
        unread: list[Exception] = []
        for project_id in sorted(should | self._have()):
            try:
                pool = self._shared.read(warm_pool.pool_key(project_id), Pool)
            except (ValueError, RecursionError) as error:
                failure("a pool cannot be read", error, project=project_id)
                unread.append(error)
                self.ask(project_id)  # then it is made anew
                continue
            pool = pool.without([warm_id for warm_id in pool.warm_servers if not ids.is_warm_id(warm_id)])
            known.update(pool.warm_servers)
            if pool.warm_servers:
                self._mend(project_id, pool, repository)
            if pool.warm_servers or project_id in should:
                self.ask(project_id)
        if unread:  # the caller must not take the warm servers of these pools for nobody's
            raise unread[0]
        return known

    def handovers(self) -> Iterator[tuple[str, str]]:
        """Projects and names of warm servers with a handover document. A listing for each project with a pool."""
        for project_id in sorted(self._should_have() | self._have()):
            for entry in self._platform.documents.list(warm_pool.handovers(project_id)):
                name = entry.key.rpartition("/")[2].removesuffix(".json")
                if ids.parse_server_name(name) and entry.key == warm_pool.handover_key(project_id, name):
                    yield project_id, name

    def forget(self, project_id: str, name: str) -> None:
        """Take back what the warm server of this name was told."""
        self._platform.documents.delete(warm_pool.handover_key(project_id, name))

    def _should_have(self) -> set[str]:
        """Projects that should have a pool."""
        return {p.id for p in self._project_cache.projects(fresh=timedelta(0)) if p.live and p.warm_servers}

    def _have(self) -> set[str]:
        """Projects that have one, be it empty: of the registered ones, whatever else lies there."""
        registered = {warm_pool.pool_key(p.id): p.id for p in self._project_cache.projects(fresh=timedelta(0))}
        found = (entry.key for entry in self._platform.documents.list(warm_pool.POOLS))
        return {registered[key] for key in found if key in registered}

    def _mend(self, project_id: str, pool: Pool, repository: Repository) -> None:
        def state_of(warm_id: str) -> State:
            stored = repository.server(ids.server_label(project_id, warm_id))
            return stored.server.state if stored else State.QUEUED

        states, _ = each(self._platform, pool.warm_servers, state_of, "a warm server's record cannot be read")
        now = self._platform.now()

        def those(*present: State, after: timedelta = timedelta(0)) -> list[str]:
            return [
                warm_server
                for warm_server, state in states
                if state in present and now >= pool.warm_servers[warm_server].asked + after
            ]

        gone, ready = those(State.CLOSED), those(State.READY)
        self._change(project_id, lambda present: present.without(gone).made_ready(ready))
        self._start(project_id, those(State.QUEUED, after=UNHEARD))
        self._let_go(project_id, those(State.STARTING, State.NAMING, State.DRAINING, after=STUCK))

    def _change(self, project_id: str, change: Callable[[Pool], Pool]) -> Changed[Pool]:
        return self._shared.change(warm_pool.pool_key(project_id), Pool, change, renew=True)

    def _start(self, project_id: str, new: Collection[str]) -> None:
        for warm_id in new:
            self._platform.bus.publish(Topic.START, to_message(StartServer(project_id, warm_id, ATTEMPT)))

    def _let_go(self, project_id: str, going: Collection[str]) -> None:
        for warm_id in going:
            message = StopServer(project_id, warm_id, ATTEMPT, Reason.STOPPED)
            self._platform.bus.publish(Topic.STOP, to_message(message))

    def _room(self, project: Project) -> int | None:
        """For how many more warm servers there is a place; None, and not looked up, where there is no limit."""
        if not project.counts_servers:
            return None
        wait = max(warm_pool.SHORTEST_WAIT, warm_pool.waits(project, self._platform.settings))
        running = self._shared.read(limits.servers_key(project.id), Running)
        return running.room(project, math.ceil(wait.total_seconds()))
