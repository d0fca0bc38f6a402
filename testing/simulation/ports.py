"""The five ports on the simulated account, with what AWS does to those who use them."""

from __future__ import annotations

import bisect
import hashlib
import ipaddress
import itertools
import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache, partial
from typing import Any, TypeVar

from hippodrome.aws.dns import BATCH
from hippodrome.aws.retry import retry_while_busy
from hippodrome.lobby import decisions, entries
from hippodrome.model import ids
from hippodrome.ports import (
    Address,
    Conflict,
    DnsRecord,
    Document,
    Entry,
    Message,
    NoCapacity,
    Refused,
    RunningTask,
    ServiceBusy,
    Settings,
    TaskRequest,
    Topic,
)
from testing import template
from testing.clock import EPOCH
from testing.simulation.clock import GreenletClock
from testing.simulation.cloud import ATTEMPTS, LATENCY, Cloud, Throttled
from testing.simulation.functions import Lineage, lineage
from testing.tasks import Life, Task

STARTS = (25.0, 0.4, 90.0)  # seconds from RunTask to RUNNING: median, sigma of its logarithm, and the longest
PROPAGATION = (20.0, 60.0)  # seconds until a change of the zone is INSYNC
SLOW_PROPAGATION = (60.0, 120.0)  # seconds, while Route 53 is slow: libdns/route53 issue 14, certbot pull request 6071
SLOW_ZONE, SLOW_FOR = 0.1, 5.0  # the share of the time in which it is; seconds that it is slow for
ADDRESS_LATE = (1.0, 20.0)  # seconds that DescribeNetworkInterfaces may know no address yet of a task that runs
BUSY_ZONE = (0.2, 1.0)  # seconds during which another change of the zone is PriorRequestNotComplete
DEPROVISIONED = (10.0, 35.0)  # seconds from the end of a task's container to STOPPED: its network interface goes
ADDRESSES = sum(
    ipaddress.ip_network(subnet["CidrBlock"]).num_addresses
    - 5  # of which AWS keeps five: VPC User Guide, "Subnet CIDR blocks"
    for subnet in template.resources("AWS::EC2::Subnet").values()
)
PAGE = 1000  # keys of one page of a listing: S3 API Reference, ListObjectsV2
MAX_CHANGES = 1000  # of a zone in one call, an UPSERT counting twice: Route 53 Developer Guide, "Quotas"
LOBBY = (entries.FOLDER, decisions.LOBBIES)  # where who waits, and what is decided, lies
T = TypeVar("T")


