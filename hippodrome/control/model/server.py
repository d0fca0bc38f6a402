"""The record of a server, and the transitions of its state. Pure: no clock, no I/O.

States: (no record: queued) → starting → naming → ready → closed. The server's resources are removed before `closed` is
written: if a function fails before that, it is run again. Two are removed later: the timer, and the own cluster of a
server that ended by itself (`servers/termination.py`).

A *warm server* is started ahead of its participant (`warmServers`), under a warm id. When it is ready, it is either
assigned to a participant, whose record then owns its resources (the warm server's own record is closed with the reason
`assigned`), or it is drained (`draining`) and can no longer be assigned. One compare-and-swap decides between the two.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from enum import StrEnum
from typing import NamedTuple, TypeVar

import msgspec

from hippodrome.control.model import ids, sessions, warm_pool
from hippodrome.control.model.project import DEFAULT_PORT, Project
from hippodrome.control.model.records import Record
from hippodrome.control.ports import Address, Dns, DnsRecord, Settings
from hippodrome.protocol.session import is_session_id

RECORDS = "_servers/"  # the folder of all servers' records
SPOT_ATTEMPTS = 2  # the attempts up to this one run on Spot, later ones on demand
AUTOMATIC_ATTEMPTS = SPOT_ATTEMPTS + 1  # up to this attempt, which is on demand, no participant has to ask
MAX_ATTEMPTS = 8  # up to this attempt, a participant may request another server

R = TypeVar("R")


class ServerState(StrEnum):
    """The state of a server, as its record has it."""

    QUEUED = "queued"  # never stored: there is no record yet
    STARTING = "starting"
    NAMING = "naming"
    READY = "ready"
    DRAINING = "draining"  # a warm server that can no longer be assigned
    CLOSED = "closed"


class Reason(StrEnum):
    """Why a server was closed."""

    STOPPED = "stopped"  # the study's stop step, a relay, an administrator
    DEADLINE = "deadline"  # its deadline, which follows from maxRuntime, was over
    ENDED = "ended"  # the trial ended by itself: it was complete, or no participant came
    LOST = "lost"  # a Spot interruption, a failed machine, or it never became healthy
    REFUSED = "refused"  # AWS refuses to run it as it is configured
    NO_CAPACITY = "no capacity"
    FULL = "full"  # the project's limits left no slot: it was never started
    ASSIGNED = "assigned"  # a warm server whose resources a participant's record owns now


CANNOT_START = ("cannot begin", "ended at once", "never ready", "no port", "no certificate")
"""The causes (`servers.causes.Cause`) of a server on which the game cannot even begin. After two such servers, no
further one is started without a request: it would fail in the same way."""
FAILED = (Reason.LOST, Reason.REFUSED, Reason.NO_CAPACITY)  # the reasons that leave no hope for the game
REPLACED = (Reason.LOST, Reason.NO_CAPACITY)  # the reasons after which the next attempt is started automatically


class PastAttempt(Record, frozen=True):
    """An earlier attempt, kept in the record of the present one; `hippodrome cost` counts it.

    Its fields are fields of `Server`.
    """

    attempt: int
    requested: datetime
    running: datetime | None = None
    closed: datetime | None = None
    cpu: float = 0
    memory: float = 0
    spot: bool = True
    reason: Reason | None = None
    cause: str = ""
    warm_server_name: str | None = None
    nonce: str = ""
    game_steps: tuple[str, ...] = ()
    read_steps: tuple[str, ...] = ()


class Server(Record, frozen=True):
    """`_servers/{label}.json`: the server of a participant or a session, with its present and its earlier attempts.

    `user_id` is the id of the participant, of the session, or of the warm server.
    """

    project_id: str
    user_id: str
    attempt: int
    state: ServerState
    requested: datetime
    deadline: datetime
    cluster: str
    dns: str = ""  # its full DNS name; "": browsers connect to its address, for which it has a certificate of its own
    spot: bool = True
    task: str | None = None  # the task's id, once the task runs
    host: str | None = None  # the address in its DNS record, exactly as in the zone
    port: int = DEFAULT_PORT  # the port on which it is to listen; once its task runs, the port on which it listens
    running: datetime | None = None
    ready: datetime | None = None
    closed: datetime | None = None
    reason: Reason | None = None
    cause: str = ""  # why it failed, if it did (`servers.causes.Cause`)
    cpu: float = 0  # vCPU
    memory: float = 0  # GB
    earlier: tuple[PastAttempt, ...] = ()  # oldest first
    counted: bool = False  # whether it holds one of its project's slots until it is closed
    warm_server_name: str | None = None  # the name of its assigned warm server
    assigned_to: str | None = None
    """For a warm server: the label of the record that owns its resources now."""
    nonce: str = ""  # its token and credential are derived from it (`secret.py`); not secret
    game_steps: tuple[str, ...] = ()  # the steps whose answers it may store: the project's when it was started
    read_steps: tuple[str, ...] = ()  # the steps whose answers its agent may read: the project's when it was started
    may_match: bool = False  # with `matching: match`: whether it answers questions to `match` while it has no members
    players: int = 0  # how many players a session's trial is for; 0 if it is no session's

    @property
    def label(self) -> str:
        return ids.server_label(self.project_id, self.user_id)

    @property
    def name(self) -> str:
        """The name of all its resources: in ECS, in DNS and in the Scheduler."""
        return self.warm_server_name or ids.server_name(self.label, self.attempt)

    @property
    def is_warm_server(self) -> bool:
        """Whether it was started as a warm server, without a participant."""
        return ids.is_warm_id(self.user_id)

    @property
    def is_of_session(self) -> bool:
        """Whether it is the server of a session, on which several participants play."""
        return is_session_id(self.user_id)

    @property
    def warm_server_label(self) -> str:
        """The label of the warm server that was assigned to it; "" if none was."""
        return (ids.parse_server_name(self.warm_server_name or "") or ("", 0))[0]

    @property
    def is_closed(self) -> bool:
        return self.state is ServerState.CLOSED

    def lacks(self, step_key: str) -> bool:
        """Return whether this server may not store the answer to this game step, which was registered after it started.

        The result is False for a session's server, on which others play.
        """
        return not self.is_of_session and step_key not in self.game_steps

    def is_open(self, attempt: int) -> bool:
        """Return whether the record is at this attempt and not closed."""
        return self.attempt == attempt and not self.is_closed

    def owns(self, name: str) -> bool:
        """Return whether this record is open and owns the resources of this name.

        If a warm server was assigned, the record owns the resources of the warm server's name.
        """
        return self.name == name and not self.is_closed

    @property
    def dns_record(self) -> DnsRecord | None:
        """The DNS record that it owns, with exactly the stored values; None if it has no address or no name."""
        return DnsRecord(self.dns, self.host) if self.dns and self.host else None

    def browser_host(self, dns: Dns) -> str | None:
        """Return the host that browsers connect to: by its name, or its address if it has no name; None if neither."""
        return dns.browser_host(self.dns_record) if self.dns_record else self.host

    @property
    def has_default_name(self) -> bool:
        """Whether its DNS name begins with its own name, not with a participant's id."""
        return ids.first_label(self.dns) == self.name

    @property
    def domain(self) -> str:
        """The domain directly above its DNS name. The server shows the certificate of that domain."""
        return self.dns.partition(".")[2]

    @property
    def has_own_cluster(self) -> bool:
        """Whether its cluster is its own and is deleted with it."""
        return self.cluster == self.name


