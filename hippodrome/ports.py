"""The five ports that the control plane stands on, and the platform that carries them.

`hippodrome.aws` implements them on S3, ECS, Route 53, EventBridge Scheduler and SNS/SQS; `local` implements them on one
machine. Every implementation passes the same contract tests. The rules they all keep:

* A method that removes or stops something succeeds when it is already gone.
* A method that creates under a given name may be repeated: the second call finds the work of the first.
* Anything transient (throttling, a lost connection) is raised as the library raises it; the caller's queue tries again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any, NamedTuple, Protocol, TypeVar

Message = Mapping[str, Any]
T = TypeVar("T")


class Conflict(Exception):
    """Somebody else created, changed or removed the document in between; read it again and decide anew."""


class NoCapacity(Exception):
    """There is no room for this kind of task just now (Spot is sold out, or the launch quota is used up)."""


class Busy(Exception):
    """The platform takes no such call just now, and has changed nothing: ask again in a few seconds."""


class Refused(Exception):
    """The platform will never run this task as asked for: trying again cannot help. The text says why."""


class RefusedDnsRecords(Exception):
    """The zone will never take these `records` as they are. All others of the call are made, with the id `change`."""

    def __init__(self, records: Sequence[DnsRecord], change: str) -> None:
        super().__init__(f"{len(records)} names are refused")  # names may hold ids
        self.records, self.change = tuple(records), change


class Document(NamedTuple):
    """What lies under a key: its bytes, and the ETag that a conditional write names."""

    body: bytes
    etag: str


class Entry(NamedTuple):
    """One line of a listing."""

    key: str
    modified: datetime
    size: int


class Documents(Protocol):
    """Whole documents under keys, with compare-and-swap (S3 conditional writes)."""

    def get(self, key: str, known: Document | None = None) -> Document | None:
        """The document, or None. With `known`, that very object is returned if the document has not changed."""

    def create(self, key: str, body: bytes) -> str:
        """Write a document that does not exist yet; its ETag. Raises `Conflict` if it exists."""

    def replace(self, key: str, body: bytes, etag: str) -> str:
        """Write over the version with this ETag; the new ETag. Raises `Conflict` if that is not the present one."""

    def list(self, prefix: str) -> Iterator[Entry]:
        """Every document whose key begins with `prefix`, in key order, however many there are."""

    def delete(self, key: str) -> None:
        """Remove the document if it is there."""


class Address(NamedTuple):
    """Where a task listens: an IPv4 address and a TCP port; None: the port that it was told (`TaskRequest.port`)."""

    host: str
    port: int | None = None


@dataclass(frozen=True)
class TaskRequest:
    """A server to run. `name` ("label-attempt") is its `startedBy`; with `nonce` it makes the request repeatable.

    The nonce is the same whenever the request is repeated, and another one where a name is used again, as for somebody
    who comes back after everything about them was erased.
    """

    name: str
    definition: str
    cluster: str
    cpu: float  # vCPU
    memory: float  # GB
    environment: Mapping[str, str] = field(repr=False)
    spot: bool = True
    nonce: str = field(default="", repr=False)
    port: int = 5000  # where it is to listen; on one machine it listens where there is room


class RunningTask(NamedTuple):
    """A task that is ours and not stopped yet. `name` is the `startedBy` it was run with.

    `interface` is the id of its network interface once it has one; `runs`: whether its program does.
    """

    task: str
    cluster: str
    name: str
    interface: str | None = None
    runs: bool = True


class Tasks(Protocol):
    """Servers (ECS tasks on Fargate, or processes). Their state changes arrive as ECS events at `task_changed`."""

    def run(self, request: TaskRequest) -> str:
        """Start it and return its id at once; the same name and kind again returns the same task, living or not.

        Raises `NoCapacity` or `Refused`.
        """

    def stop(self, task: str, cluster: str, reason: str) -> None:
        """Ask it to end (SIGTERM, then SIGKILL after its stop timeout)."""

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        """The public address behind each network interface id that has one (one call for all of them)."""

    def find(self, name: str, cluster: str) -> str | None:
        """The id of the task that was run under this name, if it lives and was not told to stop.

        A task run a moment ago may not be found yet (ECS is eventually consistent).
        """

    def list(self) -> Iterator[RunningTask]:
        """Every task of ours that lives and was not told to stop, in every cluster of ours."""

    def create_cluster(self, name: str) -> None:
        """Make a cluster of a participant's own (`cluster: participant`)."""

    def delete_cluster(self, name: str) -> None:
        """Remove it. Raises if tasks are still leaving; the caller's queue tries again."""

    def clusters(self) -> Iterator[str]:
        """The names of the participants' own clusters."""


class DnsRecord(NamedTuple):
    """An A record of our zone: a full DNS name without the final dot, and the IPv4 address it leads to."""

    name: str
    host: str


