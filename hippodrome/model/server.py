"""A participant's server: its record, and what each event makes of it. Pure: no clock, no I/O.

States: (no record: queued) → starting → naming → ready → closed. `closed` is written last, when everything that the
server owned is gone; so a function that dies half-way is simply run again.

A *warm server* is started ahead of its participant (`warmServers`), under an id of nobody. When it is
ready, either a participant's record takes over all that it owns (closed, with the reason `taken`), or it is told to go
(`leaving`) and nobody may take it any more: which of the two is settled by one compare-and-swap.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from enum import StrEnum
from typing import NamedTuple, TypeVar

import msgspec

from hippodrome.model import ids, warm_pool
from hippodrome.model.project import LEGACY_PORT, Project
from hippodrome.model.records import Record
from hippodrome.ports import Address, DnsRecord, Settings

RECORDS = "_servers/"  # below which the records of all servers lie
AUTOMATIC_ATTEMPTS = 3  # a lost server is replaced by itself up to this attempt
MOST_ATTEMPTS = 8  # and by the participant's own wish up to this one

R = TypeVar("R")


class State(StrEnum):
    QUEUED = "queued"  # never on record: there is no record yet
    STARTING = "starting"
    NAMING = "naming"
    READY = "ready"
    DRAINING = "leaving"  # a warm server that nobody may take any more
    CLOSED = "closed"


class Reason(StrEnum):
    """Why a server was closed."""

    STOPPED = "stopped"  # the study's stop step, a relay, an administrator
    DEADLINE = "deadline"  # maxRuntime was over
    ENDED = "ended"  # the trial ended by itself: done, or nobody came
    LOST = "lost"  # Spot took it, the machine failed, it never became healthy
    REFUSED = "refused"  # AWS will not run it as it is configured
    NO_CAPACITY = "no capacity"
    FULL = "full"  # the project's limits: it was never started
    ASSIGNED = "taken"  # a warm server: what it owned is a participant's now

    @property
    def replaceable(self) -> bool:
        """Whether another attempt by itself makes sense."""
        return self in (Reason.LOST, Reason.NO_CAPACITY)


class PastAttempt(Record, frozen=True):
    """An attempt that is over: what `deploy cost` counts, once the record speaks of a later one."""

    attempt: int
    requested: datetime
    running: datetime | None = None
    closed: datetime | None = None
    cpu: float = 0
    memory: float = 0
    spot: bool = True
    reason: Reason | None = None
    cause: str = ""
    warm_server: str | None = msgspec.field(default=None, name="spare")
    nonce: str = ""
    game_steps: tuple[str, ...] = ()


class Server(Record, frozen=True):
    """`_servers/{label}.json`: one per participant, for all their attempts."""

    project_id: str
    user_id: str
    attempt: int
    state: State
    token: str  # empty but in records of earlier versions (`secret.py`), which do not read records without the key
    requested: datetime
    deadline: datetime
    cluster: str
    dns: str = ""  # the full name
    spot: bool = True
    task: str | None = None  # known once it runs
    host: str | None = None  # the address behind the name, exactly as it stands in the zone
    port: int | None = None  # where its task is told to listen, then where it does
    running: datetime | None = None
    ready: datetime | None = None
    closed: datetime | None = None
    reason: Reason | None = None
    cause: str = ""  # why it failed, if it did (`causes.Cause`)
    cpu: float = 0  # vCPU; 0 in records of before it was written down
    memory: float = 0  # GB
    earlier: tuple[PastAttempt, ...] = ()  # attempts before this one, oldest first
    counted: bool = False  # whether it holds one of its project's places until it is closed
    warm_server: str | None = msgspec.field(default=None, name="spare")  # the one that was assigned to it, by name
    assigned_to: str | None = msgspec.field(
        default=None, name="takenBy"
    )  # of a warm server: the label of the participant who has its things now
    nonce: str = ""  # what its token and credential are derived from (`secret.py`); no secret
    game_steps: tuple[str, ...] = ()  # whose answers it may store, as the project was when it was started

    @property
    def label(self) -> str:
        return ids.server_label(self.project_id, self.user_id)

    @property
    def name(self) -> str:
        """What all its things are called: in ECS, in DNS and in the Scheduler."""
        return self.warm_server or ids.server_name(self.label, self.attempt)

    @property
    def is_warm_server(self) -> bool:
        """Whether it was started for nobody yet."""
        return ids.is_warm_id(self.user_id)

    @property
    def warm_server_label(self) -> str:
        """The label of the warm server that it was given; empty if none."""
        return (ids.parse_server_name(self.warm_server or "") or ("", 0))[0]

    @property
    def is_closed(self) -> bool:
        return self.state is State.CLOSED

    def is_open(self, attempt: int) -> bool:
        """Whether the record speaks of this very attempt, and it is not over."""
        return self.attempt == attempt and not self.is_closed

    def owns(self, name: str) -> bool:
        """Whether what is called so is this server's: the same attempt may have been given a warm server meanwhile."""
        return self.name == name and not self.is_closed

    def has_left(self, name: str, by: datetime | None = None) -> bool:
        """Whether a resource of this name is a leftover: its server is closed, or a later attempt has replaced it.

        `by`: only if it was closed at that moment already.
        """
        if self.name != name:
            return self.attempt >= (ids.parse_server_name(name) or ("", 0))[1]
        return self.is_closed and (by is None or (self.closed is not None and self.closed <= by))

    @property
    def dns_record(self) -> DnsRecord | None:
        """The DNS record it owns, with the very values stored."""
        return DnsRecord(self.dns, self.host) if self.host else None

    @property
    def has_default_name(self) -> bool:
        """Whether its DNS name begins with its own name, as most do, and not with a participant's id."""
        return self.dns.partition(".")[0] == self.name

    @property
    def domain(self) -> str:
        """The domain directly above its DNS name, whose certificate it shows."""
        return self.dns.partition(".")[2]

    @property
    def has_own_cluster(self) -> bool:
        """Whether the cluster is this server's alone and goes with it."""
        return self.cluster == self.name


