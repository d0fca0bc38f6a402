"""The five ports that the control plane uses, and the platform that holds them.

`hippodrome.aws` implements them on S3, ECS, Route 53, EventBridge Scheduler and SNS/SQS; `local` implements them on one
machine. Every implementation passes the same contract tests. All of them keep these rules:

* A method that removes or stops something succeeds if it is already gone.
* A method that creates something under a given name may be repeated: the second call finds the result of the first.
* Transient errors (throttling, a lost connection) are raised as the library raises them; the caller's queue retries.
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
    """Another writer created, changed or removed the document meanwhile: read it again and decide anew."""


class NoCapacity(Exception):
    """There is no capacity for this kind of task now (Spot is sold out, or the launch quota is used up)."""


class ServiceBusy(Exception):
    """The platform does not take this call now, and has changed nothing: call again in a few seconds."""


class Refused(Exception):
    """The platform will never run this task as requested, so a retry cannot help. The text says why."""


class RefusedDnsRecords(Exception):
    """The zone will never take these `records`. All others of the call are changed, with the id `change`."""

    def __init__(self, records: Sequence[DnsRecord], change: str) -> None:
        super().__init__(f"{len(records)} names are refused")  # names may hold ids
        self.records, self.change = tuple(records), change


class Document(NamedTuple):
    """The bytes stored under a key, and the ETag for a conditional write."""

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
        """The document, or None. If it has not changed since `known`, that very object is returned."""

    def create(self, key: str, body: bytes) -> str:
        """Create a document; return its ETag. Raises `Conflict` if it exists."""

    def replace(self, key: str, body: bytes, etag: str) -> str:
        """Replace the version with this ETag; return the new ETag. Raises `Conflict` if another version is present."""

    def put(self, key: str, body: bytes) -> None:
        """Write a document, whatever is there: the last of several writers wins. For entries that say "still here"."""

    def list(self, prefix: str) -> Iterator[Entry]:
        """All documents whose key begins with `prefix`, in key order."""

    def delete(self, key: str) -> None:
        """Remove the document if it is there."""


class Address(NamedTuple):
    """Where a task listens: an IPv4 address and a TCP port. None means the requested port (`TaskRequest.port`)."""

    host: str
    port: int | None = None


@dataclass(frozen=True)
class TaskRequest:
    """A server to run. `name` ("label-attempt") is its `startedBy`; with `nonce` it makes the request repeatable.

    A repeated request has the same nonce. If a name is used again, the nonce differs: a participant may come back after
    all their data was erased.
    """

    name: str
    definition: str
    cluster: str
    cpu: float  # vCPU
    memory: float  # GB
    environment: Mapping[str, str] = field(repr=False)
    spot: bool = True
    nonce: str = field(default="", repr=False)
    port: int = 5000  # where it should listen; on one machine it takes a free port


class RunningTask(NamedTuple):
    """A task of ours that was not told to stop. `name` is the `startedBy` it was run with.

    `interface`: the id of its network interface, once it has one. `runs`: whether it is RUNNING.
    """

    task: str
    cluster: str
    name: str
    interface: str | None = None
    runs: bool = True


class Tasks(Protocol):
    """Servers (ECS tasks on Fargate, or processes). Their state changes arrive as ECS events at `task_changed`."""

    def run(self, request: TaskRequest) -> str:
        """Start a task and return its id at once. The same name and kind again returns the same task, even if it ended.

        Raises `NoCapacity` or `Refused`.
        """

    def stop(self, task: str, cluster: str, reason: str) -> None:
        """Stop a task (SIGTERM, then SIGKILL after its stop timeout)."""

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        """The public address of each network interface that has one. One call for all."""

    def find(self, name: str, cluster: str) -> str | None:
        """The id of the living task that was run under this name; None if it was told to stop.

        A task run a moment ago may not be found yet (ECS is eventually consistent).
        """

    def list(self) -> Iterator[RunningTask]:
        """All living tasks of ours that were not told to stop, in all our clusters."""

    def create_cluster(self, name: str) -> None:
        """Create a participant's own cluster (`cluster: participant`)."""

    def delete_cluster(self, name: str) -> None:
        """Delete a cluster. Raises while tasks are still ending in it; the caller's queue retries."""

    def clusters(self) -> Iterator[str]:
        """The names of the participants' own clusters."""


class DnsRecord(NamedTuple):
    """An A record of our zone: a full DNS name without the final dot, and its IPv4 address."""

    name: str
    host: str