class Dns(Protocol):
    """DNS names of servers (a Route 53 hosted zone)."""

    def change(self, add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        """Make all these changes at once; an id for `in_sync`, or "" if they are in sync already.

        A record that is already gone counts as removed; one that is both added and removed is added. Raises `Busy` if
        other changes keep the zone busy for long, and `RefusedDnsRecords` for those that cannot be added, after it has
        made the others.
        """

    def in_sync(self, change: str) -> bool:
        """Whether every name server of the zone has that change. Raises `Busy` if that cannot be asked just now."""

    def list(self) -> Iterator[DnsRecord]:
        """The A records of servers in our zone: those whose first label looks like a server's name."""

    def dial(self, record: DnsRecord) -> str:
        """The host that a browser connects to: the name, or the address itself where there is no DNS."""


class Timers(Protocol):
    """One-time timers that outlive every process and publish a message to the stop topic."""

    def set(self, name: str, at: datetime, message: Message) -> None:
        """At `at` (aware, to the second), publish `message` to the stop topic. A timer of that name is replaced.

        A time that has passed means as soon as the platform can.
        """

    def cancel(self, name: str) -> None:
        """Forget the timer."""

    def list(self) -> Iterator[str]:
        """The names of all timers that have not fired."""


class Topic(StrEnum):
    """Where messages go: each topic feeds a queue, each queue a function."""

    START = "start"
    STOP = "stop"


class Bus(Protocol):
    """Messages between functions. Delivery is at least once and in any order."""

    def publish(self, topic: Topic, message: Message) -> None:
        """Send to the topic's subscribers."""

    def later(self, message: Message, seconds: int) -> None:
        """Deliver to `task_changed`'s own queue after this many seconds, 0 to 900. Raises ValueError beyond."""


PORTS = (443, 5000)
"""Where servers on AWS listen: each on the one that its study was registered with. Some institutions close 5000."""


@dataclass(frozen=True)
class Settings:
    """What the administrator's installation decided: the functions' environment variables, under HIPPO's names."""

    bucket: str = ""
    root_domain: str = ""
    servers_host: str = ""  # the level below it where servers get their names; "": directly below it
    max_runtime: int = 24 * 60  # minutes; no server lives longer, whatever its project says
    cluster: str = "hippodrome"
    task_definition: str = "hippodrome"
    game_sources: str = ""  # what the pages' Content-Security-Policy lets the game connect to
    user_id_names: bool = True  # whether projects may name servers after participants' ids (`subdomain: userId`)

    @property
    def servers_domain(self) -> str:
        """The domain directly above servers' names."""
        return f"{self.servers_host}.{self.root_domain}" if self.servers_host else self.root_domain

    @property
    def game_scheme(self) -> str:
        """`wss`, or `ws` where the trial servers speak without TLS."""
        return self.game_sources.partition(":")[0] or "wss"

    @classmethod
    def from_env(cls, env: Mapping[str, str]) -> Settings:
        """Read `BUCKET ROOT_DOMAIN MAX_RUNTIME CLUSTER TASK_DEFINITION SERVER_NAMES SERVERS_HOST`.

        Those a function lacks stay empty; then no server is named after an id.
        """
        domain, host = (env.get(key, "").strip(".").lower() for key in ("ROOT_DOMAIN", "SERVERS_HOST"))
        return cls(
            bucket=env.get("BUCKET", ""),
            root_domain=domain,
            max_runtime=int(env.get("MAX_RUNTIME") or cls.max_runtime),
            cluster=env.get("CLUSTER") or cls.cluster,
            task_definition=env.get("TASK_DEFINITION") or cls.task_definition,
            game_sources=_game_sources(domain, host),
            user_id_names=env.get("SERVER_NAMES") == "userId",
            servers_host=host,
        )


def _game_sources(domain: str, host: str) -> str:
    """Servers' names on their level, and directly below the domain: some that earlier versions named may still run."""
    above = [f"{host}.{domain}", domain] if host else [domain]
    return " ".join(f"wss://*.{one}:{port}" for one in above for port in PORTS) if domain else ""


class Platform(Protocol):
    """Everything outside. Ports are made when first used, so that none costs a cold start."""

    @property
    def settings(self) -> Settings: ...
    @property
    def documents(self) -> Documents: ...
    @property
    def tasks(self) -> Tasks: ...
    @property
    def dns(self) -> Dns: ...
    @property
    def timers(self) -> Timers: ...
    @property
    def bus(self) -> Bus: ...
    def now(self) -> datetime:
        """The present time, aware, in UTC."""

    def together(self, acts: Sequence[Callable[[], T]]) -> list[T]:
        """The results of all these acts, in their order. They may run at the same time; none of them may raise."""
