"""`sweep`: remove what no live record owns.

Resources are listed first and the records read afterwards: a record is always written before what it speaks for is
made, so whatever was listed and has no live record is a leftover, with no race and no guess at ages. What was closed
only since the sweep began was rightly there when it was listed, and is left to whoever closed it. A resource whose name
is not of our making, or whose record is not in our bucket (another installation's), is never touched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import timedelta
from functools import partial
from typing import Any, TypeVar

from hippodrome.limits.rules import Running
from hippodrome.limits.slots import Slots
from hippodrome.log import failure, logger
from hippodrome.model import ids, messages
from hippodrome.model.messages import DnsChanged, Named, StartServer, StopServer, TaskSeen, to_message
from hippodrome.model.server import RECORDS, Reason, Server, State
from hippodrome.model.server import key as server_key
from hippodrome.ports import Platform, RunningTask, Topic
from hippodrome.servers.batches import each
from hippodrome.servers.overdue import ASK_AGAIN, OVERTIME, UNSEEN, Remedy, remedy
from hippodrome.servers.service import Servers
from hippodrome.servers.warm.pools import Pools
from hippodrome.storage.project_cache import ProjectCache
from hippodrome.storage.repository import Repository, Versioned

PASS = timedelta(minutes=15)  # how long a record is looked at by the sweeps, each time that it may need it

T = TypeVar("T")


@dataclass
class Swept:
    """What one sweep did."""

    tasks: int = 0
    names: int = 0
    timers: int = 0
    clusters: int = 0
    slots: int = 0
    warm_servers: int = 0
    handovers: int = 0
    overdue: int = 0
    lost: int = 0
    asked: int = 0  # servers for which something was asked once more
    failed: int = 0


@dataclass(frozen=True)
class Census:
    """The servers that ran when a sweep began, those of this installation only."""

    servers: int = 0
    oldest: timedelta = timedelta()  # since it was asked for


class Sweep:
    """One sweep over everything that may be ours. `census` is there once it has run."""

    def __init__(self, platform: Platform) -> None:
        self._platform = platform
        self._servers = Servers(platform)
        self._repository = Repository(platform.documents)
        self._slots = Slots(platform)
        self._project_cache = ProjectCache(platform)
        self._pools = Pools(platform, self._project_cache)
        self._owners: dict[str, Versioned] = {}  # by the names of things
        self._found: list[Versioned] = []  # records that no thing led to
        self._unread: set[str] = set()  # names
        self._swept = Swept()
        self._begun = platform.now()
        self.census = Census()

    def run(self) -> Swept:
        """Remove every leftover; what was done. One thing that cannot be removed does not keep the others."""
        port = self._platform
        tasks, names, timers, clusters = self._listed(
            port.tasks.list, port.dns.list, port.timers.list, port.tasks.clusters
        )
        slots, handovers = self._of_projects()
        named = [task.name for task in tasks] + [record.name.split(".", 1)[0] for record in names]
        named += [name for running in slots.values() for name in running.names] + [name for _, name in handovers]
        self._read([*named, *(timer.removesuffix("-delay") for timer in timers), *clusters])
        self._read_records()
        self.census = self._count(tasks)
        self._remove("tasks", [task for task in tasks if self._leftover(task.name)], self._stop)
        stale = [record for record in names if self._leftover(record.name.split(".", 1)[0])]
        if stale:
            self._try("names", partial(port.dns.change, remove=stale), len(stale))
        self._remove("timers", [t for t in timers if self._leftover(t.removesuffix("-delay"))], self._end_timer)
        self._remove("clusters", [c for c in clusters if self._leftover(c)], port.tasks.delete_cluster)
        told = [(project_id, name) for project_id, name in handovers if self._leftover(name)]
        self._remove("handovers", told, lambda found: self._pools.forget(*found))
        for project_id, running in slots.items():
            gone = {name: self._own(name) for name in running.names if self._forgotten(name)}
            if gone:
                self._try("slots", partial(self._slots.free, project_id, gone), len(gone))
        self._check({task.name: task for task in tasks})
        self._look_after_pools()
        logger.info("swept", extra=asdict(self._swept))
        return self._swept

    def _of_projects(self) -> tuple[dict[str, Running], list[tuple[str, str]]]:
        """By project, who holds slots, and which warm servers have a handover document; empty without master list."""
        try:
            return self._slots.held(self._project_cache.projects(fresh=timedelta(0))), list(self._pools.handovers())
        except (ValueError, RecursionError) as error:
            failure("the list of projects cannot be read", error)
            self._swept.failed += 1
            return {}, []

    def _listed(self, *listings: Callable[[], Iterable[Any]]) -> list[list[Any]]:
        """What there is, all listings read at the same time. Raises what one of them raises: half a view misleads."""
        errors: list[Exception] = []

        def read(listing: Callable[[], Iterable[Any]]) -> list[Any]:
            try:
                return list(listing())
            except Exception as error:  # noqa: BLE001 - raised below, once all have ended
                errors.append(error)
                return []

        found = self._platform.together([partial(read, listing) for listing in listings])
        if errors:
            raise errors[0]
        return found

    def _count(self, tasks: Iterable[RunningTask]) -> Census:
        """A task of an earlier attempt than the record's is older than that attempt: its age is a lower bound."""
        now = self._platform.now()
        ages = [now - owner.server.requested for task in tasks if (owner := self._owners.get(task.name))]
        return Census(len(ages), max(ages, default=timedelta()))

    def _read(self, names: Iterable[str]) -> None:
        """Who owns what is called so, many at once. What cannot be read counts as not ours, this time."""
        ours = sorted({name for name in names if ids.parse_server_name(name)})
        found, unread = each(self._platform, ours, self._repository.owner, "a server's record cannot be read")
        self._owners, self._unread = dict(found), set(unread)
        self._swept.failed += len(unread)

    def _read_records(self) -> None:
        """Records that no thing leads to, for a server may have none yet, or none any more.

        Written some minutes ago, they may tell of a server that does not come on; so long ago that every server's time
        is over, of one that was never closed. Each is read by a few sweeps only, however many there are.
        """
        ages = (ASK_AGAIN, timedelta(minutes=self._platform.settings.max_runtime) + OVERTIME)
        known = {stored.server.label for stored in self._owners.values()}
        known |= {label for label, _ in filter(None, map(ids.parse_server_name, self._unread))}
        wanted = []
        for entry in self._platform.documents.list(RECORDS):
            label = entry.key.removeprefix(RECORDS).removesuffix(".json")
            age = self._begun - entry.modified
            due = any(since < age <= since + PASS for since in ages) and label not in known
            if due and entry.key == server_key(label) and ids.parse_server_name(f"{label}-1"):
                wanted.append(label)
        found, unread = each(self._platform, wanted, self._repository.server, "a server's record cannot be read", str)
        self._found = [stored for label, stored in found if stored.server.label == label]
        self._swept.failed += len(unread)

    def _leftover(self, name: str) -> bool:
        """Whether the thing is ours and its server is over, or another one has taken its place."""
        if (stored := self._owners.get(name)) is None:
            return False
        record, (_, attempt) = stored.server, ids.parse_server_name(name) or ("", 0)
        if record.name != name:
            return record.attempt >= attempt
        return record.closed is not None and record.closed <= self._begun

    def _forgotten(self, name: str) -> bool:
        """Whether a server is gone that holds a place.

        Not at once: its task may yet appear (and will be stopped), or the participant's next attempt take over.
        """
        if ids.parse_server_name(name) is None:
            return False
        known = self._owners.get(name)
        if known is None:  # erased: a server's record is written before it takes its place
            return name not in self._unread
        closed = known.server.closed
        return closed is not None and self._platform.now() > closed + UNSEEN

    def _own(self, name: str) -> Server | None:
        """The record of the server of this name; None if there is none, or if it is that of whom it was given to."""
        known, (label, _) = self._owners.get(name), ids.parse_server_name(name) or ("", 0)
        return known.server if known and known.server.label == label else None

    def _check(self, tasks: Mapping[str, RunningTask]) -> None:
        """Look after the servers that stay in a state for too long (`care.py`)."""
        now = self._platform.now()
        for stored in self._records():
            record = stored.server
            task = tasks.get(record.name)
            what = remedy(record, task, now)
            if what is Remedy.LOST:
                self._try("lost", partial(self._lose, stored, task))
            elif what is Remedy.OVERDUE:
                self._try("overdue", partial(self._tell_to_stop, record, Reason.DEADLINE))
            elif what:
                logger.warning("a server is asked for again", extra={"server": record.name, "what": what})
                self._try("asked", partial(self._ask, what, record, task))

    def _lose(self, stored: Versioned, task: RunningTask | None) -> None:
        if task:
            self._stop(task)
        self._servers.lost(stored, Reason.LOST)

    def _ask(self, what: Remedy, record: Server, task: RunningTask | None) -> None:
        """Send again what should move this server on. Whoever gets it finds out whether it is still needed."""
        bus = self._platform.bus
        match what:
            case Remedy.START:
                start = StartServer(record.project_id, record.user_id, record.attempt)
                bus.publish(Topic.START, to_message(start))
            case Remedy.RUNS if task and task.interface:
                bus.later(to_message(TaskSeen(task.task, task.cluster, task.name, task.interface)), 0)
            case Remedy.NAME:
                bus.later(to_message(DnsChanged("", [Named(record.label, record.attempt)], 1, unmade=True)), 0)
            case Remedy.STOP:
                self._tell_to_stop(record, Reason.STOPPED)
            case Remedy.REPLACE:
                self._servers.finish(record)

    def _look_after_pools(self) -> None:
        """Fill and empty the pools as far as messages were lost. A warm server that no pool knows goes.

        The pools are read last: a warm server is in its pool before it has a record, and leaves it when it is assigned
        or drained. Safe against concurrent handovers: one compare-and-swap on the warm server's record decides.
        """
        try:
            known = self._pools.mend(self._repository)
        except Exception as error:  # noqa: BLE001 - as below
            failure("the warm servers could not be looked after", error)
            self._swept.failed += 1
            return
        for record in [stored.server for stored in self._open() if stored.server.is_warm_server]:
            if record.user_id not in known and record.state is not State.DRAINING:  # that has been told
                self._try("warm_servers", partial(self._tell_to_stop, record, Reason.STOPPED))

    def _records(self) -> list[Versioned]:
        """Every record that was read, once. An assigned warm server's name leads to the participant's record."""
        found = [stored for stored in self._found if stored.server.taken_by is None]
        return list({s.server.name: s for s in [*found, *self._owners.values()]}.values())

    def _open(self) -> list[Versioned]:
        """Those that are not closed."""
        return [stored for stored in self._records() if not stored.server.is_closed]

    def _remove(self, what: str, things: Iterable[T], act: Callable[[T], object]) -> None:
        """Do away with all of these, many at once. The next sweep tries again what cannot be removed."""

        def one(thing: T) -> bool:
            act(thing)
            return True

        removed, failed = each(self._platform, things, one, f"a leftover could not be removed: {what}")
        self._note(what, len(removed), len(failed))

    def _end_timer(self, timer: str) -> None:
        """A timer is the last that goes of a server: something else may have been left undone, too."""
        stored = self._owners.get(timer)
        if stored and stored.server.name == timer:
            self._servers.finish(stored.server)
        else:
            self._platform.timers.cancel(timer)

    def _tell_to_stop(self, record: Server, reason: Reason) -> None:
        """By a message, which comes again until all is done: a later sweep might see nothing of a server half ended."""
        message = StopServer(record.project_id, record.user_id, record.attempt, reason)
        self._platform.bus.publish(Topic.STOP, to_message(message))

    def _stop(self, task: RunningTask) -> None:
        self._platform.tasks.stop(task.task, task.cluster, f"{messages.OUR_STOP} left over")

    def _try(self, what: str, act: Callable[[], object], count: int = 1) -> None:
        try:
            act()
        except Exception as error:  # noqa: BLE001 - the rest of the sweep goes on, and the next sweep tries again
            failure("a leftover could not be removed", error, what=what)
            self._note(what, failed=count)
        else:
            self._note(what, count)

    def _note(self, what: str, done: int = 0, failed: int = 0) -> None:
        setattr(self._swept, what, getattr(self._swept, what) + done)
        self._swept.failed += failed
