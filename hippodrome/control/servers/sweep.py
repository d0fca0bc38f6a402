"""`sweep`: deletes the resources that no open record owns, and sends lost messages again.

Resources are listed first and records read afterwards. A record is written before its server's resources are created,
so a listed resource whose record is closed is a leftover: there is no race, and no need to guess by its age. Resources
of three kinds stay: if their server was closed after the sweep began (the function that closed it deletes them), if
their name is no server's name, or if our bucket has no record of them (they may be another installation's).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import timedelta
from functools import partial
from typing import TypeVar

from hippodrome.control.limits.rules import ServerSlots
from hippodrome.control.log import failure, logger
from hippodrome.control.model import ids, messages
from hippodrome.control.model.messages import DnsChanged, ServerAttempt, StartServer, StopServer, TaskSeen, to_message
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import RECORDS, Reason, Server, ServerState
from hippodrome.control.model.server import key as server_key
from hippodrome.control.ports import Platform, RunningTask, Topic
from hippodrome.control.servers import leftovers, resources
from hippodrome.control.servers.batches import for_each
from hippodrome.control.servers.causes import Cause
from hippodrome.control.servers.dns import delete_dns_records
from hippodrome.control.servers.leftovers import Scope
from hippodrome.control.servers.overdue import OVERDUE_AFTER, RETRY_AFTER, Remedy, remedy
from hippodrome.control.servers.services import ServerServices
from hippodrome.control.servers.sessions import Sessions
from hippodrome.control.servers.termination import Termination
from hippodrome.control.storage.repository import Versioned

CHECKED_FOR = timedelta(minutes=15)  # each record is read for this long after it reaches one of the `ages`

T = TypeVar("T")


@dataclass
class SweepResult:
    """What one sweep did, counted."""

    tasks: int = 0  # removed, like the names, timers and clusters below
    names: int = 0  # DNS records
    timers: int = 0
    clusters: int = 0
    slots: int = 0  # slots that ended servers still held, and that were released
    warm_servers: int = 0  # warm servers that were stopped because no pool lists them
    sessions: int = 0  # stopped servers of sessions that never formed, or that all members have left
    handovers: int = 0  # handover documents deleted
    overdue: int = 0  # servers stopped after their deadline
    lost: int = 0  # servers that had lost their task, and were cleaned up
    asked: int = 0  # servers for which a message was sent again
    failed: int = 0  # actions that failed


@dataclass(frozen=True)
class RunningServers:
    """The number of this installation's servers that ran when a sweep began, and the age of the oldest."""

    count: int = 0
    oldest: timedelta = timedelta()  # the time since the oldest of them was requested


