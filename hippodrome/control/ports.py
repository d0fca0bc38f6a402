"""Defines the five ports that the control plane uses, and the platform that holds them.

`hippodrome.control.aws` implements them on S3, ECS, Route 53, EventBridge Scheduler and SNS/SQS; `local` implements
them on one machine. Every implementation passes the same contract tests. All of them keep these rules:

* A method that removes or stops something succeeds if there is nothing to remove or stop.
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
    """Another writer has created, changed or removed the document. The caller reads it again and decides anew."""


class RetryLater(Exception):
    """The message cannot be handled now. The queue should deliver it again."""

    expected = True  # so that `log.failure` logs these errors as information


class NoCapacity(Exception):
    """There is no capacity for this kind of task now: Spot has none left, or a quota is used up."""


class ServiceBusy(Exception):
    """The platform refuses this call now and has changed nothing. The caller calls again in a few seconds."""


class Refused(Exception):
    """The platform will never run this task as requested, so a retry cannot help. The text says why."""


class RefusedDnsRecords(Exception):
    """The zone will never accept these `records`. The change with the id `change` has made the other changes."""

    def __init__(self, records: Sequence[DnsRecord], change: str) -> None:
        super().__init__(f"{len(records)} names are refused")  # the message shows no names, since they may hold ids
        self.records, self.change = tuple(records), change


class Document(NamedTuple):
    """The bytes stored under a key, and the ETag for a conditional write."""

    body: bytes
    etag: str


class Entry(NamedTuple):
    """A document in a listing: its key, the time of its last change (UTC), and its size in bytes."""

    key: str
    modified: datetime
    size: int


class Documents(Protocol):
    """Whole documents under keys, with compare-and-swap (S3 conditional writes)."""

    def get(self, key: str, known: Document | None = None) -> Document | None:
        """Return the document; None if it is missing. If it has not changed since `known`, return that same object."""

    def create(self, key: str, body: bytes) -> str:
        """Create a document; return its ETag. Raises `Conflict` if it exists."""

    def replace(self, key: str, body: bytes, etag: str) -> str:
        """Replace the version with this ETag; return the new ETag. Raises `Conflict` if another version is present."""

    def put(self, key: str, body: bytes) -> None:
        """Write a document without a condition: the last of several writers wins. Only the lobby's entries need it."""

    def list(self, prefix: str) -> Iterator[Entry]:
        """Yield an entry for each document whose key begins with `prefix`, in the order of the keys."""

    def delete(self, key: str) -> None:
        """Remove the document if it is there."""


class Address(NamedTuple):
    """Where a task listens: an IPv4 address and a TCP port. None means the requested port (`TaskRequest.port`)."""

    host: str
    port: int | None = None


@dataclass(frozen=True)
class TaskRequest:
    """A server to run. `name` ("label-attempt") is its `startedBy`.

    `name` and `nonce` make the request repeatable: a repeated request has the same nonce. If a participant comes back
    after all their data were erased, a server of the same name gets another nonce, so that it is a new task.
    """

    name: str
    definition: str
    cluster: str
    cpu: float  # vCPU
    memory: float  # GB
    environment: Mapping[str, str] = field(repr=False)
    spot: bool = True
    nonce: str = field(default="", repr=False)
    port: int = 5000  # the port on which it should listen; on one machine it takes a free port


class RunningTask(NamedTuple):
    """A server's task that has not ended. `name` is the `startedBy` that it was run with.

    `interface`: the id of its network interface, once it has one. `runs`: whether its status is RUNNING.
    """

    task: str
    cluster: str
    name: str
    interface: str | None = None
    runs: bool = True


class Tasks(Protocol):
    """Servers (ECS tasks on Fargate, or processes). Their state changes arrive as ECS events at `task_changed`."""

    def run(self, request: TaskRequest) -> str:
        """Start a task and return its id, without waiting until it runs. Raises `NoCapacity` or `Refused`.

        A second request with the same name, nonce and kind (Spot or on demand) returns the same task, even if that task
        has ended.
        """

    def stop(self, task: str, cluster: str, reason: str) -> None:
        """Stop a task (SIGTERM, then SIGKILL after its stop timeout)."""

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        """Return the public address of each of these network interfaces that has one, by the interface's id."""

    def find(self, name: str, cluster: str) -> str | None:
        """Return the id of the living task that was run under this name; None if there is none or it was told to stop.

        A task that was run a moment ago may not be found yet (ECS is eventually consistent).
        """

    def list(self) -> Iterator[RunningTask]:
        """Yield all living tasks of servers that were not told to stop, in all our clusters."""

    def create_cluster(self, name: str) -> None:
        """Create a participant's own cluster (`cluster: participant`)."""

    def delete_cluster(self, name: str) -> None:
        """Delete a cluster. Raises while tasks are still ending in it; the caller's queue retries."""

    def clusters(self) -> Iterator[str]:
        """Yield the names of the participants' own clusters."""