class TaskStopped(NamedTuple):
    """The facts in an ECS event about a task that has ended."""

    code: str | None  # stopCode
    exit_code: int | None
    words: str = ""  # the reasons that ECS gives for the task and for its container


def owner(name: str, read: Callable[[str], R | None], server: Callable[[R], Server]) -> R | None:
    """Return the record that owns the resources of this name, following handovers; None if there is none.

    `read` returns the stored record under a label, and `server` the `Server` in it. The record may be at another
    attempt now: compare its `name`. `read` is called once; twice for an assigned warm server.
    """
    parsed = ids.parse_server_name(name)
    owner_id = read(parsed[0]) if parsed else None
    assigned_to = server(owner_id).assigned_to if owner_id is not None else None
    if assigned_to is None:
        return owner_id
    new_owner = read(assigned_to)
    return new_owner if new_owner is not None and server(new_owner).name == name else owner_id


def key(label: str) -> str:
    """Return the key of the record under this label. The names of the server's resources begin with the label, too."""
    return f"{RECORDS}{label}.json"


def new_attempt(
    project: Project, user_id: str, attempt: int, *, nonce: str = "", settings: Settings, now: datetime
) -> Server:
    """Return the record of a new attempt, to be written before anything is started.

    The server's DNS name is a hash below the servers' domain. With `subdomain: userId` the participant's id takes the
    place of the hash, if the installation allows it and the id is a valid DNS label. Ids come with the link, so the
    author of a link chooses that label, but no other part of the name. The deadline of a warm server bounds its
    waiting; once it is assigned, it gets the same time to play as other servers. A session's server gets, in addition,
    the time in which it may wait for its members (`sessions.lifetime`).
    """
    label = ids.server_label(project.id, user_id)
    name = ids.server_name(label, attempt)
    is_warm_server = ids.is_warm_id(user_id)
    by_id = project.subdomain == "userId" and settings.user_id_names
    first = user_id.lower() if by_id and not is_warm_server and ids.is_host_label(user_id.lower()) else name
    played = now + sessions.lifetime(project, settings)
    return Server(
        project_id=project.id,
        user_id=user_id,
        attempt=attempt,
        state=ServerState.STARTING,
        requested=now,
        deadline=warm_pool.deadline(project, settings, label, now) if is_warm_server else played,
        cluster=name if project.cluster == "participant" else settings.cluster,
        dns=f"{first}.{settings.servers_domain}" if settings.servers_domain else "",
        port=project.server_port,
        spot=attempt <= SPOT_ATTEMPTS,
        cpu=project.size.cpu,
        memory=project.size.memory,
        counted=project.limits_servers,
        nonce=nonce,
        game_steps=tuple(project.game_steps),
        read_steps=tuple(project.read_steps),
        may_match=is_session_id(user_id) and project.asks_match,
        players=project.players if is_session_id(user_id) else 0,
    )


