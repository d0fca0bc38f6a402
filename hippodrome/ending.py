"""How servers end: what `stop_server` does, and `task_changed` for tasks that are gone.

Everything a server owned goes first and its record is closed last, so that an interrupted ending is gone through again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

from hippodrome import ids, messages, server
from hippodrome.batches import each
from hippodrome.ledger import Later, Ledger, Stored
from hippodrome.library import Library
from hippodrome.log import logger
from hippodrome.messages import StartServer, StopServer, TaskChanged, to_message
from hippodrome.places import Leaving, Places
from hippodrome.platform import Conflict, Platform, Topic
from hippodrome.server import Reason, Server, TaskStopped

I = TypeVar("I")  # noqa: E741 - what told of a server: a message or an event


class Going(NamedTuple):
    """A server that ends, and why."""

    stored: Stored
    reason: Reason


class Ending:
    """Lets servers go, many with one change of the zone."""

    def __init__(self, platform: Platform, library: Library, ledger: Ledger, places: Places) -> None:
        self._platform = platform
        self._library = library
        self._ledger = ledger
        self._places = places

    # Told to stop

    def stop(self, batch: Sequence[StopServer]) -> list[StopServer]:
        """Let servers go: tasks, names, places, timers, clusters, then their records. What should come again."""
        wanted = list(dict.fromkeys(batch))  # a message may be in a batch twice
        going, again = each(self._platform, wanted, self._end_task, "a server is not stopped yet")
        self._remove_names(one.stored for _, one in going)
        freed, stuck = self._give_back(going)
        _, failed = each(self._platform, freed, lambda one: self._finish(one[1]), "a server is not closed yet", _name)
        return again + stuck + [message for message, _ in failed]

    def _end_task(self, message: StopServer) -> Going | None:
        """Stop the task that a message speaks of; the server, or None if there is nothing to stop."""
        stored = self._to_stop(message)
        if stored is None:
            return None
        record = stored.server
        task = record.task or self._platform.tasks.find(record.name, record.cluster)
        if task:
            self._platform.tasks.stop(task, record.cluster, f"{messages.OUR_STOP} {message.reason}")
        return Going(stored, Reason.DEADLINE if message.reason == Reason.DEADLINE else Reason.STOPPED)

    def _to_stop(self, message: StopServer) -> Stored | None:
        """The record of the server to stop; None if it is closed. Leaves a tombstone where there never was one."""
        stored = self._ledger.server(ids.server_label(message.project_id, message.user_id))
        if stored is None:
            if message.reason == Reason.STOPPED:
                try:
                    self._ledger.create(server.tombstone(message.project_id, message.user_id, 1, self._platform.now()))
                except Conflict:
                    raise Later("started at this very moment") from None
            return None
        return stored if stored.server.is_open(message.attempt or stored.server.attempt) else None

    def _finish(self, going: Going) -> None:
        record = going.stored.server
        if going.reason is not Reason.DEADLINE:  # the timer that brought this message has deleted itself
            self._platform.timers.cancel(record.name)
        if record.own_cluster:
            self._platform.tasks.delete_cluster(record.cluster)
        try:
            self._ledger.save(server.close(record, going.reason, self._platform.now()), going.stored.etag)
        except Conflict:
            if (present := self._ledger.server(record.label)) and not present.server.is_open(record.attempt):
                return  # another stop was faster
            raise Later("the record changed while its server was stopped") from None
        logger.info("server closed", extra={"server": record.name, "reason": going.reason})

    # Gone by themselves

    def stopped(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """Tasks are gone. Clean up after those that we did not stop ourselves, and replace those that were lost."""
        gone, again = each(
            self._platform, events, self._gone, "a stopped task is not dealt with yet", lambda event: event.name
        )
        self._remove_names(one.stored for _, one in gone)
        freed, stuck = self._give_back(gone)
        _, failed = each(
            self._platform, freed, lambda one: self._clear(one[1]), "a lost server is not closed yet", _name
        )
        return again + stuck + [event for event, _ in failed]

    def lost(self, stored: Stored, reason: Reason) -> None:
        """Clean up after a server whose task is gone or never was; ask for the next attempt if there should be one."""
        going = Going(stored, reason)
        self._remove_names([stored])
        _, stuck = self._give_back([(None, going)])
        if stuck:
            raise Later("the server's place is not given back yet")
        self._clear(going)

    def _gone(self, event: TaskChanged) -> Going | None:
        if event.stopped_reason.startswith(messages.OUR_STOP):
            return None  # `stop` does the rest
        label, attempt = ids.parse_server_name(event.name) or ("", 0)
        stored = self._ledger.server(label)
        if stored is None or stored.server.attempt != attempt:
            return None
        return Going(stored, server.why(TaskStopped(event.stop_code, event.exit_code)))

    def _remove_names(self, going: Iterable[Stored]) -> None:
        names = [s.server.record for s in going if s.server.record and not s.server.is_closed]
        if names:
            self._platform.names.change(remove=names)

    def _give_back(self, going: Sequence[tuple[I, Going]]) -> tuple[list[tuple[I, Going]], list[I]]:
        """Give back the places of those that hold one, with one write per project.

        Those that may be closed now, and what should come again because its project's places could not be written.
        """
        projects: dict[str, list[Leaving]] = {}
        for _, (stored, reason) in going:
            if stored.server.counted and not stored.server.is_closed:
                projects.setdefault(stored.server.project_id, []).append(Leaving(stored.server, reason))
        _, failed = each(
            self._platform,
            projects,
            lambda project: self._places.give_back(project, projects[project]),
            "places are not given back yet",
        )
        freed = [one for one in going if one[1].stored.server.project_id not in failed]
        return freed, [item for item, one in going if one.stored.server.project_id in failed]

    def _clear(self, going: Going) -> None:
        """All that is left of it, then its record, then the next attempt where the reason calls for one."""
        record = going.stored.server
        if record.is_closed:  # what follows may have been cut off
            self._replace(record)
            return
        self._platform.timers.cancel(record.name)
        if record.own_cluster:
            self._platform.tasks.delete_cluster(record.cluster)
        now = self._platform.now()
        closed = self._ledger.update(
            going.stored, lambda r: server.close(r, going.reason, now) if r.is_open(record.attempt) else None
        )
        logger.info("server closed", extra={"server": record.name, "reason": going.reason})
        self._replace(closed.server if closed else record)

    def _replace(self, closed: Server) -> None:
        """Ask for the next attempt, unless the participant has played all there is to play."""
        following = server.next_attempt(closed)
        if following is None or self._has_played(closed):
            return
        self._platform.bus.publish(Topic.START, to_message(StartServer(closed.project_id, closed.user_id, following)))

    def _has_played(self, closed: Server) -> bool:
        """A server may be lost between the last answer it wrote and its stop: nobody needs another one then."""
        project = self._library.live_project(closed.project_id)
        if project is None or not project.game_steps:
            return False
        progress = self._ledger.progress(closed.project_id, closed.user_id)
        return all(step in progress.answered for step in project.game_steps)


def _name(one: tuple[object, Going]) -> str:
    return one[1].stored.server.name
