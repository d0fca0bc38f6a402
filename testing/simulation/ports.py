"""The five ports on the simulated account, with AWS's delays, conflicts and limits."""

from __future__ import annotations

import bisect
import hashlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from functools import partial
from typing import TypeVar

from hippodrome.control.aws.dns import BATCH
from hippodrome.control.aws.retry import retry_while_busy
from hippodrome.control.model import ids
from hippodrome.control.ports import (
    Conflict,
    DnsRecord,
    Document,
    Entry,
    Message,
    Refused,
    ServiceBusy,
    Settings,
    Topic,
)
from testing.simulation.clock import GreenletClock
from testing.simulation.cloud import Cloud, Throttled
from testing.simulation.conditions import Conditions, draws, propagation
from testing.simulation.functions import Lineage, lineage
from testing.simulation.tasks import SimTasks

PAGE = 1000  # keys in one page of a listing: S3 API Reference, ListObjectsV2
MAX_CHANGES = 1000  # changes of a zone in one call, an UPSERT counts twice: Route 53 Developer Guide, "Quotas"
T = TypeVar("T")


class SimDocuments:
    """S3: strongly consistent, with conditional writes. Participants and trials use `kept` and `keep`, which are no calls.

    Reads and listings show every write that was answered before they began (S3 User Guide, "What is Amazon S3?", data
    consistency model). A write without a condition replaces the document. `LastModified` is cut to whole seconds
    (minio/minio-go issue 1632 and pull request 1638, tried on AWS). A listing is a call for every 1,000 keys (S3 API
    Reference, ListObjectsV2). It is no snapshot: later pages may show documents that were written after the first page.
    Deleting a missing document succeeds (the same reference, DeleteObject).
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
        return self._cloud.call(action, effect)

    def keep(self, key: str, body: bytes, etag: str | None = None) -> str:
        """Write at once if the document has this ETag (None: does not exist); return the new one. Raises Conflict."""
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
        """Return the entries with this prefix after the key `after`, up to one more than a page holds."""
        start = max(bisect.bisect_left(self._keys, prefix), bisect.bisect_right(self._keys, after))
        found = itertools.takewhile(lambda key: key.startswith(prefix), itertools.islice(self._keys, start, None))
        return [Entry(key, self.kept[key][2], len(self.kept[key][0])) for key in itertools.islice(found, PAGE + 1)]

    def _get(self, key: str, known: Document | None) -> Document | None:
        found = self.kept.get(key)
        if found is None:
            return None
        return known if known and known.etag == found[1] else Document(found[0], found[1])


class SimDns:
    """A Route 53 zone: one change at a time, in sync after some seconds. A removal needs the record's present value."""

    def __init__(self, cloud: Cloud, conditions: Conditions) -> None:
        self._cloud, self._conditions = cloud, conditions
        self._propagation = draws(cloud.clock.seed, "propagation")
        self.records: dict[str, str] = {}
        self._in_sync: dict[str, float] = {}
        self._busy_until = 0.0
        self.strangers: dict[str, str] = {}  # records that belong to no server of ours
        self.spreads: dict[str, float] = {}  # by name: the seconds until its change was in sync

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
        """Return the second at which a change is in sync."""
        return self._in_sync[change]

    def _change(self, changes: Sequence[tuple[DnsRecord, bool]]) -> str:
        """Make one batch of changes, and try again while the zone is busy, as `hippodrome.control.aws.dns` does."""
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
        """Carry out a change as Route 53 does, at once; return its id.

        Raises Throttled while the zone is busy with another change, or if the account has made too many changes;
        Refused if the batch is too large.
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
        change = f"C{len(self._in_sync)}"
        chance = self._propagation if add else clock.random  # `aws_bound.py` draws the times of additions again
        spread = propagation(chance, self._conditions, clock.seed, clock.seconds)
        self._in_sync[change] = clock.seconds + spread
        self.spreads.update({record.name: spread for record in add})
        return change


class SimTimers:
    """EventBridge Scheduler: it fires a timer within a minute after its time, and deletes it."""

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
    """Implements `hippodrome.control.ports.Platform` on the simulated account."""

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
