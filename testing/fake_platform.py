"""A platform in memory, with a clock that only tests move, for tests of the services.

It keeps the ports' contracts (see `tests/contract`). It delivers no message: tests pass published messages on.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, TypeVar

from hippodrome.control.model import ids
from hippodrome.control.ports import (
    Address,
    Conflict,
    DnsRecord,
    Document,
    Entry,
    Message,
    Refused,
    RunningTask,
    Settings,
    TaskRequest,
    Topic,
)

T = TypeVar("T")


class FakeDocuments:
    def __init__(self, world: FakePlatform) -> None:
        self.world = world
        self.kept: dict[str, tuple[bytes, str, datetime]] = {}
        self.versions = 0
        self.calls: list[str] = []
        self.before_write: list[Any] = []  # each write first removes and calls one of these: a faster writer

    def get(self, key: str, known: Document | None = None) -> Document | None:
        self.calls.append("get")
        found = self.kept.get(key)
        if found is None:
            return None
        return known if known and known.etag == found[1] else Document(found[0], found[1])

    def create(self, key: str, body: bytes) -> str:
        self.calls.append("put")
        self._interfere()
        if key in self.kept:
            raise Conflict(key)
        return self._write(key, body)

    def replace(self, key: str, body: bytes, etag: str) -> str:
        self.calls.append("put")
        self._interfere()
        if key not in self.kept or self.kept[key][1] != etag:
            raise Conflict(key)
        return self._write(key, body)

    def list(self, prefix: str) -> Iterator[Entry]:
        self.calls.append("list")
        for key in sorted(self.kept):
            if key.startswith(prefix):
                yield Entry(key, self.kept[key][2], len(self.kept[key][0]))

    def delete(self, key: str) -> None:
        self.calls.append("delete")
        self.kept.pop(key, None)

    def put(self, key: str, body: bytes) -> None:
        """Write without conditions; the call is counted."""
        self.calls.append("put")
        self._interfere()
        self._write(key, body)

    def keep(self, key: str, body: bytes) -> None:
        """Write as another process does: the call is not in `calls`, and no function of `before_write` is called."""
        self._write(key, body)

    def _interfere(self) -> None:
        if self.before_write:
            self.before_write.pop(0)()

    def _write(self, key: str, body: bytes) -> str:
        self.versions += 1
        etag = f'"{hashlib.md5(body, usedforsecurity=False).hexdigest()}-{self.versions}"'
        self.kept[key] = (body, etag, self.world.now())
        return etag


class FakeTasks:
    def __init__(self) -> None:
        self.running: dict[str, TaskRequest] = {}
        self.by_name: dict[tuple[str, bool], str] = {}
        self.stopped: dict[str, str] = {}
        self.own_clusters: set[str] = set()
        self.pending: set[str] = set()  # tasks that do not run yet
        self.fail: list[Exception] = []  # the next calls of `run` raise these
        self.fail_stops: list[Exception] = []  # the next calls of `stop` raise these

    def run(self, request: TaskRequest) -> str:
        if self.fail:
            raise self.fail.pop(0)
        if (request.name, request.spot) not in self.by_name:
            task = f"arn:aws:ecs:us-east-1:123456789012:task/{request.cluster}/{len(self.by_name):032x}"
            self.by_name[request.name, request.spot] = task
            self.running[task] = request
        return self.by_name[request.name, request.spot]

    def stop(self, task: str, cluster: str, reason: str) -> None:
        if self.fail_stops:
            raise self.fail_stops.pop(0)
        if self.running.pop(task, None):
            self.stopped[task] = reason

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        return {i: Address(f"203.0.113.{sum(i.encode()) % 250}", 5000) for i in interfaces if not i.endswith("bare")}

    def find(self, name: str, cluster: str) -> str | None:
        return next((t for t, r in self.running.items() if r.name == name and r.cluster == cluster), None)

    def list(self) -> Iterator[RunningTask]:
        tasks = self.running.items()
        return iter([RunningTask(t, r.cluster, r.name, "eni-" + t[-17:], t not in self.pending) for t, r in tasks])

    def create_cluster(self, name: str) -> None:
        self.own_clusters.add(name)

    def delete_cluster(self, name: str) -> None:
        if not ids.parse_server_name(name):  # what the functions' policies allow (infra/template.yml)
            raise Refused("AccessDeniedException")
        if any(r.cluster == name for r in self.running.values()):
            raise Refused("ClusterContainsTasksException")
        self.own_clusters.discard(name)

    def clusters(self) -> Iterator[str]:
        return iter(sorted(self.own_clusters))


class FakeDns:
    def __init__(self) -> None:
        self.records: dict[str, str] = {}
        self.changes = 0
        self.pending: set[str] = set()
        self.slow = False  # whether changes are in sync only after `settle`

    def change(self, add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        for record in remove:
            if self.records.get(record.name) == record.host:
                del self.records[record.name]
        for record in add:
            self.records[record.name] = record.host
        self.changes += 1
        if not self.slow:
            return ""
        self.pending.add(f"C{self.changes}")
        return f"C{self.changes}"

    def settle(self) -> None:
        """Let all changes be in sync."""
        self.pending.clear()

    def in_sync(self, change: str) -> bool:
        return change not in self.pending

    def list(self) -> Iterator[DnsRecord]:
        return iter([DnsRecord(n, h) for n, h in self.records.items()])

    def browser_host(self, record: DnsRecord) -> str:
        return record.name


class FakeTimers:
    def __init__(self) -> None:
        self.due: dict[str, tuple[datetime, Message]] = {}

    def set(self, name: str, at: datetime, message: Message) -> None:
        self.due[name] = (at, message)

    def cancel(self, name: str) -> None:
        self.due.pop(name, None)

    def list(self) -> Iterator[str]:
        return iter(sorted(self.due))


class FakeBus:
    def __init__(self) -> None:
        self.sent: list[tuple[Topic, Message]] = []
        self.delayed: list[tuple[int, Message]] = []

    def publish(self, topic: Topic, message: Message) -> None:
        self.sent.append((topic, message))

    def send_delayed(self, message: Message, seconds: int) -> None:
        if not 0 <= seconds <= 900:
            raise ValueError(seconds)
        self.delayed.append((seconds, message))


class FakePlatform:
    """The five ports in memory. Tests set `clock`, or move it with `wait`."""

    def __init__(self) -> None:
        self.settings = Settings(
            bucket="bucket",
            root_domain="example.org",
            servers_host="servers",
            max_runtime=120,
            game_sources="wss://*.example.org:*",
        )
        self.clock = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)
        self.documents = FakeDocuments(self)
        self.tasks = FakeTasks()
        self.dns = FakeDns()
        self.timers = FakeTimers()
        self.bus = FakeBus()

    def now(self) -> datetime:
        return self.clock

    def run_all(self, acts: Sequence[Callable[[], T]]) -> list[T]:
        return [act() for act in acts]

    def wait(self, **time: float) -> None:
        """Move the clock by `timedelta(**time)`."""
        self.clock += timedelta(**time)
