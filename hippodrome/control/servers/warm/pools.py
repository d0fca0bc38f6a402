"""Fills the pool of a project's warm servers, takes servers from it, and empties it when the project closes.

The pool only offers warm servers. A warm server's own record decides which participant gets it (`handover.py`), so a
pool that is out of date after a crash costs one warm server at worst. The sweep calls `repair`, which corrects it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from datetime import timedelta

from hippodrome.control.limits import rules as limits
from hippodrome.control.limits.rules import ServerSlots
from hippodrome.control.log import failure, logger
from hippodrome.control.model import ids, warm_pool
from hippodrome.control.model.messages import KeepWarm, StartServer, StopServer, to_message
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Reason, ServerState
from hippodrome.control.model.warm_pool import Pool, WarmServer
from hippodrome.control.ports import Platform, Topic
from hippodrome.control.servers.batches import for_each
from hippodrome.control.storage.compare_and_swap import Changed, SharedDocuments
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.repository import Repository
from hippodrome.protocol.keys import handover_key, handovers_folder

NO_RECORD_AFTER = timedelta(minutes=5)  # if a requested warm server has no record by then, request it again
NOT_READY_AFTER = timedelta(minutes=20)  # if a warm server is not ready by then, stop it
ATTEMPT = 1  # the only attempt of a warm server


class Pools:
    """The pools of all projects. Each running function has one `Pools`."""

    def __init__(self, platform: Platform, project_cache: ProjectCache) -> None:
        self._platform = platform
        self._project_cache = project_cache
        self._shared = SharedDocuments(platform.documents)

    def take(self, project: Project) -> tuple[str, WarmServer] | None:
        """Take a ready warm server out of the pool, and return its id and its entry; None if none is ready.

        AWS calls: two; one if none is ready.
        """
        pool = self._change(project.id, lambda pool: pool.without_first(project.version)).before
        first = pool.first(project.version)
        return (first, pool.warm_servers[first]) if first else None

    def put_back(self, project: Project, warm_id: str, warm_server: WarmServer) -> None:
        """Put back a warm server that was taken and is not needed. AWS calls: two."""
        self._change(project.id, lambda pool: pool.with_returned(warm_id, warm_server))

    def mark_ready(self, project_id: str, warm_id: str) -> None:
        """Mark this warm server ready, so that participants may take it. AWS calls: two."""
        self._change(project_id, lambda pool: pool.with_ready([warm_id]))

    def remove(self, project_id: str, warm_id: str) -> None:
        """Remove this warm server from the pool. AWS calls: two; one if the pool does not list it."""
        self._change(project_id, lambda pool: pool.without([warm_id]))

    def request_adjustment(self, project_id: str) -> None:
        """Ask `start_server` by a message to adjust the pool (`adjust`)."""
        self._platform.bus.publish(Topic.START, to_message(KeepWarm(project_id)))

    def adjust(self, project_id: str) -> None:
        """Bring the pool to its configured size: request new warm servers, or stop some.

        The pool is written first. If the rest is interrupted, `repair` requests the warm servers without a record
        again, and the sweep stops the warm servers that are in no pool.
        """
        settings, now = self._platform.settings, self._platform.now()
        project = self._project_cache.project(project_id, fresh=timedelta(0))
        room = self._slots_left(project) if project else None

        def settle(pool: Pool) -> Pool:
            return pool.resized(
                project, warm_pool.target_size(project, settings, len(pool.of_registration(project)), room), now
            )

        before, after = self._change(project_id, settle)
        added = after.warm_servers.keys() - before.warm_servers.keys()
        removed = before.warm_servers.keys() - after.warm_servers.keys()
        self._start_servers(project_id, sorted(added))
        self._stop_servers(project_id, sorted(removed))
        if added or removed:
            logger.info("warm servers", extra={"project": project_id, "added": len(added), "removed": len(removed)})

    def repair(self, repository: Repository) -> Collection[str]:
        """Repair all pools after lost messages; return the ids of all warm servers in them.

        AWS calls: a read of the master list and a listing; for each project with a pool or `warmServers` at most two
        reads, a write and a message; for each warm server a read, and a message if it is started again or stopped. A
        write that meets another one is repeated. If a pool cannot be read, the others are repaired before the error is
        raised.
        """
        configured, with_pool = self._projects()
        pool_ids: set[str] = set()
        unread: list[Exception] = []
        for project_id in sorted(configured | with_pool):
            try:
                pool = self._shared.read(warm_pool.pool_key(project_id), Pool)
            except ValueError as error:
                failure("a pool cannot be read", error, project=project_id)
                unread.append(error)
                self.request_adjustment(project_id)  # the adjustment replaces the document
                continue
            pool = pool.without([warm_id for warm_id in pool.warm_servers if not ids.is_warm_id(warm_id)])
            pool_ids.update(pool.warm_servers)
            if pool.warm_servers:
                self._repair(project_id, pool, repository)
            if pool.warm_servers or project_id in configured:
                self.request_adjustment(project_id)
        if unread:  # without the error, the caller would stop the warm servers of these pools
            raise unread[0]
        return pool_ids

    def handovers(self) -> Iterator[tuple[str, str]]:
        """Yield the project's id and the server's name of each handover document.

        AWS calls: a read of the master list and a listing; a listing for each project with a pool or `warmServers`.
        """
        configured, with_pool = self._projects()
        for project_id in sorted(configured | with_pool):
            for entry in self._platform.documents.list(handovers_folder(project_id)):
                name = entry.key.rpartition("/")[2].removesuffix(".json")
                if ids.parse_server_name(name) and entry.key == handover_key(project_id, name):
                    yield project_id, name

    def delete_handover(self, project_id: str, name: str) -> None:
        """Delete the handover document of the warm server of this name."""
        self._platform.documents.delete(handover_key(project_id, name))

    def _projects(self) -> tuple[set[str], set[str]]:
        """The ids of live projects with `warmServers`, and of projects that have a pool document, even an empty one."""
        projects = self._project_cache.projects(fresh=timedelta(0))
        configured = {project.id for project in projects if project.live and project.warm_servers}
        registered = {warm_pool.pool_key(project.id): project.id for project in projects}
        keys = (entry.key for entry in self._platform.documents.list(warm_pool.POOLS))
        return configured, {registered[key] for key in keys if key in registered}

    def _repair(self, project_id: str, pool: Pool, repository: Repository) -> None:
        def state_of(warm_id: str) -> ServerState:
            stored = repository.stored_server(project_id, warm_id)
            return stored.server.state if stored else ServerState.QUEUED

        states, _ = for_each(self._platform, pool.warm_servers, state_of, "a warm server's record cannot be read")
        now = self._platform.now()

        def in_state(*present: ServerState, after: timedelta = timedelta(0)) -> list[str]:
            return [
                warm_id
                for warm_id, state in states
                if state in present and now >= pool.warm_servers[warm_id].requested + after
            ]

        closed, ready = in_state(ServerState.CLOSED), in_state(ServerState.READY)
        self._change(project_id, lambda present: present.without(closed).with_ready(ready))
        self._start_servers(project_id, in_state(ServerState.QUEUED, after=NO_RECORD_AFTER))
        self._stop_servers(
            project_id, in_state(ServerState.STARTING, ServerState.NAMING, ServerState.DRAINING, after=NOT_READY_AFTER)
        )

    def _change(self, project_id: str, change: Callable[[Pool], Pool]) -> Changed[Pool]:
        return self._shared.change(warm_pool.pool_key(project_id), Pool, change, anew=Pool())

    def _start_servers(self, project_id: str, warm_ids: Collection[str]) -> None:
        for warm_id in warm_ids:
            self._platform.bus.publish(Topic.START, to_message(StartServer(project_id, warm_id, ATTEMPT)))

    def _stop_servers(self, project_id: str, warm_ids: Collection[str]) -> None:
        for warm_id in warm_ids:
            message = StopServer(project_id, warm_id, ATTEMPT, Reason.STOPPED)
            self._platform.bus.publish(Topic.STOP, to_message(message))

    def _slots_left(self, project: Project) -> int | None:
        """How many more warm servers may start; None, without a call, if the project has no limits on servers."""
        if not project.limits_servers:
            return None
        wait = max(warm_pool.MIN_LONGEST_WAIT, warm_pool.longest_wait(project, self._platform.settings))
        running = self._shared.read(limits.server_slots_key(project.id), ServerSlots)
        return running.free_slots(project, math.ceil(wait.total_seconds()))
