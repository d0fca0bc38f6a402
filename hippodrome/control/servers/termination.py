"""Ends servers: `stop_server` stops them, and `task_changed` cleans up after tasks that have ended.

A server's resources are deleted before its record is closed, so an interrupted termination is repeated. Two resources
are deleted later. The timer is deleted last: if a function is interrupted before that, the next sweep finds the timer,
and by it the record. If the server ended by itself, a cluster of its own is deleted once ECS reports STOPPED.

ECS reports the end of a task twice: when its containers have ended (DEPROVISIONING), and, ten to thirty seconds or more
later, when its network interface is deleted as well (STOPPED). The first event is enough, so that a participant gets
the next server sooner after a Spot interruption; only a server's own cluster has to wait for the second. Spot's warning
two minutes ahead is too early: until its end the trial stores the state from which the next server resumes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

from hippodrome.control.limits.slots import Release
from hippodrome.control.log import logger
from hippodrome.control.model import ids, messages, server
from hippodrome.control.model.messages import StopServer, TaskChanged
from hippodrome.control.model.server import Reason, Server, ServerState, TaskStopped, next_attempt
from hippodrome.control.ports import Conflict, RetryLater
from hippodrome.control.servers import causes
from hippodrome.control.servers.batches import for_each
from hippodrome.control.servers.causes import Cause, FailureCategory
from hippodrome.control.servers.dns import delete_dns_records
from hippodrome.control.servers.replacement import Replacement
from hippodrome.control.servers.services import ServerServices
from hippodrome.control.servers.sessions import Sessions
from hippodrome.control.storage.repository import Versioned

I = TypeVar("I")  # noqa: E741 - the item that led to a server: a message or an event
ENDED = ("DEPROVISIONING", "STOPPED")  # states in which a task's containers have ended
STOP_TRIES = 4  # a start writes a record three times (task, address, DNS record); then the queue delivers again


class ServerToClose(NamedTuple):
    """A server whose record is to be closed, and why."""

    stored: Versioned
    reason: Reason
    cause: Cause | None = None  # why it failed, if it did
    deprovisioning: bool = False  # its task is still DEPROVISIONING, so a cluster of its own cannot be deleted yet


class Termination:
    """Ends servers. All servers of a batch share one DNS change."""

    def __init__(self, services: ServerServices) -> None:
        self._services = services
        self._platform = services.platform
        self._repository = services.repository
        self._sessions = Sessions(services)

    # Servers that are told to stop

    def stop(self, batch: Sequence[StopServer]) -> list[StopServer]:
        """Stop servers; return the messages that should be delivered again.

        What belongs to a server is ended in this order: task, DNS record, slot, cluster, the server's record, timer.
        """
        again: list[StopServer] = []
        changed = list(dict.fromkeys(batch))  # a message may be in a batch twice
        for _ in range(STOP_TRIES):
            failed, changed = self._stop_once(changed)
            again += failed
            if not changed:
                break
        return again + changed

    def _stop_once(self, messages: Sequence[StopServer]) -> tuple[list[StopServer], list[StopServer]]:
        """Stop servers; return the messages that failed, and the messages for servers whose record has just changed.

        The caller handles the second kind once more from the beginning: the change may have added a task or an address.
        The queue would deliver these messages again only after its visibility timeout.
        """
        to_close, again = for_each(self._platform, messages, self._stop_task, "a server is not stopped yet")
        closing = _each_once(to_close)
        self._delete_dns_records(server_to_close.stored for _, server_to_close in closing)
        freed, stuck = self._free_slots(closing)
        tried, failed = for_each(
            self._platform, freed, lambda pair: self._close_stopped(pair[1]), "a server is not closed yet", _server_name
        )
        changed = [message for (message, _), closed in tried if not closed]
        return again + stuck + [message for message, _ in failed], changed

    def _stop_task(self, message: StopServer) -> ServerToClose | None:
        """Stop the task of the server that the message names; None if there is nothing to stop."""
        stored = self._record_to_stop(message)
        if stored and stored.server.is_warm_server:
            stored = self._drain(stored)
        if stored is None:
            return None
        record = stored.server
        task = record.task or self._platform.tasks.find(record.name, record.cluster)
        if task:
            self._platform.tasks.stop(task, record.cluster, f"{messages.STOP_REASON_PREFIX} {message.reason}")
        return ServerToClose(stored, Reason.DEADLINE if message.reason == Reason.DEADLINE else Reason.STOPPED)

    def _record_to_stop(self, message: StopServer) -> Versioned | None:
        """The record of the server to stop; None if none is open.

        If there is no record at all and the reason is `STOPPED`, create a closed record: a start message that comes
        later finds it, and starts nothing. In a project with sessions, participants have no record, or one from before
        it had sessions; their message may be for their session's server. Raises `RetryLater` if the server is started
        at the same time.
        """
        stored = self._repository.stored_server(message.project_id, message.user_id)
        if stored is not None and stored.server.is_open(message.attempt or stored.server.attempt):
            return stored
        if message.reason != Reason.STOPPED or (stored is not None and message.attempt is not None):
            return None
        if ids.is_user_id(message.user_id) and self._sessions.has_sessions(message.project_id):
            stop = self._sessions.stop_of(message)
            return self._record_to_stop(stop) if stop else None
        if stored is not None:
            return None
        try:
            self._repository.create(
                server.stopped_before_start(message.project_id, message.user_id, 1, self._platform.now())
            )
        except Conflict:
            raise RetryLater("started at this very moment") from None
        return None

    def _drain(self, stored: Versioned) -> Versioned | None:
        """Drain a warm server, so that it cannot be assigned any more; None if it is assigned or closed already."""
        if stored.server.state is ServerState.DRAINING:
            return stored
        return self._repository.update(stored, lambda r: None if r.is_closed else server.draining(r))

    def _close_stopped(self, closing: ServerToClose) -> bool:
        """Close the record of a server whose task is stopped; False if the record was changed meanwhile and is open.

        The timer is deleted last: if this is interrupted and not repeated, the sweep finds the record by the timer.
        """
        record = closing.stored.server
        if record.has_own_cluster:
            self._platform.tasks.delete_cluster(record.cluster)
        self._leave_pool(record)
        try:
            closed = self._repository.save(
                server.close(record, closing.reason, self._platform.now()), closing.stored.etag
            )
        except Conflict:
            present = self._repository.server(record.label)
            return present is None or not present.server.is_open(record.attempt)  # another stop was faster
        logger.info("server closed", extra={"server": record.name, "reason": closing.reason})
        self._refill_pool(closed.server)
        if closing.reason is not Reason.DEADLINE:  # the timer that sent this message has deleted itself
            self._platform.timers.cancel(record.name)
        return True

    # Servers that ended by themselves

    def tasks_ended(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """Clean up after tasks that ended by themselves; replace lost servers; return the events to deliver again."""
        closing, again = for_each(
            self._platform, events, self._ended_server, "an ended task is not handled yet", lambda event: event.name
        )
        self._delete_dns_records(server_to_close.stored for _, server_to_close in closing)
        freed, stuck = self._free_slots(closing)
        _, failed = for_each(
            self._platform,
            freed,
            lambda pair: self._close_ended(pair[1]),
            "a lost server is not closed yet",
            _server_name,
        )
        return again + stuck + [event for event, _ in failed]

    def clean_up_lost(self, stored: Versioned, reason: Reason, cause: Cause) -> None:
        """Clean up after a server without a task, and request the next attempt if there should be one.

        Raises `RetryLater` if its slot could not be freed, or what ECS raises if its cluster still holds a task.
        """
        closing, record = ServerToClose(stored, reason, cause), stored.server
        if record.has_own_cluster:  # done first: ECS refuses if the cluster holds a task that no listing shows yet
            self._platform.tasks.delete_cluster(record.cluster)
        self._delete_dns_records([stored])
        _, stuck = self._free_slots([(None, closing)])
        if stuck:
            raise RetryLater("the server's slot is not freed yet")
        self._close_ended(closing)

    def _ended_server(self, event: TaskChanged) -> ServerToClose | None:
        """The server whose task has ended; None if we stopped the task, or if it is not the server's present task."""
        if event.stopped_reason.startswith(messages.STOP_REASON_PREFIX):
            return None  # `stop` has stopped the task, and does the rest
        stored = self._repository.owner(event.name)
        if stored is None:
            return None
        record, deprovisioning = stored.server, event.status != "STOPPED"
        over = record.is_closed or record.name != event.name
        if over and not deprovisioning and event.cluster == event.name:
            self._platform.tasks.delete_cluster(event.cluster)  # it could not be deleted before the task was STOPPED
        if record.name != event.name or record.task not in (None, event.task):
            return None  # the task is an earlier attempt's, or the unwanted one of two tasks for one server
        ended = TaskStopped(event.stop_code, event.exit_code, f"{event.stopped_reason} {event.container_reason}")
        reason = server.reason_for(ended)
        cause = (
            causes.cause_of_task(ended, was_ready=record.state is ServerState.READY) if reason is Reason.LOST else None
        )
        return ServerToClose(stored, reason, cause, deprovisioning)

    def _delete_dns_records(self, closing: Iterable[Versioned]) -> None:
        delete_dns_records(self._platform, [s.server.dns_record for s in closing if not s.server.is_closed])

    def _free_slots(self, closing: Sequence[tuple[I, ServerToClose]]) -> tuple[list[tuple[I, ServerToClose]], list[I]]:
        """Free the slots that these servers hold, with one write per project. A replaced server's slot is kept.

        Return the servers that may be closed now, and the items to deliver again because the write failed.
        """
        projects: dict[str, list[Release]] = {}
        for _, server_to_close in closing:
            record = server_to_close.stored.server
            if record.counted and not record.is_closed:
                closed = server.close(record, server_to_close.reason, self._platform.now(), server_to_close.cause or "")
                release = Release(record, server_to_close.reason, keep=next_attempt(closed) is not None)
                projects.setdefault(record.project_id, []).append(release)
        _, failed = for_each(
            self._platform,
            projects,
            lambda project: self._services.slots.release(project, projects[project]),
            "slots are not freed yet",
        )
        freed = [pair for pair in closing if pair[1].stored.server.project_id not in failed]
        return freed, [item for item, one in closing if one.stored.server.project_id in failed]

    def _close_ended(self, closing: ServerToClose) -> None:
        """Delete the server's cluster and pool entry, close its record, then call `after_close`.

        The timer is deleted last: if this is interrupted, the next sweep finds the timer and calls `after_close`.
        """
        record = closing.stored.server
        if record.is_closed:  # `after_close` again, since an earlier call may have been interrupted
            self.after_close(record)
            return
        if record.has_own_cluster and not closing.deprovisioning:
            self._platform.tasks.delete_cluster(record.cluster)
        self._leave_pool(record)
        now, cause = self._platform.now(), closing.cause or ""
        closed = self._repository.update(
            closing.stored, lambda r: server.close(r, closing.reason, now, cause) if r.owns(record.name) else None
        )
        if closed is None and record.is_warm_server:
            raise RetryLater(
                "the warm server may have been assigned: then its participant's record is the one to close"
            )
        if closed and closing.cause:
            self._services.note_failure(closing.cause)
        log = logger.warning if cause else logger.info
        log("server closed", extra={"server": record.name, "reason": closing.reason, "cause": cause})
        self.after_close(closed.server if closed else record)

    def after_close(self, closed: Server) -> None:
        """Request the next attempt of a closed server, or refill the pool of a warm one; then delete the timer."""
        if closed.is_warm_server:
            self._refill_pool(closed)
        else:
            Replacement(self._services).request(closed)
        self._platform.timers.cancel(closed.name)

    # Warm servers

    def _leave_pool(self, record: Server) -> None:
        """Before its record is closed, remove a warm server from its pool, or release an assigned one's handover."""
        if record.is_warm_server:
            self._services.pools.remove(record.project_id, record.user_id)
        else:
            self._services.handovers.release(record)

    def _refill_pool(self, closed: Server) -> None:
        """Replace a warm server at once if its deadline is over, if AWS took it back, or if stopping it freed a slot.

        In all other cases the next sweep replaces it, so that a failing program does not start again and again.
        """
        if not closed.is_warm_server:
            return
        cause = causes.parse_cause(closed.cause)
        taken_back = closed.ready and cause and cause.category is FailureCategory.AWS
        freed_slot = closed.reason is Reason.STOPPED and closed.counted
        if closed.reason is Reason.DEADLINE or taken_back or freed_slot:
            self._services.pools.request_adjustment(closed.project_id)


def _each_once(pairs: Sequence[tuple[StopServer, ServerToClose]]) -> list[tuple[StopServer, ServerToClose]]:
    """The list with each server once: several members' messages may be for the server of their session."""
    return list(
        {
            server_to_close.stored.server.name: (message, server_to_close)
            for message, server_to_close in reversed(pairs)
        }.values()
    )[::-1]


def _server_name(pair: tuple[object, ServerToClose]) -> str:
    return pair[1].stored.server.name