class Sweep:
    """One sweep over all resources that may be ours. `running` is set once it has run."""

    def __init__(self, platform: Platform) -> None:
        services = ServerServices(platform)
        self._platform = platform
        self._termination = Termination(services)
        self._repository = services.repository
        self._slots = services.slots
        self._project_cache = services.project_cache
        self._pools = services.pools
        self._lobby = services.lobby
        self._sessions = Sessions(services)
        self._owners: dict[str, Versioned] = {}  # the records that own resources, by the resources' names
        self._other_records: list[Versioned] = []  # records of servers without a listed resource
        self._unread: set[str] = set()  # the names of resources whose records could not be read
        self._result = SweepResult()
        self._begun = platform.now()
        self.running = RunningServers()

    def run(self) -> SweepResult:
        """Run the sweep; return the counts. A failure is counted, and the sweep goes on."""
        platform = self._platform
        found = resources.list_resources(platform)
        slots, handovers = self._slots_and_handovers()
        in_documents = [name for running in slots.values() for name in running.names]
        in_documents += [name for _, name in handovers]
        self._read_owners([*found.names(), *in_documents])
        self._read_other_records()
        self.running = self._running_servers(found.tasks)
        owners = {name: stored.server for name, stored in self._owners.items()}
        scope, now = Scope(closed_by=self._begun), platform.now()
        left = leftovers.leftovers(found, owners, scope)
        self._remove("tasks", left.tasks, self._stop)
        if stale := left.dns_records:
            self._try("names", partial(delete_dns_records, platform, stale), len(stale))
        self._remove("timers", left.timers, self._end_timer)
        self._remove("clusters", left.clusters, platform.tasks.delete_cluster)
        documents = [
            handover for handover in handovers if leftovers.why_left_over(handover[1], owners.get(handover[1]), scope)
        ]
        self._remove("handovers", documents, lambda document: self._pools.delete_handover(*document))
        for project_id, running in slots.items():
            read = [name for name in running.names if name not in self._unread]
            ended = [name for name in read if leftovers.why_slot_left_over(name, owners.get(name), now)]
            forgotten = {name: self._record_of(name) for name in ended}
            if forgotten:
                self._try("slots", partial(self._slots.release_forgotten, project_id, forgotten), len(forgotten))
        self._check_states({task.name: task for task in found.tasks})
        self._repair_pools()
        self._stop_sessions(self._repair_lobbies())
        logger.info("swept", extra=asdict(self._result))
        return self._result

    def _slots_and_handovers(self) -> tuple[dict[str, ServerSlots], list[tuple[str, str]]]:
        """The slots of servers, by project; and the project and the server's name of each handover document.

        Both are empty if the list of projects cannot be read.
        """
        try:
            slots = self._slots.server_slots(self._project_cache.projects(fresh=timedelta(0)))
            return slots, list(self._pools.handovers())
        except ValueError as error:
            failure("the list of projects cannot be read", error)
            self._result.failed += 1
            return {}, []

    def _running_servers(self, tasks: Iterable[RunningTask]) -> RunningServers:
        """Count the running servers, and find the age of the oldest.

        If a record is already at a later attempt than its task, the server is older than this says.
        """
        now = self._platform.now()
        ages = [now - owner.server.requested for task in tasks if (owner := self._owners.get(task.name))]
        return RunningServers(len(ages), max(ages, default=timedelta()))

    def _read_owners(self, names: Iterable[str]) -> None:
        """Read the records that own these names, many at once. If one cannot be read, its resource stays this time."""
        ours = sorted({name for name in names if ids.parse_server_name(name)})
        owners_read, unread = for_each(self._platform, ours, self._repository.owner, "a server's record cannot be read")
        self._owners, self._unread = dict(owners_read), set(unread)
        self._result.failed += len(unread)

    def _read_other_records(self) -> None:
        """Read records of servers without a listed resource: a server may have none yet, or none any more.

        If a record was written some minutes ago, its server may make no progress. If it is older than any server may
        live, its server may never have been closed. Only a few sweeps read each record, even if there are many.
        """
        ages = (RETRY_AFTER, timedelta(minutes=self._platform.settings.max_runtime) + OVERDUE_AFTER)
        labels = {stored.server.label for stored in self._owners.values()}
        labels |= {label for label, _ in filter(None, map(ids.parse_server_name, self._unread))}
        wanted = []
        for entry in self._platform.documents.list(RECORDS):
            label = entry.key.removeprefix(RECORDS).removesuffix(".json")
            age = self._begun - entry.modified
            due = any(since < age <= since + CHECKED_FOR for since in ages) and label not in labels
            if due and entry.key == server_key(label) and ids.parse_server_name(f"{label}-1"):
                wanted.append(label)
        records_read, unread = for_each(
            self._platform, wanted, self._repository.server, "a server's record cannot be read", str
        )
        self._other_records = [stored for label, stored in records_read if stored.server.label == label]
        self._result.failed += len(unread)

    def _record_of(self, name: str) -> Server | None:
        """The server's own record; None if there is none, or if the server was assigned to a participant."""
        owner = self._owners.get(name)
        return owner.server if owner and owner.server.warm_server_name != name else None

    def _check_states(self, tasks: Mapping[str, RunningTask]) -> None:
        """Act on the servers that stay in a state for too long (`overdue.py`)."""
        now = self._platform.now()
        for stored in self._records():
            record = stored.server
            task = tasks.get(record.name)
            chosen = remedy(record, task, now)
            if chosen is Remedy.LOST:
                self._try("lost", partial(self._end_lost, stored, task))
            elif chosen is Remedy.OVERDUE:
                self._try("overdue", partial(self._send_stop, record, Reason.DEADLINE))
            elif chosen:
                logger.warning("a server's message is sent again", extra={"server": record.name, "what": chosen})
                self._try("asked", partial(self._send_again, chosen, record, task))

    def _end_lost(self, stored: Versioned, task: RunningTask | None) -> None:
        if task:
            self._stop(task)
        self._termination.clean_up_lost(stored, Reason.LOST, Cause.VANISHED)

    def _send_again(self, chosen: Remedy, record: Server, task: RunningTask | None) -> None:
        """Send the message for this server's next state again. The receiver checks whether it still applies."""
        bus = self._platform.bus
        match chosen:
            case Remedy.START:
                start = StartServer(record.project_id, record.user_id, record.attempt)
                bus.publish(Topic.START, to_message(start))
            case Remedy.RUNNING if task and task.interface:
                bus.send_delayed(to_message(TaskSeen(task.task, task.cluster, task.name, task.interface)), 0)
            case Remedy.DNS:
                bus.send_delayed(
                    to_message(DnsChanged("", [ServerAttempt(record.label, record.attempt)], 1, unmade=True)), 0
                )
            case Remedy.STOP:
                self._send_stop(record, Reason.STOPPED)
            case Remedy.REPLACE:
                self._termination.after_close(record)

    def _repair_pools(self) -> None:
        """Repair the pools after lost messages, and stop the warm servers that no pool lists.

        The pools are read last: a warm server is in its pool before it has a record, and leaves it when it is assigned
        or drained. Safe against concurrent handovers: one compare-and-swap on the warm server's record decides.
        """
        try:
            pools_known = self._pools.repair(self._repository)
        except Exception as error:  # noqa: BLE001 - as below
            failure("the pools of warm servers could not be repaired", error)
            self._result.failed += 1
            return
        for record in [stored.server for stored in self._open() if stored.server.is_warm_server]:
            is_stopped = record.state is ServerState.DRAINING  # `_check_states` has sent it a stop message
            if record.user_id not in pools_known and not is_stopped:
                self._try("warm_servers", partial(self._send_stop, record, Reason.STOPPED))

    def _stop_sessions(self, listed: Mapping[str, Collection[str] | None]) -> None:
        """Stop the servers of sessions that are not needed. `listed`: each lobby's sessions, read after the records.

        A session is in its lobby before its server has a record. It leaves the lobby when its document is written, or
        when its server is not needed any more.
        """
        running = [stored.server for stored in self._open() if stored.server.is_of_session]
        unlisted = [
            record
            for record in running
            if (open_sessions := listed.get(record.project_id, ())) is not None and record.user_id not in open_sessions
        ]
        stopped, failed = for_each(
            self._platform, unlisted, self._stop_if_over, "a session's server is not stopped yet", lambda r: r.name
        )
        self._add("sessions", len(stopped), len(failed))

    def _repair_lobbies(self) -> dict[str, Collection[str] | None]:
        """Repair the lobbies; return, by project, the ids of the sessions in its lobby, or None if unknown."""
        listed: dict[str, Collection[str] | None] = {}
        for project in self._projects_with_sessions():
            try:
                listed[project.id] = self._lobby.repair(project)
            except Exception as error:  # noqa: BLE001 - the other projects go on, and the next sweep tries again
                failure("a lobby could not be repaired", error, project=project.id)
                self._result.failed += 1
                listed[project.id] = None
        return listed

    def _projects_with_sessions(self) -> list[Project]:
        """The registered projects whose sessions have several players; none if the list cannot be read."""
        try:
            return [project for project in self._project_cache.projects() if project.has_sessions]
        except ValueError as error:
            failure("the list of projects cannot be read", error)
            return []

    def _stop_if_over(self, record: Server) -> bool | None:
        """Stop the server of a session that no lobby lists, if it was never formed or all members have left it.

        Return True if it is stopped. Raises `BadSession` if the session's document cannot be read.
        """
        session = self._repository.session(record.project_id, record.user_id)
        project = self._project_cache.project(record.project_id)
        if session is not None and not (project and self._sessions.is_over(project, session)):
            return None
        self._send_stop(record, Reason.STOPPED)
        return True

    def _records(self) -> list[Versioned]:
        """Every record that was read, once; without assigned warm servers, which their participants' records own."""
        unassigned = [stored for stored in self._other_records if stored.server.assigned_to is None]
        return list({s.server.name: s for s in [*unassigned, *self._owners.values()]}.values())

    def _open(self) -> list[Versioned]:
        """The records that are not closed."""
        return [stored for stored in self._records() if not stored.server.is_closed]

    def _remove(self, count: str, resources: Iterable[T], act: Callable[[T], object]) -> None:
        """Call `act` to remove each of these resources, many at once. What fails is tried again by the next sweep.

        `count` is the name of the count in `SweepResult`.
        """

        def one(resource: T) -> bool:
            act(resource)
            return True

        removed, failed = for_each(self._platform, resources, one, f"a leftover could not be removed: {count}")
        self._add(count, len(removed), len(failed))

    def _end_timer(self, timer: str) -> None:
        """Delete a server's timer. Since it is deleted last, repeat `after_close`, which may have been interrupted."""
        stored = self._owners.get(timer)
        if stored and stored.server.name == timer:
            self._termination.after_close(stored.server)
        else:
            self._platform.timers.cancel(timer)

    def _send_stop(self, record: Server, reason: Reason) -> None:
        """Send a stop message. The queue delivers it again until the server is stopped completely.

        If the sweep stopped the server itself and was interrupted, a later sweep might miss it.
        """
        message = StopServer(record.project_id, record.user_id, record.attempt, reason)
        self._platform.bus.publish(Topic.STOP, to_message(message))

    def _stop(self, task: RunningTask) -> None:
        self._platform.tasks.stop(task.task, task.cluster, f"{messages.STOP_REASON_PREFIX} left over")

    def _try(self, count: str, act: Callable[[], object], number: int = 1) -> None:
        """Call `act`, which handles `number` servers or resources. Add the number to this count, or to `failed`."""
        try:
            act()
        except Exception as error:  # noqa: BLE001 - the rest of the sweep goes on, and the next sweep tries again
            failure("a leftover could not be removed", error, what=count)
            self._add(count, failed=number)
        else:
            self._add(count, number)

    def _add(self, count: str, done: int = 0, failed: int = 0) -> None:
        setattr(self._result, count, getattr(self._result, count) + done)
        self._result.failed += failed