class SimDocuments:
    """S3: conditional writes, strongly consistent. `kept` and `keep` are for people and trials, who pay elsewhere.

    A read, and a listing, show every write that was answered before they began (S3 User Guide, "What is Amazon S3?",
    data consistency model); a write without a condition takes the place of what there is, and the last one stays.
    `LastModified` has whole seconds, cut (minio/minio-go issue 1632 and pull request 1638, tried on AWS). A listing is a
    call for every 1,000 keys (S3 API Reference, ListObjectsV2), and no snapshot: what is written between its pages
    may be seen in the later ones. Removing what is not there succeeds (the same, DeleteObject).
    """

    def __init__(self, cloud: Cloud) -> None:
        self._cloud = cloud
        self.kept: dict[str, tuple[bytes, str, datetime]] = {}
        self._keys: list[str] = []  # sorted

    def get(self, key: str, known: Document | None = None) -> Document | None:
        return self._call("s3:GetObject", key, lambda: self._get(key, known))

    def create(self, key: str, body: bytes) -> str:
        return self._call("s3:PutObject", key, lambda: self.keep(key, body, None))

    def replace(self, key: str, body: bytes, etag: str) -> str:
        return self._call("s3:PutObject", key, lambda: self.keep(key, body, etag))

    def put(self, key: str, body: bytes) -> None:
        def effect() -> None:
            found = self.kept.get(key)
            self.keep(key, body, found[1] if found else None)

        self._call("s3:PutObject", key, effect)

    def list(self, prefix: str) -> Iterator[Entry]:
        after = ""
        while True:
            page = self._call("s3:ListObjectsV2", prefix, partial(self._page, prefix, after))
            yield from page[:PAGE]
            if len(page) <= PAGE:
                return
            after = page[PAGE - 1].key

    def delete(self, key: str) -> None:
        def effect() -> None:
            if self.kept.pop(key, None):
                del self._keys[bisect.bisect_left(self._keys, key)]

        self._call("s3:DeleteObject", key, effect)

    def _call(self, action: str, key: str, effect: Callable[[], T]) -> T:
        """One call, which is counted by what it is about, too."""
        if key.startswith(LOBBY) or key.endswith("/session.json"):
            self._cloud.lobby_calls[action] += 1
        return self._cloud.call(action, effect)

    def keep(self, key: str, body: bytes, etag: str | None = None) -> str:
        """A conditional write, made at once: `etag` None means that there must be nothing yet. Raises `Conflict`."""
        found = self.kept.get(key)
        if (found[1] if found else None) != etag:
            self._cloud.conflicts[key] += 1
            raise Conflict(key)
        if not found:
            bisect.insort(self._keys, key)
        made = f'"{hashlib.md5(body, usedforsecurity=False).hexdigest()}"'
        self.kept[key] = (body, made, self._cloud.clock.now().replace(microsecond=0))
        return made

    def _page(self, prefix: str, after: str) -> Sequence[Entry]:
        """The keys with this prefix that come after that one, up to one more than a page holds."""
        start = max(bisect.bisect_left(self._keys, prefix), bisect.bisect_right(self._keys, after))
        found = itertools.takewhile(lambda key: key.startswith(prefix), itertools.islice(self._keys, start, None))
        return [Entry(key, self.kept[key][2], len(self.kept[key][0])) for key in itertools.islice(found, PAGE + 1)]

    def _get(self, key: str, known: Document | None) -> Document | None:
        found = self.kept.get(key)
        if found is None:
            return None
        return known if known and known.etag == found[1] else Document(found[0], found[1])


@dataclass(repr=False)
class TimedTask(Task):
    """A task and when AWS does what with it, in seconds of the clock."""

    born: float = 0.0
    runs: float = 0.0  # when it is to run
    lag: float = 0.0  # seconds from then on until EC2 shows its address
    began: float | None = None
    closed: float | None = None  # when its container ended
    guests: int = 0  # connections so far
    interrupted: bool = False  # by Spot


def draws(seed: int, of: str) -> random.Random:
    """Chance for one kind of draw alone, so that AWS alone (`aws_bound.py`) draws the very same ones."""
    return random.Random(f"{seed} {of}")


def start_time(chance: random.Random, starts: tuple[float, float, float]) -> float:
    """Seconds that one task takes from RunTask to RUNNING."""
    median, sigma, longest = starts
    return min(longest, median * math.exp(chance.gauss(0, sigma)))


def address_lag(chance: random.Random, conditions: Conditions) -> float:
    """Seconds after RUNNING until EC2 shows the public address of one task.

    EC2 is "eventually consistent" (EC2 API Reference, "Troubleshooting API request errors"): an interface may not be
    found yet, or be there without its address (hashicorp/terraform-provider-aws issue 35568).
    """
    late = chance.random() < conditions.late_addresses
    return chance.uniform(*conditions.address_late) if late else 0.0