class DnsRecord(NamedTuple):
    """An A record of our zone: a full DNS name without the final dot, and its IPv4 address."""

    name: str
    host: str


class Dns(Protocol):
    """DNS records of servers (a Route 53 hosted zone)."""

    def change(self, add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        """Make all these changes at once; return an id for `in_sync`, or "" if they are in sync already.

        A record that does not exist counts as removed; one that is both added and removed is added. Raises
        `ServiceBusy` if other changes keep the zone busy for long. If records cannot be added, all other changes are
        made, then `RefusedDnsRecords` is raised.
        """

    def in_sync(self, change: str) -> bool:
        """Return whether every name server of the zone has this change.

        Raises `ServiceBusy` if the zone is too busy now.
        """

    def list(self) -> Iterator[DnsRecord]:
        """Yield the A records in our zone whose first label has the form of a server's name."""

    def browser_host(self, record: DnsRecord) -> str:
        """Return the host that browsers connect to: the DNS name; the IPv4 address if the platform has no DNS."""


class Timers(Protocol):
    """One-time timers, each of which publishes a message to the stop topic, even if no function of ours runs."""

    def set(self, name: str, at: datetime, message: Message) -> None:
        """Publish `message` to the stop topic at `at` (aware, to the second). Replaces a timer of the same name.

        A time in the past means as soon as possible.
        """

    def cancel(self, name: str) -> None:
        """Delete the timer."""

    def list(self) -> Iterator[str]:
        """Yield the names of all timers that have not fired."""


class Topic(StrEnum):
    """The topics of messages: each topic feeds a queue, and each queue a function."""

    START = "start"
    STOP = "stop"


class Bus(Protocol):
    """Messages between functions. Delivery is at least once and in any order."""

    def publish(self, topic: Topic, message: Message) -> None:
        """Send the message to the topic's subscribers."""

    def send_delayed(self, message: Message, seconds: int) -> None:
        """Send the message to the queue of `task_changed`, delayed by 0 to 900 `seconds`.

        Raises ValueError for another delay.
        """


PORTS = (443, 5000)
"""Ports of servers on AWS. A server listens on the port of its project's registration; some networks block 5000."""


@dataclass(frozen=True)
class Settings:
    """The installation's settings: the functions' environment variables, under HIPPO's names."""

    bucket: str = ""
    region: str = ""
    root_domain: str = ""
    servers_host: str = ""  # the level below `root_domain` of the servers' names; "": directly below it
    max_runtime: int = 24 * 60  # minutes; no server lives longer, even if its project's maxRuntime is longer
    cluster: str = "hippodrome"
    task_definition: str = "hippodrome"
    game_sources: str = ""  # the sources in the pages' Content-Security-Policy to which the game may connect
    game_path: str = ""  # below this path all servers are at the one address in `game_sources`, by their names
    user_id_names: bool = True  # whether projects may name servers after participants' ids (`subdomain: userId`)
    certificate_url: str = ""  # where servers without a name get their certificate (`certify_server`)
    plain_clients: bool = False  # whether projects' front ends may open servers without a token (`plainClients`)

    @property
    def servers_domain(self) -> str:
        """The domain directly above the servers' names; "" if servers have no names."""
        return f"{self.servers_host}.{self.root_domain}" if self.servers_host and self.root_domain else self.root_domain

    @property
    def game_scheme(self) -> str:
        """The scheme of trial servers' addresses: `wss`, or `ws` where they have no TLS."""
        return self.game_sources.partition(":")[0] or "wss"

    def game_address(self, host: str, port: int) -> str:
        """Return the address at which browsers reach the server with this host and port."""
        if self.game_path:
            return f"{self.game_sources}{self.game_path}{host.partition('.')[0]}/"
        return f"{self.game_scheme}://{host}:{port}/"

    @classmethod
    def from_env(cls, env: Mapping[str, str]) -> Settings:
        """Read the settings from a function's environment variables.

        They are `BUCKET`, `ROOT_DOMAIN`, `MAX_RUNTIME`, `CLUSTER`, `TASK_DEFINITION`, `SERVER_NAMES`, `SERVERS_HOST`,
        `PLAIN_CLIENTS`, `CERTIFICATE_URL`, and Lambda's `AWS_REGION`. A missing variable gives the default; without
        `SERVER_NAMES` no server is named after a participant's id.
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
            certificate_url=env.get("CERTIFICATE_URL", ""),
        )


def _game_sources(domain: str, host: str) -> str:
    """The sources for servers' names, which are directly below the servers' domain."""
    parent = f"{host}.{domain}" if host else domain
    return " ".join(f"wss://*.{parent}:{port}" for port in PORTS) if domain else ""


class Platform(Protocol):
    """The ports, the settings and the clock. A port is created when first used, so that cold starts stay short."""

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
        """Return the present time, aware, in UTC."""

    def run_all(self, acts: Sequence[Callable[[], T]]) -> list[T]:
        """Call all these functions, possibly at the same time; return their results in order. They must not raise."""
