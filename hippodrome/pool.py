"""Keeps a project's pool of spares: fills it, takes from it, and takes it down when the study closes.

The pool only says which spares may be had. Who gets one is settled by its own record (`giving.py`), so a pool that a
crash has left behind the truth costs a spare at worst; `mend`, which the sweep calls, brings it up to date.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from datetime import timedelta

from hippodrome import ids, limits, spares
from hippodrome.batches import each
from hippodrome.ledger import Ledger, Stored
from hippodrome.library import Library
from hippodrome.limits import Running
from hippodrome.log import logger
from hippodrome.messages import KeepWarm, StartServer, StopServer, to_message
from hippodrome.platform import Platform, Topic
from hippodrome.project import Project
from hippodrome.server import Reason, State
from hippodrome.spares import Pool, Spare
from hippodrome.swaps import Swaps

UNHEARD = timedelta(minutes=5)  # a spare that was asked for so long ago and has no record is asked for again
ATTEMPT = 1  # the only one of a spare


class Pools:
    """The pools of all projects. One per running function."""

    def __init__(self, platform: Platform, library: Library) -> None:
        self._platform = platform
        self._library = library
        self._swaps = Swaps(platform.documents)

    def take(self, project: Project) -> tuple[str, Spare] | None:
        """A spare that nobody else will find in the pool; None if none is ready. Two calls, or one if there is none."""
        taken: tuple[str, Spare] | None = None

        def take(pool: Pool) -> Pool:
            nonlocal taken
            id = pool.first(project.version)
            taken = (id, pool.spares[id]) if id else None
            return pool.without([id]) if id else pool

        self._swaps.change(spares.pool_key(project.id), Pool, take)
        return taken

    def put_back(self, project: Project, id: str, spare: Spare) -> None:
        """One that was taken and is not needed. Two calls."""
        self._swaps.change(spares.pool_key(project.id), Pool, lambda pool: pool.back(id, spare))

    def ready(self, project_id: str, id: str) -> None:
        """This spare may be given out now. Two calls."""
        self._swaps.change(spares.pool_key(project_id), Pool, lambda pool: pool.made_ready([id]))

    def gone(self, project_id: str, id: str) -> None:
        """This spare is no more. Two calls, or one if the pool knows it."""
        self._swaps.change(spares.pool_key(project_id), Pool, lambda pool: pool.without([id]))

    def ask(self, project_id: str) -> None:
        """Have the pool looked after, by whoever gets the message."""
        self._platform.bus.publish(Topic.START, to_message(KeepWarm(project_id)))

    def keep(self, project_id: str) -> None:
        """Bring the pool to the number it should have: ask for new spares, let others go.

        The pool is written first. If what follows is cut off, `mend` asks again for what has no record, and the sweep
        ends what is in no pool.
        """
        project = self._library.project(project_id, fresh=timedelta(0))
        version = project.version if project else ""
        held = self._held(project) if project else 0
        going: list[str] = []
        new: set[str] = set()

        def settle(pool: Pool) -> Pool:
            nonlocal going, new
            number = spares.wanted(project, len(pool.spares), held)
            going = pool.surplus(version, number)
            kept = pool.without(going)
            filled = kept.asked(project, number - len(kept.spares), self._platform.now()) if project else kept
            new = filled.spares.keys() - kept.spares.keys()
            return filled

        self._swaps.change(spares.pool_key(project_id), Pool, settle)
        self._start(project_id, sorted(new))
        for id in going:
            message = StopServer(project_id, id, ATTEMPT, Reason.STOPPED)
            self._platform.bus.publish(Topic.STOP, to_message(message))
        if new or going:
            logger.info("warm servers", extra={"project": project_id, "asked": len(new), "told to go": len(going)})

    def mend(self, ledger: Ledger) -> Collection[str]:
        """Look after every pool there is or should be, as far as messages were lost; the ids of all spares in them.

        A listing, and for each pool a read, one for each spare and a message.
        """
        should = self._should_have()
        known: set[str] = set()
        for project_id in sorted(should | self._have()):
            pool = self._swaps.read(spares.pool_key(project_id), Pool)
            known.update(pool.spares)
            if pool.spares:
                self._mend(project_id, pool, ledger)
            if pool.spares or project_id in should:
                self.ask(project_id)
        return known

    def handovers(self) -> Iterator[tuple[str, str]]:
        """Projects and names of the spares that were told whose they are. A listing for each project with a pool."""
        for project_id in sorted(self._should_have() | self._have()):
            for entry in self._platform.documents.list(spares.handovers(project_id)):
                yield project_id, entry.key.rpartition("/")[2].removesuffix(".json")

    def forget(self, project_id: str, name: str) -> None:
        """Take back what the spare of this name was told."""
        self._platform.documents.delete(spares.handover_key(project_id, name))

    def _should_have(self) -> set[str]:
        """Projects that should have a pool."""
        return {p.id for p in self._library.projects(fresh=timedelta(0)) if p.live and p.warm_servers}

    def _have(self) -> set[str]:
        """Projects that have one, be it empty."""
        found = (entry.key for entry in self._platform.documents.list(spares.POOLS))
        return {key.removeprefix(spares.POOLS).removesuffix(".json") for key in found}

    def _mend(self, project_id: str, pool: Pool, ledger: Ledger) -> None:
        found, _ = each(
            self._platform,
            pool.spares,
            lambda id: (ledger.server(ids.server_label(project_id, id)),),
            "a spare's record cannot be read",
        )
        records: dict[str, Stored | None] = {id: stored for id, (stored,) in found}
        gone = [id for id, stored in records.items() if stored and stored.server.is_closed]
        ready = [id for id, stored in records.items() if stored and stored.server.state is State.READY]
        self._swaps.change(spares.pool_key(project_id), Pool, lambda present: present.without(gone).made_ready(ready))
        now = self._platform.now()
        unheard = [id for id, stored in records.items() if not stored and now > pool.spares[id].asked + UNHEARD]
        self._start(project_id, unheard)

    def _start(self, project_id: str, new: Collection[str]) -> None:
        for id in new:
            self._platform.bus.publish(Topic.START, to_message(StartServer(project_id, id, ATTEMPT)))

    def _held(self, project: Project) -> int:
        """How many servers hold a place; not looked up where there is no limit."""
        if project.max_servers is None:
            return 0
        return len(self._swaps.read(limits.servers_key(project.id), Running).held)
