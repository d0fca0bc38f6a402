"""Erases one participant from one project: first their server, then their documents; a last look proves it.

Several participants play on their session's server. It is stopped like a server of the participant's own; the other
members' data stay (`session_eraser.py`).

If the participant played on a warm server, its handover document names them, and its record has their label. The
participant's record leads to both, so it is deleted last.

The documents (every version, delete marker and unfinished upload) are deleted only after the server's task has ended,
since a trial that is told to stop still stores recordings. The server's presigned requests
(`hippodrome/control/servers/signing.py`) stay valid for a short time after its end, and the eraser waits until then. If
the participant or the server has stored something meanwhile, the next look finds it and the next round erases it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from typing import TYPE_CHECKING

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.control.model import ids, server
from hippodrome.control.model.messages import StopServer
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import Reason, Server
from hippodrome.control.ports import DnsRecord, RunningTask
from hippodrome.control.servers import resources
from hippodrome.control.servers.leftovers import Scope, leftovers
from hippodrome.control.servers.resources import Resources
from hippodrome.deployment.aws.account import Account, Installation
from hippodrome.deployment.aws.object_version import Version
from hippodrome.deployment.aws.versions import VersionedBucket
from hippodrome.deployment.core.captured_log import functions_log
from hippodrome.deployment.core.leftover_steps import cluster_steps, removal_steps
from hippodrome.deployment.core.server_records import keys_of_warm_servers, warm_servers_of
from hippodrome.deployment.core.stages import Executor, PlanStep, step
from hippodrome.deployment.operate.cells_eraser import CellsEraser
from hippodrome.deployment.operate.lobby_eraser import LobbyEraser
from hippodrome.deployment.operate.receipt import ProjectReceipt
from hippodrome.deployment.operate.session_eraser import FoundSession, SessionEraser
from hippodrome.protocol.keys import participant_folder

if TYPE_CHECKING:
    from hippodrome.control.limits.slots import Slots

ROUNDS = 6  # rounds of erasing and looking again, at most
WAIT = 240  # seconds until a task must have ended: its stopTimeout is 120, and AWS needs some more
SETTLED = timedelta(seconds=60)  # from this age of a server on, ECS lists its task if it has one
SIGNING = 30  # seconds that `sign_requests` may take from reading a server's record to signing


@dataclass
class FoundOfParticipant:
    """The results of one look for a participant in one project."""

    documents: int = 0  # versions, delete markers and unfinished uploads
    record: Server | None = None
    resources: Resources = field(default_factory=Resources)
    draining: list[RunningTask] = field(default_factory=list)  # tasks that are stopping
    slots: int = 0  # documents of slots that name the participant (`maxParticipants`)
    sessions: list[FoundSession] = field(default_factory=list)  # the participant's sessions
    of_sessions: list[Server] = field(default_factory=list)  # the records of these sessions' servers

    def __bool__(self) -> bool:
        return any(self.counts().values())

    @property
    def runs(self) -> bool:
        """Whether a server runs, or resources of one are left."""
        return bool(self.resources or self.draining or any(not record.is_closed for record in self.records))

    @property
    def records(self) -> list[Server]:
        """The record of the participant's own server, and the records of their sessions' servers."""
        return [*([self.record] if self.record else []), *self.of_sessions]

    def counts(self) -> dict[str, int]:
        """Return how many documents and resources were found, by kind."""
        counts = {"documents": self.documents, **self.resources.counts(), "slots": self.slots}
        counts["tasks"] += len(self.draining)
        if self.sessions:
            counts["sessions"] = len(self.sessions)
        return counts


class Eraser:
    """Erases one participant from one project. May be interrupted anywhere and run again.

    With `late=False` it does not wait until presigned requests are invalid; this is for bots, whose servers have ended.
    """

    def __init__(
        self,
        account: Account,
        installation: Installation,
        project: str,
        user: str,
        *,
        late: bool = True,
        executor: Executor | None = None,
    ) -> None:
        self.project = project
        self.receipt = ProjectReceipt(project, user)
        self._user = user
        self._account = account
        self._bucket = VersionedBucket(account, installation["Bucket"])
        self._installation = installation
        self._platform = account.platform(installation)
        self._late = late
        self._executor = executor or Executor()
        self._label = ids.server_label(project, user)
        self._folder = participant_folder(project, user)
        self._record_key = server.key(self._label)
        self._scope = Scope(labels=frozenset({self._label}))
        self._warm_servers = frozenset[str]()  # names of warm servers that were assigned to the participant
        self._sessions = SessionEraser(self._bucket, project, user)
        self._lobby = LobbyEraser(self._bucket, project, user)
        self._cells = CellsEraser(self._bucket, project, user)

    def run(self, advance: Callable[[int], None] = lambda _: None) -> FoundOfParticipant:
        """Erase until a look finds nothing, in `ROUNDS` rounds at most. Return what the last look found.

        Raises `Problem` if a server does not end.
        """
        return self._executor.converge(self.look, lambda state: self.plan(state, advance), rounds=ROUNDS, pause=0)

    def look(self) -> FoundOfParticipant:
        """Find everything about this participant. Changes nothing."""
        record = self._record(self._record_key)
        sessions = self._sessions.sessions()
        labels = {session.id: ids.server_label(self.project, session.id) for session in sessions}
        of_sessions = [of_session for label in labels.values() if (of_session := self._record(server.key(label)))]
        self._warm_servers = self._warm_servers.union(warm_servers_of(record))
        names = self._warm_servers.union(*map(warm_servers_of, of_sessions))
        self._scope = Scope(labels=frozenset({self._label, *labels.values()}), names=names)
        left = leftovers(resources.list_resources(self._platform), {}, self._scope)
        own_name = record.dns_record if record else None
        if own_name and own_name not in left.dns_records and self._is_in_zone(own_name):
            left.dns_records.append(own_name)
        participant_data = FoundOfParticipant(
            documents=sum(1 for _ in itertools.chain(self._lobby.look(), self._cells.look(), *self._documents())),
            record=record,
            resources=left,
            draining=self._draining(left.clusters),
            slots=len(self._slots().documents_naming(self.project, self._user)),
            sessions=sessions,
            of_sessions=of_sessions,
        )
        self.receipt.remains, self.receipt.looked = participant_data.counts(), self._platform.now()
        return participant_data

    def plan(
        self, participant_data: FoundOfParticipant, advance: Callable[[int], None] = lambda _: None
    ) -> list[PlanStep]:
        """Plan one round's steps: server, documents, and last the slot, so that no newcomer takes it too early."""
        steps: list[PlanStep] = [step(self._begin_round)]
        if participant_data.runs:
            steps += [
                step(self._stop, participant_data),
                *removal_steps(self._platform, participant_data.resources),
                step(self._wait),
            ]
            steps += cluster_steps(self._platform, participant_data.resources)
        if not participant_data.resources.tasks and any(map(self._settling, participant_data.records)):
            steps += [step(self._settle), step(self._wait)]
        if self._late and participant_data.of_sessions:
            steps.append(step(self._outlast_sessions, participant_data.sessions))
        steps += [step(self._leave_session, session, advance) for session in participant_data.sessions]
        steps += [step(self._leave_lobby, advance), step(self._delete, advance)]
        if participant_data.slots:
            steps.append(step(self._slots().release_participant, self.project, self._user))
        if self._late and participant_data.record:
            steps.append(step(self._outlast, participant_data.record))
        return steps

    def unreadable(self) -> list[str]:
        """Return the keys of documents that may name this participant, but cannot be read."""
        return [
            *self._slots().unreadable(self.project),
            *self._sessions.unreadable,
            *self._lobby.unreadable,
            *self._cells.unreadable,
        ]

    # -- looking

    def _slots(self) -> Slots:
        from hippodrome.control.limits.slots import Slots  # noqa: PLC0415 - imports Powertools, which other commands do without

        return Slots(self._platform)

    def _tasks(self) -> tuple[list[RunningTask], list[RunningTask]]:
        """Return two lists of tasks of the participant and their sessions: running tasks, and stopping tasks."""
        tasks = [task for task in self._platform.tasks.list() if self._scope.erases(task.name)]
        return tasks, self._draining([name for name in self._platform.tasks.clusters() if self._scope.erases(name)])

    def _draining(self, clusters: Sequence[str]) -> list[RunningTask]:
        tasks = self._platform.tasks.draining(self._installation["Cluster"], *clusters)
        return [task for task in tasks if self._scope.erases(task.name)]

    def _record(self, key: str) -> Server | None:
        document = self._platform.documents.get(key)
        try:
            return from_json(document.body, Server) if document else None
        except ValueError:  # no record; the document is deleted like any other
            return None

    def _is_in_zone(self, record: DnsRecord) -> bool:
        """Whether the zone has this record. Listings of servers lack the names that `subdomain: userId` makes."""
        answer = self._account.client("route53").list_resource_record_sets(
            HostedZoneId=self._installation["HostedZoneId"],
            StartRecordName=record.name,
            StartRecordType="A",
            MaxItems="1",
        )
        return any(
            found["Type"] == "A"
            and found["Name"].rstrip(".").lower() == record.name.lower()
            and [value["Value"] for value in found.get("ResourceRecords", ())] == [record.host]
            for found in answer["ResourceRecordSets"]
        )

    def _documents(self) -> tuple[Iterator[Version], ...]:
        """Return every version of the participant's own documents, in the order in which they must be deleted.

        The record leads to the documents of warm servers, so it comes last.
        """
        of_warm_servers = itertools.chain.from_iterable(map(self._bucket.versions_of, self._warm_server_keys()))
        return (
            self._bucket.versions(self._folder),
            self._bucket.uploads(self._folder),
            of_warm_servers,
            self._bucket.versions_of(self._record_key),
        )

    def _warm_server_keys(self) -> list[str]:
        """Return the keys of the handover documents and records of the participant's warm servers."""
        return keys_of_warm_servers(self.project, self._warm_servers)

    # -- steps

    def _begin_round(self) -> None:
        self.receipt.rounds += 1

    def _stop(self, participant_data: FoundOfParticipant) -> None:
        """Count the resources for the receipt, and stop the servers as `stop_server` does."""
        from hippodrome.control.servers.services import ServerServices  # noqa: PLC0415 - imports Powertools, which other commands do without
        from hippodrome.control.servers.termination import Termination  # noqa: PLC0415 - the same

        for kind, number in participant_data.resources.counts().items():
            self.receipt.removed[kind] += number
        stops = [
            StopServer(self.project, record.user_id, None, Reason.STOPPED)
            for record in participant_data.records
            if not record.is_closed
        ]
        if stops:
            with functions_log():  # the following steps do again what fails here
                Termination(ServerServices(self._platform)).stop(stops)

    def _wait(self) -> None:
        """Stop tasks that appear, and wait until none is left. Raises `Problem` if one runs after `WAIT` seconds."""

        def left() -> list[RunningTask]:
            tasks, draining = self._tasks()
            self._executor.execute(removal_steps(self._platform, Resources(tasks=tasks)))
            return tasks + draining

        if self._executor.wait(left, WAIT):
            raise Problem(
                "Their server has been told to stop and still runs; their documents were not touched.",
                "Wait a few minutes and run the same command again: it goes on from there.",
            )

    def _settling(self, record: Server) -> bool:
        """Whether a task may have been started so recently that ECS does not list it yet."""
        is_young = self._platform.now() - record.requested < SETTLED
        return is_young and record.task is None and bool(record.cluster)

    def _settle(self) -> None:
        """Wait until ECS lists the task. If it has not after `SETTLED`, there is none."""
        self._executor.wait(lambda: not self._tasks()[0], SETTLED.total_seconds())

    def _leave_session(self, session: FoundSession, advance: Callable[[int], None]) -> None:
        """Take the participant out of a session. If its server runs again, finish in the next round, which stops it."""
        note = self._noting(advance)
        key = server.key(ids.server_label(self.project, session.id))
        if not session.others:
            record = self._record(key)
            if record is None or record.is_closed:
                for keys_of_warm_server in (*keys_of_warm_servers(self.project, warm_servers_of(record)), key):
                    self._bucket.delete(self._bucket.versions_of(keys_of_warm_server), note)
                self._sessions.delete_session(session, note)
            return
        self._sessions.take_out(session, note)
        self.receipt.rewritten = self._sessions.rewritten
        record = self._record(key)
        if record is None or record.is_closed:
            self._sessions.take_name(session, note)

    def _leave_lobby(self, advance: Callable[[int], None]) -> None:
        self._lobby.erase(self._noting(advance))
        self._cells.erase(self._noting(advance))

    def _noting(self, advance: Callable[[int], None]) -> Callable[[Sequence[Version]], None]:
        def note(versions: Sequence[Version]) -> None:
            self.receipt.note(versions)
            advance(len(versions))

        return note

    def _delete(self, advance: Callable[[int], None]) -> None:
        for versions in self._documents():
            self._bucket.delete(versions, self._noting(advance))

    def _outlast(self, record: Server) -> None:
        """Wait until all presigned requests of the server are invalid. It gets no new ones: its record is deleted."""
        from hippodrome.control.servers.signing import STORE_AFTER_CLOSE, VALID_SECONDS  # noqa: PLC0415 - as above

        # A server gets presigned requests until STORE_AFTER_CLOSE after its end. If that is over, the wait is shorter.
        signed = STORE_AFTER_CLOSE.total_seconds()
        if record.closed is not None:
            signed -= (self._platform.now() - record.closed).total_seconds()
        self._sleep(VALID_SECONDS + SIGNING + min(signed, 0))

    def _outlast_sessions(self, sessions: Sequence[FoundSession]) -> None:
        """Wait until the sessions' servers get no presigned requests any more, and all earlier ones are invalid."""
        from hippodrome.control.servers.signing import STORE_AFTER_CLOSE, VALID_SECONDS  # noqa: PLC0415 - as above

        records = (self._record(server.key(ids.server_label(self.project, session.id))) for session in sessions)
        ends = [record.closed for record in records if record is not None and record.closed is not None]
        if ends:
            over = (self._platform.now() - max(ends)).total_seconds()
            self._sleep(STORE_AFTER_CLOSE.total_seconds() + VALID_SECONDS + SIGNING - over)

    def _sleep(self, seconds: float) -> None:
        if seconds > 0:
            screen.info(f"{seconds:.0f} seconds more: until then a presigned request of the server might be used.")
            self._executor.sleep(seconds)