def past_attempt(server: Server) -> PastAttempt:
    """Return what the record of the next attempt keeps of this attempt."""
    return PastAttempt(**{name: getattr(server, name) for name in PastAttempt.__struct_fields__})


def next_attempt(closed: Server) -> int | None:
    """Return the attempt that replaces a closed server without a request; None if none does, as for a warm server."""
    if closed.is_warm_server or not closed.is_closed or closed.attempt >= AUTOMATIC_ATTEMPTS:
        return None
    if closed.earlier and closed.cause in CANNOT_START and closed.earlier[-1].cause in CANNOT_START:
        return None
    return closed.attempt + 1 if closed.reason in REPLACED else None


def plays_on(record: Server) -> bool:
    """Return whether the server is open, or its next attempt is started without a request of the participant."""
    return not record.is_closed or next_attempt(record) is not None


def requestable_attempt(record: Server) -> int | None:
    """Return the attempt that the participant may request now; None if they may request none.

    If the last attempt found no free slot, it is the same attempt again.
    """
    if not record.is_closed or next_attempt(record) is not None:
        return None
    if record.reason is Reason.FULL:
        return record.attempt
    return record.attempt + 1 if record.attempt < MAX_ATTEMPTS else None


def attempt_after_pause(record: Server, arrived: datetime | None) -> int | None:
    """Return the attempt to start if the participant `arrived` at this game after their server had ended; else None.

    The server had waited for nobody, or its time was over: the study has two sittings, or the participant was slow.
    """
    ended_before = arrived is not None and record.closed is not None and record.closed < arrived
    return requestable_attempt(record) if ended_before and record.reason in (Reason.ENDED, Reason.DEADLINE) else None


def may_go_without(record: Server) -> bool:
    """Return whether the participant may go on without the game, because no server could run it.

    They may not while another server starts by itself, nor while the project's limits leave no slot: that passes. Nor
    may they if no server failed, since participants can stop their own servers until they get no more.
    """
    if not record.is_closed or next_attempt(record) is not None:
        return False
    none_left = requestable_attempt(record) is None
    return record.reason in FAILED or (none_left and any(past.reason in FAILED for past in record.earlier))


def replacing(before: Server, new: Server) -> Server:
    """Return the record `new` of the next attempt, with the closed attempt `before` added to its `earlier`."""
    return msgspec.structs.replace(new, earlier=(*before.earlier, past_attempt(before)))