class TaskStopped(NamedTuple):
    """What an ECS event says of a task that is gone."""

    code: str | None  # stopCode
    exit_code: int | None
    words: str = ""  # what ECS says of the reasons, the task's and its container's


def owner(name: str, read: Callable[[str], R | None], server: Callable[[R], Server]) -> R | None:
    """Return the record that owns this resource name, following handovers; None for a name that leads to none.

    `read` returns what is stored under a label, and `server` the record in it: two reads for an assigned warm server,
    else one. The record may be of another attempt by now: its `name` tells.
    """
    parsed = ids.parse_server_name(name)
    found = read(parsed[0]) if parsed else None
    assigned_to = server(found).assigned_to if found is not None else None
    if assigned_to is None:
        return found
    heir = read(assigned_to)
    return heir if heir is not None and server(heir).name == name else found


def key(label: str) -> str:
    """Where the record lies: by the label, which every resource of the server carries in its name."""
    return f"{RECORDS}{label}.json"


def claim(
    project: Project, user_id: str, attempt: int, *, nonce: str = "", settings: Settings, now: datetime, token: str = ""
) -> Server:
    """The record that makes a new attempt ours, before anything is started.

    Its name is a hash below the servers' domain, or HIPPO's `userId` (`subdomain: userId`) where the installation
    allows it and the id is fit to be a name: ids come with the link, so whoever writes one chooses the name, on that
    level alone. The last automatic attempt and those after it do without Spot. The deadline of a warm server is how
    long it waits; once it is assigned, it plays as long as every server.
    """
    label = ids.server_label(project.id, user_id)
    name = ids.server_name(label, attempt)
    warm_server = ids.is_warm_id(user_id)
    by_id = project.subdomain == "userId" and settings.user_id_names
    first = user_id.lower() if by_id and not warm_server and ids.is_host_label(user_id.lower()) else name
    played = now + timedelta(minutes=min(project.max_runtime, settings.max_runtime))
    return Server(
        project_id=project.id,
        user_id=user_id,
        attempt=attempt,
        state=State.STARTING,
        token=token,
        requested=now,
        deadline=warm_pool.deadline(project, settings, label, now) if warm_server else played,
        cluster=name if project.cluster == "participant" else settings.cluster,
        dns=f"{first}.{settings.servers_domain}",
        port=project.server_port,
        spot=attempt < AUTOMATIC_ATTEMPTS,
        cpu=project.size.cpu,
        memory=project.size.memory,
        counted=project.limits_servers,
        nonce=nonce,
        game_steps=tuple(project.game_steps),
    )


def past_attempt(server: Server) -> PastAttempt:
    """What remains of an attempt when its record goes on with the next one."""
    return PastAttempt(
        attempt=server.attempt,
        requested=server.requested,
        running=server.running,
        closed=server.closed,
        cpu=server.cpu,
        memory=server.memory,
        spot=server.spot,
        reason=server.reason,
        cause=server.cause,
        warm_server=server.warm_server,
        nonce=server.nonce,
        game_steps=server.game_steps,
    )


def replacing(before: Server, wanted: Server) -> Server:
    """The next attempt's record, which remembers the closed one that it takes the place of."""
    return msgspec.structs.replace(wanted, earlier=(*before.earlier, past_attempt(before)))


