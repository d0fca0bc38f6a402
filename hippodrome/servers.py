"""Starting, naming and stopping servers: what `start_server`, `task_changed` and `stop_server` do.

Every function here may be interrupted anywhere and run again with the same messages: the record is written before what
it speaks for is made, and closed after what it owned is gone.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TypeVar

from hippodrome import ids, messages, server
from hippodrome.ledger import Later, Ledger, Stored
from hippodrome.library import Library
from hippodrome.log import failure, logger
from hippodrome.messages import Named, NamesChanged, StartServer, StopServer, TaskChanged, to_message
from hippodrome.platform import Address, Conflict, NameRecord, NoCapacity, Platform, Refused, TaskRequest, Topic
from hippodrome.project import Project
from hippodrome.server import Reason, Server, State, TaskStopped

FIRST_LOOK = 15  # seconds until we ask whether a name has reached every name server; it is seldom sooner
LOOK_AGAIN = 10  # seconds until we ask once more
MOST_LOOKS = 60  # ten minutes of asking
T = TypeVar("T")
MOST_KEPT = 1000  # records remembered between a server's naming and its being ready


class Servers:
    """What the three functions share. One per running function."""

    def __init__(self, platform: Platform) -> None:
        self._platform = platform
        self._library = Library(platform)
        self._ledger = Ledger(platform.documents)
        self._written: dict[str, Stored] = {}  # of servers that wait for their names

    # Start

    def start(self, message: StartServer) -> None:
        """Run the server that a start message asks for, once, however often the message comes."""
        project = self._library.live_project(message.project_id)
        if project is None:
            logger.warning("start for a project that is not live: dropped")
            return
        stored = self._claim(project, message)
        if stored is None:
            return
        record = stored.server
        # The shutdown comes first: whatever happens from here on, nothing outlives its deadline.
        stop = StopServer(record.project_id, record.user_id, record.attempt, Reason.DEADLINE)
        self._platform.timers.set(record.name, record.deadline, to_message(stop))
        try:
            if record.own_cluster:
                self._platform.tasks.create_cluster(record.cluster)
            self._run(project, stored)
        except (NoCapacity, Refused) as error:
            logger.error("the server cannot run", extra={"server": record.name, "why": type(error).__name__})
            self._give_up(stored, Reason.REFUSED if isinstance(error, Refused) else Reason.NO_CAPACITY)
            return
        logger.info("server starting", extra={"server": record.name})

    def _claim(self, project: Project, message: StartServer) -> Stored | None:
        """The record of the attempt to start; None if there is nothing to start (any more)."""
        now = self._platform.now()
        token = secrets.token_urlsafe(24)
        settings = self._platform.settings
        wanted = server.claim(project, message.user_id, message.attempt, token=token, settings=settings, now=now)
        try:
            return self._ledger.create(wanted) if message.attempt == 1 else self._claim_next(wanted)
        except Conflict:
            stored = self._ledger.server(wanted.label)
        unfinished = stored and _alive(stored.server, message.attempt) and stored.server.state is State.STARTING
        return stored if unfinished else None

    def _claim_next(self, wanted: Server) -> Stored | None:
        """Put a further attempt in the place of the closed one before it. Raises `Conflict` if there is no such one."""
        before = self._ledger.server(wanted.label)
        if before is None or before.server.attempt != wanted.attempt - 1 or not before.server.is_closed:
            raise Conflict
        return self._ledger.save(server.after(before.server, wanted), before.etag)

    def _run(self, project: Project, stored: Stored) -> None:
        """RunTask on Spot, or on demand where Spot has no room.

        The task's id is not recorded here: by its name a repetition finds the same task, and the event that says it
        runs brings the id. A task that starts for a server closed meanwhile is stopped when that event comes.
        """
        record = stored.server
        request = TaskRequest(
            name=record.name,
            definition=project.task_definition or self._platform.settings.task_definition,
            cluster=record.cluster,
            cpu=project.size.cpu,
            memory=project.size.memory,
            environment=_environment(project, record, self._platform.settings.bucket),
            spot=record.spot,
        )
        try:
            self._platform.tasks.run(request)
        except NoCapacity:
            if not record.spot:
                raise
            logger.warning("no Spot capacity: on demand", extra={"server": record.name})
            if self._ledger.update(stored, lambda r: server.on_demand(r) if _alive(r, record.attempt) else None):
                self._platform.tasks.run(replace(request, spot=False))

    def _give_up(self, stored: Stored, reason: Reason) -> None:
        """Close a server that never ran."""
        record = stored.server
        if record.own_cluster:
            self._platform.tasks.delete_cluster(record.cluster)
        self._platform.timers.cancel(record.name)
        self._close(stored, reason)

    # Changes of tasks

    def tasks_changed(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """Deal with a batch of ECS events; those that should come again."""
        again = self._running([event for event in events if event.status == "RUNNING"])
        self._each([event for event in events if event.status == "STOPPED"], self._stopped, again)
        return again

    def _running(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """Give each running server its name: one look for the addresses and one DNS change for all of them."""
        again: list[TaskChanged] = []
        waiting = self._each(events, self._to_name, again)
        if not waiting:
            return again
        addresses = self._platform.tasks.addresses([event.interface for event, _ in waiting if event.interface])
        placed = {event: address for event, _ in waiting if (address := addresses.get(event.interface or ""))}
        again.extend(event for event, _ in waiting if event not in placed)
        stored = dict(waiting)
        named = self._each(placed, lambda event: self._name(stored[event], event, placed[event]), again)
        if named:
            change = self._platform.names.change(add=[r.record for _, r in named if r.record])
            self._in_sync(NamesChanged(change, [Named(r.label, r.attempt) for _, r in named]))
        return again

    def _each(
        self, events: Iterable[TaskChanged], act: Callable[[TaskChanged], T | None], again: list[TaskChanged]
    ) -> list[tuple[TaskChanged, T]]:
        """What `act` makes of each event, without the Nones; those for which it failed are added to `again`."""
        made = []
        for event in events:
            try:
                result = act(event)
            except Exception as error:  # noqa: BLE001 - one participant's trouble is not the others'
                failure("a change of a task is not dealt with yet", error, server=event.name)
                again.append(event)
            else:
                if result is not None:
                    made.append((event, result))
        return made

    def _to_name(self, event: TaskChanged) -> Stored | None:
        """The record of a task that runs and has no name yet. A task that nobody waits for is stopped."""
        label, attempt = ids.parse_server_name(event.name) or ("", 0)
        stored = self._ledger.server(label)
        if stored is None:
            return None  # not of this installation
        if not _alive(stored.server, attempt) or stored.server.task not in (None, event.task):
            self._platform.tasks.stop(event.task, event.cluster, f"{messages.OUR_STOP} nobody waits for it")
            return None
        return stored if stored.server.state in (State.STARTING, State.NAMING) else None

    def _name(self, stored: Stored, event: TaskChanged, address: Address) -> Server | None:
        """Write down the name before it is made. None if the server was closed meanwhile."""
        attempt, now = stored.server.attempt, self._platform.now()
        after = self._ledger.update(
            stored, lambda r: server.naming(r, event.task, address, now) if _alive(r, attempt) else None
        )
        if after is None:
            return None
        if len(self._written) >= MOST_KEPT:
            self._written.clear()
        self._written[after.server.label] = after
        return after.server

    def names_changed(self, message: NamesChanged) -> None:
        """The follow-up of a DNS change: are the names known everywhere?"""
        if self._platform.names.in_sync(message.change):
            self._ready(message.servers)
        elif message.looked < MOST_LOOKS:
            self._look_later(message)
        else:
            logger.error("names do not get in sync", extra={"servers": len(message.servers)})

    def _in_sync(self, message: NamesChanged) -> None:
        """After a change: an empty id says that it is in sync already."""
        if message.change:
            self._look_later(message)
        else:
            self._ready(message.servers)

    def _look_later(self, message: NamesChanged) -> None:
        again = NamesChanged(message.change, message.servers, message.looked + 1)
        self._platform.bus.later(to_message(again), LOOK_AGAIN if message.looked else FIRST_LOOK)

    def _ready(self, servers: Sequence[Named]) -> None:
        """Hand out the addresses; a server closed meanwhile loses the name that was just made."""
        late: list[NameRecord] = []
        for named in servers:
            if self._is_ready(named):
                logger.info("server ready", extra={"server": ids.server_name(named.label, named.attempt)})
            elif (closed := self._ledger.server(named.label)) and closed.server.attempt == named.attempt:
                late += [closed.server.record] if closed.server.is_closed and closed.server.record else []
        if late:
            self._platform.names.change(remove=late)

    def _is_ready(self, named: Named) -> bool:
        """Write `ready` if the server still waits for its name. The version we wrote last is tried first, unread."""
        now = self._platform.now()
        stored = self._written.pop(named.label, None) or self._ledger.server(named.label)
        return bool(
            self._ledger.update(
                stored,
                lambda r: server.ready(r, now) if _alive(r, named.attempt) and r.state is State.NAMING else None,
            )
        )

    def _stopped(self, event: TaskChanged) -> None:
        """A task is gone. Unless we stopped it ourselves, clean up after it, and replace it if it was lost."""
        if event.stopped_reason.startswith(messages.OUR_STOP):
            return  # stop_server does the rest
        label, attempt = ids.parse_server_name(event.name) or ("", 0)
        stored = self._ledger.server(label)
        if stored is None or stored.server.attempt != attempt:
            return
        self.lost(stored, server.why(TaskStopped(event.stop_code, event.exit_code)))

    def lost(self, stored: Stored, reason: Reason) -> None:
        """Clean up after a server whose task is gone, and ask for the next attempt if there should be one."""
        record = stored.server
        if not record.is_closed:
            self._platform.timers.cancel(record.name)
            if record.record:
                self._platform.names.change(remove=[record.record])
            if record.own_cluster:
                self._platform.tasks.delete_cluster(record.cluster)
        self._close(stored, reason)

    def _close(self, stored: Stored, reason: Reason) -> None:
        """Write `closed`, and ask for the next attempt where the reason calls for one (again, if that was cut off)."""
        attempt, now = stored.server.attempt, self._platform.now()
        closed = stored
        if not stored.server.is_closed:
            closed = (
                self._ledger.update(stored, lambda r: server.close(r, reason, now) if _alive(r, attempt) else None)
                or stored
            )
            logger.info("server closed", extra={"server": stored.server.name, "reason": reason})
        following = server.next_attempt(closed.server)
        if following is not None:
            record = closed.server
            self._platform.bus.publish(
                Topic.START, to_message(StartServer(record.project_id, record.user_id, following))
            )

    # Stop

    def stop(self, batch: Sequence[StopServer]) -> list[StopServer]:
        """Let servers go: their tasks, names, timers and clusters, then their records. Those that should come again."""
        again: list[StopServer] = []
        going: list[tuple[StopServer, Stored]] = []
        for message in dict.fromkeys(batch):  # a message may be in a batch twice
            try:
                stored = self._to_stop(message)
                if stored is not None:
                    self._end_task(stored.server, message.reason)
                    going.append((message, stored))
            except Exception as error:  # noqa: BLE001 - one participant's trouble is not the others'
                failure("a server is not stopped yet", error)
                again.append(message)
        names = [stored.server.record for _, stored in going if stored.server.record]
        if names:
            self._platform.names.change(remove=names)
        for message, stored in going:
            try:
                self._finish(stored, message)
            except Exception as error:  # noqa: BLE001
                failure("a server is not closed yet", error, server=stored.server.name)
                again.append(message)
        return again

    def _to_stop(self, message: StopServer) -> Stored | None:
        """The record of the server to stop; None if it is closed. Leaves a tombstone where there never was one."""
        label = ids.server_label(message.project_id, message.user_id)
        stored = self._ledger.server(label)
        if stored is None:
            if message.reason == Reason.STOPPED:
                try:
                    self._ledger.create(server.tombstone(message.project_id, message.user_id, 1, self._platform.now()))
                except Conflict:
                    raise Later("started at this very moment") from None
            return None
        wanted = message.attempt or stored.server.attempt
        return stored if _alive(stored.server, wanted) else None

    def _end_task(self, record: Server, reason: str) -> None:
        task = record.task or self._platform.tasks.find(record.name, record.cluster)
        if task:
            self._platform.tasks.stop(task, record.cluster, f"{messages.OUR_STOP} {reason}")

    def _finish(self, stored: Stored, message: StopServer) -> None:
        record = stored.server
        if message.reason != Reason.DEADLINE:  # the timer that brought this message has deleted itself
            self._platform.timers.cancel(record.name)
        if record.own_cluster:
            self._platform.tasks.delete_cluster(record.cluster)
        reason = Reason.DEADLINE if message.reason == Reason.DEADLINE else Reason.STOPPED
        try:
            self._ledger.save(server.close(record, reason, self._platform.now()), stored.etag)
        except Conflict:
            if (present := self._ledger.server(record.label)) and not _alive(present.server, record.attempt):
                return  # another stop was faster
            raise Later("the record changed while its server was stopped") from None
        logger.info("server closed", extra={"server": record.name, "reason": reason})


def _alive(record: Server, attempt: int) -> bool:
    """Whether this very attempt is still open."""
    return record.attempt == attempt and not record.is_closed


def _environment(project: Project, record: Server, bucket: str) -> dict[str, str]:
    """What a trial server is told; see `trial/settings.py` for the meanings. `GROUP` is for the researcher's agent."""
    ssl = project.ssl
    return {
        "PROJECT_ID": record.project_id,
        "USER_ID": record.user_id,
        "SERVER": record.name,
        "TOKEN": record.token,
        "GROUP": "" if (group := project.group(record.user_id)) is None else str(group),
        "GAME_STEPS": ",".join(project.game_steps),
        "DEADLINE": str(int(record.deadline.timestamp())),
        "TRIAL": json.dumps(project.trial, separators=(",", ":")),
        "SSL_BUCKET": (ssl and ssl.ssl_bucket) or bucket,
        "SSL_FULLCHAIN": (ssl and ssl.fullchain) or "SSL/fullchain.pem",
        "SSL_PRIVKEY": (ssl and ssl.privkey) or "SSL/privkey.pem",
    }