def found_no_slot(server: Server, attempt: int) -> bool:
    """Return whether this attempt was closed because no slot was free. It started nothing, so it may be repeated."""
    return server.is_closed and server.attempt == attempt and server.reason is Reason.FULL


def repeating(before: Server, new: Server) -> Server:
    """Return the record `new` with the earlier attempts of `before`, an attempt without a slot that it repeats."""
    return msgspec.structs.replace(new, earlier=before.earlier)


def stopped_before_start(project_id: str, user_id: str, attempt: int, now: datetime) -> Server:
    """Return the closed record of a server that was stopped before it was started.

    The start message, which comes later, finds it closed and starts nothing.
    """
    return Server(
        project_id=project_id,
        user_id=user_id,
        attempt=attempt,
        state=ServerState.CLOSED,
        requested=now,
        deadline=now,
        cluster="",
        closed=now,
        reason=Reason.STOPPED,
    )


def on_demand(server: Server) -> Server:
    """Return the record of a server that is to run on demand, because Spot has no capacity.

    It is written before RunTask is called again, so that a repetition does not run a task of both kinds.
    """
    return msgspec.structs.replace(server, spot=False)


def naming(server: Server, task: str, address: Address, now: datetime) -> Server:
    """Return the record of a server whose task runs and has an address.

    It is written before the DNS record is created, so that each DNS record has an owner.
    """
    port = address.port or server.port
    return msgspec.structs.replace(
        server, state=ServerState.NAMING, task=task, host=address.host, port=port, running=now
    )


def with_default_name(server: Server) -> Server:
    """Return the record with the default DNS name, because the zone refuses the present name."""
    return msgspec.structs.replace(server, dns=f"{server.name}.{server.domain}")


def ready(server: Server, now: datetime) -> Server:
    """Return the record of a server to which browsers may connect: its name is INSYNC, or its certificate is issued."""
    return msgspec.structs.replace(server, state=ServerState.READY, ready=now)


def reserving(server: Server, warm_server: Server) -> Server:
    """Return the record with this warm server reserved.

    It is written before the warm server's own record, so that a repetition reserves no other one.
    """
    return msgspec.structs.replace(
        server,
        warm_server_name=warm_server.name,
        task=warm_server.task,
        host=warm_server.host,
        port=warm_server.port,
        dns=warm_server.dns,
        cluster=warm_server.cluster,
        spot=warm_server.spot,
    )


def without_warm_server(server: Server, own: Server) -> Server:
    """Return the record without the reserved warm server, which has ended or is another participant's.

    The record gets the names of `own`, a new server's record. The nonce stays: a task may have been started with
    secrets that are derived from it.
    """
    return msgspec.structs.replace(
        server,
        warm_server_name=None,
        task=None,
        host=None,
        port=own.port,
        dns=own.dns,
        cluster=own.cluster,
        spot=own.spot,
    )


def handed_over(warm_server: Server, label: str, now: datetime) -> Server:
    """Return the closed record of a warm server whose resources the participant's record under `label` owns now."""
    return msgspec.structs.replace(
        warm_server, state=ServerState.CLOSED, closed=now, reason=Reason.ASSIGNED, assigned_to=label
    )


def draining(warm_server: Server) -> Server:
    """Return the record of a warm server that can no longer be assigned. It is written before a resource is removed."""
    return msgspec.structs.replace(warm_server, state=ServerState.DRAINING)


def assigned(server: Server, warm_server: Server, now: datetime) -> Server:
    """Return the record of a server that has got the warm server's resources, so that the participant may connect."""
    return msgspec.structs.replace(server, state=ServerState.READY, nonce=warm_server.nonce, running=now, ready=now)


def close(server: Server, reason: Reason, now: datetime, cause: str = "") -> Server:
    """Return the closed record.

    `servers/termination.py` says which of the server's resources are removed before this record is written, and which
    after.
    """
    return msgspec.structs.replace(server, state=ServerState.CLOSED, closed=now, reason=reason, cause=cause)


def reason_for(stopped: TaskStopped) -> Reason:
    """Return the reason to record for a task that ended although our functions did not stop it."""
    if stopped.code == "UserInitiated":
        return Reason.STOPPED
    if stopped.code == "EssentialContainerExited" and stopped.exit_code == 0:
        return Reason.ENDED
    return Reason.LOST