def found_no_slot(server: Server, attempt: int) -> bool:
    """Whether this attempt found no place: nothing was started, so it may be made once more, under the same name."""
    return server.is_closed and server.attempt == attempt and server.reason is Reason.FULL


def repeating(before: Server, wanted: Server) -> Server:
    """The record of an attempt that found no place, when it is made once more."""
    return msgspec.structs.replace(wanted, earlier=before.earlier)


def stopped_before_start(project_id: str, user_id: str, attempt: int, now: datetime) -> Server:
    """The record of a server that was stopped before anybody started it: a late start message finds it closed."""
    return Server(
        project_id=project_id,
        user_id=user_id,
        attempt=attempt,
        state=State.CLOSED,
        token="",
        requested=now,
        deadline=now,
        cluster="",
        closed=now,
        reason=Reason.STOPPED,
    )


def on_demand(server: Server) -> Server:
    """Spot has no room. Written before the other request is made, so that no repetition makes both."""
    return msgspec.structs.replace(server, spot=False)


def naming(server: Server, task: str, address: Address, now: datetime) -> Server:
    """It runs and has an address; its name is on its way. Written before the name is made: no name is ownerless."""
    port = address.port or server.port or LEGACY_PORT  # records of earlier versions name no port before this one
    return msgspec.structs.replace(server, state=State.NAMING, task=task, host=address.host, port=port, running=now)


def with_default_name(server: Server) -> Server:
    """The zone will not take its name: it is called as servers usually are."""
    return msgspec.structs.replace(server, dns=f"{server.name}.{server.dns.partition('.')[2]}")


def ready(server: Server, now: datetime) -> Server:
    """Every name server knows it: the participant may have the address."""
    return msgspec.structs.replace(server, state=State.READY, ready=now)


def reserving(server: Server, warm_server: Server) -> Server:
    """Reserve this warm server. Written before the warm server's own record is, so that no repetition reserves two."""
    return msgspec.structs.replace(
        server,
        warm_server=warm_server.name,
        task=warm_server.task,
        host=warm_server.host,
        port=warm_server.port,
        dns=warm_server.dns,
        cluster=warm_server.cluster,
        spot=warm_server.spot,
    )


def without_warm_server(server: Server, own: Server) -> Server:
    """The warm server was gone: the server is started as others are. `own` is the record it would have had without.

    The nonce is its own still: a task may have been started with what is derived from it before.
    """
    return msgspec.structs.replace(
        server,
        warm_server=None,
        task=None,
        host=None,
        port=own.port,
        dns=own.dns,
        cluster=own.cluster,
        spot=own.spot,
    )


def handed_over(warm_server: Server, label: str, now: datetime) -> Server:
    """A warm server whose things are a participant's from now on."""
    return msgspec.structs.replace(
        warm_server, state=State.CLOSED, closed=now, reason=Reason.ASSIGNED, assigned_to=label
    )


def draining(warm_server: Server) -> Server:
    """A warm server that nobody may take any more. Written before anything of it is removed."""
    return msgspec.structs.replace(warm_server, state=State.DRAINING)


def assigned(server: Server, warm_server: Server, now: datetime) -> Server:
    """The warm server's things are this server's: the participant may have the address."""
    return msgspec.structs.replace(
        server, state=State.READY, nonce=warm_server.nonce, token=warm_server.token, running=now, ready=now
    )


def close(server: Server, reason: Reason, now: datetime, cause: str = "") -> Server:
    """All it owned is gone."""
    return msgspec.structs.replace(server, state=State.CLOSED, closed=now, reason=reason, cause=cause)


def reason_for(stopped: TaskStopped) -> Reason:
    """What to make of a task that ended without our asking."""
    if stopped.code == "UserInitiated":
        return Reason.STOPPED
    if stopped.code == "EssentialContainerExited" and stopped.exit_code == 0:
        return Reason.ENDED
    return Reason.LOST


def next_attempt(server: Server) -> int | None:
    """The attempt that replaces a closed server by itself; None if it should stay closed, as a warm server does."""
    if server.is_warm_server or not server.is_closed or server.attempt >= AUTOMATIC_ATTEMPTS:
        return None
    return server.attempt + 1 if server.reason and server.reason.replaceable else None


def may_start_again(server: Server) -> bool:
    """Whether the participant may ask for another one."""
    return requestable_attempt(server) is not None


def requestable_attempt(server: Server) -> int | None:
    """The attempt that the participant may ask for; None if none. One that found no place does not count as made."""
    if not server.is_closed or next_attempt(server) is not None:
        return None
    if server.reason is Reason.FULL:
        return server.attempt
    return server.attempt + 1 if server.attempt < MOST_ATTEMPTS else None
