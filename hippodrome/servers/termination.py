"""How servers end: what `stop_server` does, and `task_changed` for tasks that are gone.

Everything a server owned goes first and its record is closed last, so that an interrupted ending is gone through again.

A task's end is told twice: when its containers have ended (DEPROVISIONING), and when AWS has taken down its network
interface as well, ten to thirty seconds or more later (STOPPED). The first is enough for everything but deleting a
cluster of the server's own, so that nobody waits for the second: whoever's Spot server was taken gets the next one
sooner. Not at Spot's warning already, two minutes ahead: until its end the trial stores what the next one goes on from.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

from hippodrome.limits.slots import Release, Slots
from hippodrome.log import logger
from hippodrome.model import ids, messages, server
from hippodrome.model.messages import StartServer, StopServer, TaskChanged, to_message
from hippodrome.model.server import Reason, Server, State, TaskStopped
from hippodrome.ports import Conflict, Platform, Topic
from hippodrome.servers import failures
from hippodrome.servers.batches import each
from hippodrome.servers.failures import Cause, FailureCategory
from hippodrome.servers.warm.handover import Handovers
from hippodrome.servers.warm.pools import Pools
from hippodrome.storage.project_cache import ProjectCache
from hippodrome.storage.repository import Repository, RetryLater, Versioned

I = TypeVar("I")  # noqa: E741 - what told of a server: a message or an event
ENDED = ("DEPROVISIONING", "STOPPED")  # states in which a task's containers have ended


class Terminating(NamedTuple):
    """A server that ends, and why."""

    stored: Versioned
    reason: Reason
    cause: Cause | None = None  # if it failed
    deprovisioning: bool = False  # its task is still in its cluster, which cannot be deleted yet


class Termination:
    """Lets servers go, many with one change of the zone."""

    def __init__(
        self,
        platform: Platform,
        project_cache: ProjectCache,
        repository: Repository,
        *,
        slots: Slots,
        pools: Pools,
        handovers: Handovers,
    ) -> None:
        self._platform = platform
        self._project_cache = project_cache
        self._repository = repository
        self._slots = slots
        self._pools = pools
        self._handovers = handovers
        self.failures: deque[Cause] = deque()  # of servers closed since somebody looked

    # Told to stop

    def stop(self, batch: Sequence[StopServer]) -> list[StopServer]:
        """Let servers go: tasks, names, places, timers, clusters, then their records. What should come again."""
        wanted = list(dict.fromkeys(batch))  # a message may be in a batch twice
        going, again = each(self._platform, wanted, self._end_task, "a server is not stopped yet")
        self._remove_names(one.stored for _, one in going)
        freed, stuck = self._give_back(going)
        _, failed = each(self._platform, freed, lambda one: self._finish(one[1]), "a server is not closed yet", _name)
        return again + stuck + [message for message, _ in failed]

    def _end_task(self, message: StopServer) -> Terminating | None:
        """Stop the task that a message speaks of; the server, or None if there is nothing to stop."""
        stored = self._to_stop(message)
        if stored and stored.server.is_warm_server:
            stored = self._withdraw(stored)
        if stored is None:
            return None
        record = stored.server
        task = record.task or self._platform.tasks.find(record.name, record.cluster)
        if task:
            self._platform.tasks.stop(task, record.cluster, f"{messages.OUR_STOP} {message.reason}")
        return Terminating(stored, Reason.DEADLINE if message.reason == Reason.DEADLINE else Reason.STOPPED)

    def _to_stop(self, message: StopServer) -> Versioned | None:
        """The record of the server to stop; None if it is closed. Leaves a tombstone where there never was one."""
        stored = self._repository.server(ids.server_label(message.project_id, message.user_id))
        if stored is None:
            if message.reason == Reason.STOPPED:
                try:
                    self._repository.create(
                        server.tombstone(message.project_id, message.user_id, 1, self._platform.now())
                    )
                except Conflict:
                    raise RetryLater("started at this very moment") from None
            return None
        return stored if stored.server.is_open(message.attempt or stored.server.attempt) else None

    def _withdraw(self, stored: Versioned) -> Versioned | None:
        """A warm server that nobody may take any more; None if somebody has."""
        if stored.server.state is State.DRAINING:
            return stored
        return self._repository.update(stored, lambda r: None if r.is_closed else server.draining(r))

    def _finish(self, going: Terminating) -> None:
        record = going.stored.server
        if going.reason is not Reason.DEADLINE:  # the timer that brought this message has deleted itself
            self._platform.timers.cancel(record.name)
        if record.own_cluster:
            self._platform.tasks.delete_cluster(record.cluster)
        self._leave_pool(record)
        try:
            closed = self._repository.save(server.close(record, going.reason, self._platform.now()), going.stored.etag)
        except Conflict:
            if (present := self._repository.server(record.label)) and not present.server.is_open(record.attempt):
                return  # another stop was faster
            raise RetryLater("the record changed while its server was stopped") from None
        logger.info("server closed", extra={"server": record.name, "reason": going.reason})
        self._refill(closed.server)

    # Gone by themselves

    def stopped(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """Tasks have ended. Clean up after those that we did not stop ourselves, and replace those that were lost."""
        gone, again = each(
            self._platform, events, self._gone, "a stopped task is not dealt with yet", lambda event: event.name
        )
        self._remove_names(one.stored for _, one in gone)
        freed, stuck = self._give_back(gone)
        _, failed = each(
            self._platform, freed, lambda one: self._clear(one[1]), "a lost server is not closed yet", _name
        )
        return again + stuck + [event for event, _ in failed]

    def lost(self, stored: Versioned, reason: Reason, cause: Cause) -> None:
        """Clean up after a server whose task is gone or never was; ask for the next attempt if there should be one."""
        going, record = Terminating(stored, reason, cause), stored.server
        if record.own_cluster:  # refused, before anything else goes, if there is a task that no list shows yet
            self._platform.tasks.delete_cluster(record.cluster)
        self._remove_names([stored])
        _, stuck = self._give_back([(None, going)])
        if stuck:
            raise RetryLater("the server's place is not given back yet")
        self._clear(going)

    def _gone(self, event: TaskChanged) -> Terminating | None:
        if event.stopped_reason.startswith(messages.OUR_STOP):
            return None  # `stop` does the rest
        stored = self._repository.owner(event.name)
        if stored is None:
            return None
        record, deprovisioning = stored.server, event.status != "STOPPED"
        over = record.is_closed or record.name != event.name
        if over and not deprovisioning and event.cluster == event.name:
            self._platform.tasks.delete_cluster(event.cluster)  # it had to wait for this
        if record.name != event.name or record.task not in (None, event.task):
            return None  # another one's: an earlier server's, or of two tasks for one server the one that is not wanted
        ended = TaskStopped(event.stop_code, event.exit_code, f"{event.stopped_reason} {event.container_reason}")
        reason = server.why(ended)
        cause = failures.of_task(ended, was_ready=record.state is State.READY) if reason is Reason.LOST else None
        return Terminating(stored, reason, cause, deprovisioning)

    def _remove_names(self, going: Iterable[Versioned]) -> None:
        names = [s.server.dns_record for s in going if s.server.dns_record and not s.server.is_closed]
        if names:
            self._platform.dns.change(remove=names)

    def _give_back(self, going: Sequence[tuple[I, Terminating]]) -> tuple[list[tuple[I, Terminating]], list[I]]:
        """Give back the places of those that hold one, with one write per project.

        Those that may be closed now, and what should come again because its project's places could not be written.
        """
        projects: dict[str, list[Release]] = {}
        for _, one in going:
            record = one.stored.server
            if record.counted and not record.is_closed:
                projects.setdefault(record.project_id, []).append(Release(record, one.reason))
        _, failed = each(
            self._platform,
            projects,
            lambda project: self._slots.give_back(project, projects[project]),
            "places are not given back yet",
        )
        freed = [one for one in going if one[1].stored.server.project_id not in failed]
        return freed, [item for item, one in going if one.stored.server.project_id in failed]

    def _clear(self, going: Terminating) -> None:
        """All that is left of it, then its record, then the next attempt where the reason calls for one.

        Its timer goes last: where the sweep does this and is cut off, the timer leads the next sweep here (`finish`).
        """
        record = going.stored.server
        if record.is_closed:  # what follows may have been cut off
            self.finish(record)
            return
        if record.own_cluster and not going.deprovisioning:
            self._platform.tasks.delete_cluster(record.cluster)
        self._leave_pool(record)
        now, cause = self._platform.now(), going.cause or ""
        closed = self._repository.update(
            going.stored, lambda r: server.close(r, going.reason, now, cause) if r.owns(record.name) else None
        )
        if closed is None and record.is_warm_server:
            raise RetryLater("it may have been given away meanwhile: then it is lost to whoever was given it")
        if closed and going.cause:
            self.failures.append(going.cause)
        log = logger.warning if cause else logger.info
        log("server closed", extra={"server": record.name, "reason": going.reason, "cause": cause})
        self.finish(closed.server if closed else record)

    def finish(self, closed: Server) -> None:
        """What comes after the closing: the next attempt if there should be one, and the end of the timer."""
        self._replace(closed)
        self._platform.timers.cancel(closed.name)

    def _replace(self, closed: Server) -> None:
        """Ask for the next attempt, unless the participant has played all there is to play."""
        if closed.is_warm_server:
            self._refill(closed)
            return
        following = server.next_attempt(closed)
        if following is None or self._has_played(closed):
            return
        self._platform.bus.publish(Topic.START, to_message(StartServer(closed.project_id, closed.user_id, following)))

    # Warm servers

    def _leave_pool(self, record: Server) -> None:
        """What ties a server to the pool of its project goes before its record is closed."""
        if record.is_warm_server:
            self._pools.gone(record.project_id, record.user_id)
        else:
            self._handovers.end(record)

    def _refill(self, closed: Server) -> None:
        """A warm server that has waited long enough, or worked until AWS took it, is replaced at once.

        One that was told to go may have given up the place that its successor needs.

        Others are asked for by the next sweep, so that a program that fails does not start again and again.
        """
        if not closed.is_warm_server:
            return
        cause = failures.known(closed.cause)
        taken_back = closed.ready and cause and cause.category is FailureCategory.AWS
        gave_place = closed.reason is Reason.STOPPED and closed.counted
        if closed.reason is Reason.DEADLINE or taken_back or gave_place:
            self._pools.ask(closed.project_id)

    def _has_played(self, closed: Server) -> bool:
        """A server may be lost between the last answer it wrote and its stop: nobody needs another one then."""
        project = self._project_cache.live_project(closed.project_id)
        if project is None or not project.game_steps:
            return False
        progress = self._repository.progress(closed.project_id, closed.user_id)
        return all(step in progress.answered for step in project.game_steps)


def _name(one: tuple[object, Terminating]) -> str:
    return one[1].stored.server.name