class Dns(Protocol):
    """DNS names of servers (a Route 53 hosted zone)."""

    def change(self, add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        """Make all these changes at once; return an id for `in_sync`, or "" if they are in sync already.

        A record that is already gone counts as removed; one that is both added and removed is added. Raises
        `ServiceBusy` if other changes keep the zone busy for long, and, after all other changes, `RefusedDnsRecords`
        for records that cannot be added.
        """

    def in_sync(self, change: str) -> bool:
        """Whether every name server of the zone has this change. Raises `ServiceBusy` if it cannot be asked now."""

    def list(self) -> Iterator[DnsRecord]:
        """The A records of servers in our zone: those whose first label has the form of a server's name."""

    def browser_host(self, record: DnsRecord) -> str:
        """The host that browsers connect to: the DNS name, or the address where there is no DNS."""


class Timers(Protocol):
    """One-time timers that publish a message to the stop topic. They do not depend on any process of ours."""

    def set(self, name: str, at: datetime, message: Message) -> None:
        """Publish `message` to the stop topic at `at` (aware, to the second). Replaces a timer of the same name.

        A time in the past means as soon as possible.
        """

    def cancel(self, name: str) -> None:
        """Delete the timer."""

    def list(self) -> Iterator[str]:
        """The names of all timers that have not fired."""


class Topic(StrEnum):
    """Where messages go: each topic feeds a queue, and each queue a function."""

    START = "start"
    STOP = "stop"


class Bus(Protocol):
    """Messages between functions. Delivery is at least once and in any order."""

    def publish(self, topic: Topic, message: Message) -> None:
        """Send the message to the topic's subscribers."""

    def send_delayed(self, message: Message, seconds: int) -> None:
        """Deliver the message to `task_changed`'s own queue after 0 to 900 seconds. Raises ValueError for others."""


PORTS = (443, 5000)
"""Ports of servers on AWS. A server listens on the one its project was registered with; some networks block 5000."""


@dataclass(frozen=True)
class Settings:
    """The installation's settings: the functions' environment variables, under HIPPO's names."""

    bucket: str = ""
    region: str = ""
    root_domain: str = ""
    servers_host: str = ""  # the level below `root_domain` of the servers' names; "": directly below it
    max_runtime: int = 24 * 60  # minutes; no server lives longer, whatever its project says
    cluster: str = "hippodrome"
    task_definition: str = "hippodrome"
    game_sources: str = ""  # what the pages' Content-Security-Policy lets the game connect to
    user_id_names: bool = True  # whether projects may name servers after participants' ids (`subdomain: userId`)
    plain_clients: bool = False  # whether projects' front ends may open servers without a token (`plainClients`)

    @property
    def servers_domain(self) -> str:
        """The domain directly above servers' names."""
        return f"{self.servers_host}.{self.root_domain}" if self.servers_host else self.root_domain

    @property
    def game_scheme(self) -> str:
        """The scheme of trial servers' addresses: `wss`, or `ws` where they have no TLS."""
        return self.game_sources.partition(":")[0] or "wss"

    @classmethod
    def from_env(cls, env: Mapping[str, str]) -> Settings:
        """Read `BUCKET ROOT_DOMAIN MAX_RUNTIME CLUSTER TASK_DEFINITION SERVER_NAMES SERVERS_HOST PLAIN_CLIENTS`.

        And Lambda's `AWS_REGION`. Missing ones get their defaults; without `SERVER_NAMES` no server is named after an
        id.
        """
        domain, host = (env.get(key, "").strip(".").lower() for key in ("ROOT_DOMAIN", "SERVERS_HOST"))
        return cls(
            bucket=env.get("BUCKET", ""),
            region=env.get("AWS_REGION", ""),
            root_domain=domain,
            max_runtime=int(env.get("MAX_RUNTIME") or cls.max_runtime),
            cluster=env.get("CLUSTER") or cls.cluster,
            task_definition=env.get("TASK_DEFINITION") or cls.task_definition,
            game_sources=_game_sources(domain, host),
            user_id_names=env.get("SERVER_NAMES") == "userId",
            plain_clients=env.get("PLAIN_CLIENTS") == "allowed",
            servers_host=host,
        )


def _game_sources(domain: str, host: str) -> str:
    """Sources for servers' names on their level, and directly below the domain, as earlier versions named them."""
    above = [f"{host}.{domain}", domain] if host else [domain]
    return " ".join(f"wss://*.{one}:{port}" for one in above for port in PORTS) if domain else ""


class Platform(Protocol):
    """All ports, settings and time. A port is created when first used, so that cold starts do not pay for others."""

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

    def run_all(self, acts: Sequence[Callable[[], T]]) -> list[T]:
        """Call all these functions, possibly at the same time; return their results in order. None may raise."""