def propagation(chance: random.Random, conditions: Conditions, seed: int, seconds: float) -> float:
    """Seconds until a change is INSYNC that is made at that second.

    Route 53 is slow for a while, and then for every change, so that the second decides it: a caller that makes changes at
    other moments (`aws_bound.py`) meets the same slow spans. Of every ten spans (with a share of 0.1) one is slow.
    """
    slow = conditions.slow_zone and _is_slow(seed, round(1 / conditions.slow_zone), int(seconds // SLOW_FOR))
    return chance.uniform(*(conditions.slow_propagation if slow else conditions.propagation))


@cache
def _is_slow(seed: int, among: int, span: int) -> bool:
    """Whether Route 53 is slow in this span: one is, of so many."""
    return random.Random(f"{seed} slow zone {span // among}").randrange(among) == span % among


LOOKS = 20.0  # seconds between a warm server's looks for whose it has become


@dataclass
class Conditions:
    """How AWS behaves in this run: shares are of tasks or events."""

    repeated: float = 0.02  # events and messages that come twice
    late: float = 0.05  # events that come up to 20 s late, and so out of order
    lost: float = 0.0  # events that never come
    no_spot: Callable[[float], bool] = field(default=lambda seconds: False)  # whether Spot is sold out at that second
    interrupted: float = 0.0  # Spot tasks that are taken back
    interrupted_after: tuple[float, float] = (5.0, 600.0)  # seconds that those have run
    untold: float = 0.5  # of those, whose events have no stopCode: aws/containers-roadmap issues 1565 and 797
    late_addresses: float = 0.05  # tasks whose address EC2 does not show at once
    address_late: tuple[float, float] = ADDRESS_LATE
    stillborn: float = 0.0  # tasks that end before they run: an image that cannot be pulled
    starts: tuple[float, float, float] = STARTS
    propagation: tuple[float, float] = PROPAGATION
    slow_zone: float = SLOW_ZONE
    slow_propagation: tuple[float, float] = SLOW_PROPAGATION
    busy_zone: tuple[float, float] = BUSY_ZONE
    s3: tuple[float, float] = LATENCY["s3"]  # seconds of a call of S3
    idle: float = 600.0  # seconds a trial waits for its participant


class SimTasks:
    """ECS on Fargate, with EC2's addresses. `changed` gets every event; `trial` is told of tasks that run."""

    def __init__(self, cloud: Cloud, conditions: Conditions) -> None:
        self._cloud, self._conditions = cloud, conditions
        self._starts = draws(cloud.clock.seed, "starts")
        self._lags = draws(cloud.clock.seed, "addresses")
        self._untold = draws(cloud.clock.seed, "untold")
        self.tasks: dict[str, TimedTask] = {}
        self._by_token: dict[tuple[str, str, bool, str], TimedTask] = {}
        self._by_name: dict[str, list[TimedTask]] = {}
        self._by_host: dict[str, TimedTask] = {}
        self._by_interface: dict[str, TimedTask] = {}
        self._own_clusters: set[str] = set()
        self.changed: Callable[[Mapping[str, Any], float], None] = lambda event, delay: None
        self.interfaces = 0  # network interfaces that there are now, each with an address of a subnet
        self.most_interfaces = 0
        # Whose a warm server has become, or one of a session that is formed; empty until it can be told.
        self.owner: Callable[[TimedTask], str] = lambda task: ""

    def run(self, request: TaskRequest, attempts: int = ATTEMPTS) -> str:
        return self._cloud.call("ecs:RunTask", lambda: self._run(request), attempts).arn

    def stop(self, task: str, cluster: str, reason: str) -> None:
        self._cloud.call("ecs:StopTask", lambda: self.end(task, "UserInitiated", reason))

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        def effect() -> dict[str, Address]:
            living = [
                task for one in interfaces if (task := self._by_interface.get(one)) and task.last is not Life.STOPPED
            ]
            now = self._cloud.clock.seconds
            return {task.interface: Address(task.host) for task in living if now >= task.runs + task.lag}

        return self._cloud.call("ec2:DescribeNetworkInterfaces", effect) if interfaces else {}

    def find(self, name: str, cluster: str) -> str | None:
        def effect() -> str | None:
            return next((task.arn for task in self._by_name.get(name, ()) if task.desired is not Life.STOPPED), None)

        return self._cloud.call("ecs:ListTasks", effect)

    def list(self) -> Iterator[RunningTask]:
        living = self._cloud.call("ecs:ListTasks", lambda: [*self.living()])
        for page in range(0, len(living), 100):
            self._cloud.call("ecs:DescribeTasks", lambda: None)
            if page:
                self._cloud.call("ecs:ListTasks", lambda: None)
            yield from (
                RunningTask(t.arn, t.request.cluster, t.name, t.interface, t.last is Life.RUNNING)
                for t in living[page : page + 100]
            )

    def create_cluster(self, name: str) -> None:
        self._cloud.call("ecs:CreateCluster", lambda: self._own_clusters.add(name))

    def delete_cluster(self, name: str) -> None:
        def effect() -> None:
            if any(t.request.cluster == name and t.last is not Life.STOPPED for t in self.tasks.values()):
                raise Refused("ClusterContainsTasksException")
            self._own_clusters.discard(name)

        self._cloud.call("ecs:DeleteCluster", effect)

    def clusters(self) -> Iterator[str]:
        yield from self._cloud.call("ecs:ListClusters", lambda: sorted(self._own_clusters))

    # What AWS and trials do

    def living(self) -> Iterator[TimedTask]:
        """Tasks that are not stopped and were not told to."""
        return (task for task in self.tasks.values() if task.desired is not Life.STOPPED)

    def at(self, host: str) -> TimedTask | None:
        """The task that answers at that address."""
        task = self._by_host.get(host)
        return task if task and task.last is Life.RUNNING else None

    def end(self, arn: str, code: str | None, reason: str, exit_code: int | None = None) -> None:
        """Let a task go: told to stop, its container ended a little later, and the task stopped some time after."""
        task = self.tasks.get(arn)
        if task is None or task.desired is Life.STOPPED:
            return
        task.stop(code, reason, exit_code)
        self._tell(task)
        wait = self._cloud.clock.random.uniform(1, 8) if task.last is Life.RUNNING else 0.5
        self._cloud.clock.after(wait, lambda: self._deprovisioning(task))

    def _run(self, request: TaskRequest) -> TimedTask:
        key = (request.cluster, request.name, request.spot, request.nonce)
        if key in self._by_token:
            return self._by_token[key]
        clock, chance = self._cloud.clock, self._cloud.clock.random
        if not self._cloud.take("launch:spot" if request.spot else "launch:demand"):
            raise Throttled("launch rate")
        if request.spot and self._conditions.no_spot(clock.seconds):
            raise NoCapacity("Capacity is unavailable at this time.")
        number = len(self.tasks)
        host = f"198.{18 + number // 65536}.{number // 256 % 256}.{number % 256}"
        task = TimedTask(number, request, host, f"eni-{number:017x}", born=clock.seconds)
        self.tasks[task.arn] = self._by_token[key] = self._by_host[task.host] = self._by_interface[task.interface] = (
            task
        )
        self._by_name.setdefault(task.name, []).append(task)
        self.interfaces += 1
        self.most_interfaces = max(self.most_interfaces, self.interfaces)
        if self.interfaces > ADDRESSES:
            self.end(task.arn, "TaskFailedToStart", "The subnet does not have enough free addresses.")
            return task
        self._cloud.log(f"{task.name} is to run{'' if request.spot else ' on demand'}")
        starts = start_time(self._starts, self._conditions.starts)
        task.runs, task.lag = clock.seconds + starts, address_lag(self._lags, self._conditions)
        clock.after(starts, lambda: self._started(task))
        if request.spot and chance.random() < self._conditions.interrupted:
            clock.after(starts + chance.uniform(*self._conditions.interrupted_after), lambda: self._take_back(task))
        return task

    def _started(self, task: TimedTask) -> None:
        if task.desired is Life.STOPPED:
            return
        if self._cloud.clock.random.random() < self._conditions.stillborn:
            self.end(task.arn, "TaskFailedToStart", "CannotPullContainerError")
            return
        task.last, task.began = Life.RUNNING, self._cloud.clock.seconds
        self._cloud.log(f"{task.name} runs")
        self._tell(task)
        self._wait_for_guests(task)
        deadline = float(task.request.environment["DEADLINE"]) - EPOCH.timestamp()
        wait = deadline - self._cloud.clock.seconds
        self._cloud.clock.after(wait, lambda: self.end(task.arn, "EssentialContainerExited", "deadline", 0))

    def _wait_for_guests(self, task: TimedTask) -> None:
        """A warm server, or one of a session, is not idle until it knows who plays: it looks from time to time."""
        if (task.is_warm_server or task.session) and not self.owner(task):
            if task.last is Life.RUNNING:
                self._cloud.clock.after(LOOKS, lambda: self._wait_for_guests(task))
            return
        self._cloud.clock.after(self._conditions.idle, lambda: self._leave_if_alone(task))

    def _leave_if_alone(self, task: TimedTask) -> None:
        if not task.guests:
            self.end(task.arn, "EssentialContainerExited", "idle", 0)

    def _take_back(self, task: TimedTask) -> None:
        """Spot's warning is an event and SIGTERM, two minutes ahead; the trial stores what it has and ends well."""
        if task.desired is Life.STOPPED:
            return
        self._cloud.log(f"{task.name}: Spot interruption")
        task.interrupted = True
        code = None if self._untold.random() < self._conditions.untold else "SpotInterruption"
        self.end(task.arn, code, "Your Spot Task was interrupted.", 0)

    def _deprovisioning(self, task: TimedTask) -> None:
        task.last, task.closed = Life.DEPROVISIONING, self._cloud.clock.seconds
        self._cloud.log(f"{task.name} ended: {task.stop_code}")
        self._tell(task)
        self._cloud.clock.after(self._cloud.clock.random.uniform(*DEPROVISIONED), lambda: self._stopped(task))

    def _stopped(self, task: TimedTask) -> None:
        task.last = Life.STOPPED
        self.interfaces -= 1
        self._cloud.log(f"{task.name} stopped")
        self._tell(task)

    def _tell(self, task: TimedTask) -> None:
        """An ECS Task State Change event; the rule lets RUNNING, DEPROVISIONING and STOPPED through."""
        task.version += 1
        if task.last is Life.PROVISIONING:
            return
        chance = self._cloud.clock.random
        if self._conditions.lost and chance.random() < self._conditions.lost:
            self._cloud.log(f"{task.name}: an event is lost")
            return
        event = task.event()
        delay = chance.uniform(1, 20) if chance.random() < self._conditions.late else chance.uniform(0.2, 1.5)
        self.changed(event, delay)
        if chance.random() < self._conditions.repeated:
            self.changed(event, delay + chance.uniform(0.5, 30))


class SimDns:
    """A Route 53 zone: one change at a time, in sync after a while, deletions only with the present values."""

    def __init__(self, cloud: Cloud, conditions: Conditions) -> None:
        self._cloud, self._conditions = cloud, conditions
        self._propagation = draws(cloud.clock.seed, "propagation")
        self.records: dict[str, str] = {}
        self._in_sync: dict[str, float] = {}
        self._busy_until = 0.0
        self.strangers: dict[str, str] = {}
        self.most_records = 0
        self.spreads: dict[str, float] = {}  # seconds that the change of a name took to be everywhere

    def change(self, add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        changes = [(record, False) for record in remove] + [(record, True) for record in add]
        made = [self._change(changes[n : n + BATCH]) for n in range(0, len(changes), BATCH)]
        return ",".join(made)

    def in_sync(self, change: str) -> bool:
        return all(self._spread(part) for part in change.split(",") if part)

    def _spread(self, change: str) -> bool:
        try:
            return self._cloud.call("route53:GetChange", lambda: self._in_sync[change] <= self._cloud.clock.seconds)
        except Throttled as error:
            raise ServiceBusy from error

    def list(self) -> Iterator[DnsRecord]:
        found = self._cloud.call("route53:ListResourceRecordSets", lambda: sorted(self.records.items()))
        for _ in range(300, len(found), 300):
            self._cloud.call("route53:ListResourceRecordSets", lambda: None)
        yield from (DnsRecord(name, host) for name, host in found if ids.parse_server_name(name.split(".", 1)[0]))

    def browser_host(self, record: DnsRecord) -> str:
        return record.name

    def in_sync_at(self, change: str) -> float:
        """When a change is everywhere."""
        return self._in_sync[change]

    def _change(self, changes: Sequence[tuple[DnsRecord, bool]]) -> str:
        """One batch, as `hippodrome.aws.dns` makes it: with its patience where the zone is busy."""
        clock = self._cloud.clock
        add, remove = ([record for record, added in changes if added is kind] for kind in (True, False))
        return retry_while_busy(
            lambda: self._cloud.call("route53:ChangeResourceRecordSets", lambda: self.changed(add, remove)),
            lambda error: isinstance(error, Throttled),
            clock.sleep,
            clock.random.random,
            lambda: clock.seconds,
        )

    def changed(self, add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        """What Route 53 does with a change; its id.

        Raises `Throttled` while another one is on its way, and where the account has made too many changes lately.
        """
        clock, number = self._cloud.clock, 2 * len(add) + len(remove)
        if number > MAX_CHANGES:
            raise Refused("InvalidChangeBatch")
        if clock.seconds < self._busy_until:
            raise Throttled("PriorRequestNotComplete")
        if not self._cloud.take("route53:changes", number):
            raise Throttled("Rate exceeded")
        self._busy_until = clock.seconds + clock.random.uniform(*self._conditions.busy_zone)
        for record in remove:
            if self.records.get(record.name) == record.host:
                del self.records[record.name]
        self.records.update({record.name: record.host for record in add})
        self.most_records = max(self.most_records, len(self.records))
        change = f"C{len(self._in_sync)}"
        chance = self._propagation if add else clock.random  # no participant waits for a removal
        spread = propagation(chance, self._conditions, clock.seed, clock.seconds)
        self._in_sync[change] = clock.seconds + spread
        self.spreads.update({record.name: spread for record in add})
        return change


class SimTimers:
    """EventBridge Scheduler: fires within a minute after its time, and forgets the timer."""

    def __init__(self, cloud: Cloud, fire: Callable[[Message], None]) -> None:
        self._cloud, self._fire = cloud, fire
        self.due: dict[str, tuple[datetime, Message, int]] = {}
        self._set = 0

    def set(self, name: str, at: datetime, message: Message) -> None:
        def effect() -> None:
            self._set += 1
            number = self._set
            self.due[name] = (at, message, number)
            wait = (at - self._cloud.clock.now()).total_seconds() + self._cloud.clock.random.uniform(0, 60)
            self._cloud.clock.after(wait, lambda: self._ring(name, number))

        self._cloud.call("scheduler:CreateSchedule", effect)

    def cancel(self, name: str) -> None:
        self._cloud.call("scheduler:DeleteSchedule", lambda: self.due.pop(name, None))

    def list(self) -> Iterator[str]:
        found = self._cloud.call("scheduler:ListSchedules", lambda: sorted(self.due))
        for _ in range(100, len(found), 100):
            self._cloud.call("scheduler:ListSchedules", lambda: None)
        yield from found

    def _ring(self, name: str, number: int) -> None:
        if name in self.due and self.due[name][2] == number:
            self._fire(self.due.pop(name)[1])


SendLater = Callable[[Message, float, Lineage], None]


class SimBus:
    """SNS topics and the queue of `task_changed`."""

    def __init__(self, cloud: Cloud, deliver: Callable[[Topic, Message, Lineage], None], later: SendLater) -> None:
        self._cloud, self._deliver, self._later = cloud, deliver, later

    def publish(self, topic: Topic, message: Message) -> None:
        self._cloud.call("sns:Publish", lambda: self._deliver(topic, message, lineage()))

    def send_delayed(self, message: Message, seconds: int) -> None:
        self._cloud.call("sqs:SendMessage", lambda: self._later(message, float(seconds), lineage()))


class SimPlatform:
    """Implements `hippodrome.ports.Platform` on the simulated account."""

    def __init__(self, clock: GreenletClock, cloud: Cloud, settings: Settings, conditions: Conditions) -> None:
        self.clock, self.settings = clock, settings
        self.documents = SimDocuments(cloud)
        self.tasks = SimTasks(cloud, conditions)
        self.dns = SimDns(cloud, conditions)
        self.timers: SimTimers
        self.bus: SimBus

    def now(self) -> datetime:
        return self.clock.now()

    def run_all(self, acts: Sequence[Callable[[], T]]) -> list[T]:
        return self.clock.together(acts)
