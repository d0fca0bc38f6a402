"""An AWS account in memory in which nothing happens by itself: tasks start, names settle and timers fire when told to.

Every call of a function goes through `Account.call`, where it may fail, be the function's last, lose its reply, or wait
there while other functions go on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Any, NamedTuple, TypeVar

from hippodrome.ports import Address, Message, NoCapacity, Refused, RunningTask, TaskRequest, Topic
from testing.aws_events import ACCOUNT, task_event
from testing.fake_platform import FakeDns, FakePlatform

T = TypeVar("T")


class Crash(BaseException):
    """The function is gone, between two of its lines. Nothing catches it."""


class Unreachable(ConnectionError):
    """The call was not made, or nobody knows whether it was."""


class Fault(StrEnum):
    ERROR = "is refused"
    REPLY = "is made and its reply lost"
    CRASH_BEFORE = "is never made: crash"
    CRASH_AFTER = "is the last: crash"
    WAIT = "is not made yet"


class Trouble(NamedTuple):
    """What happens to a function at the n-th call that it makes, from 1."""

    call: int
    fault: Fault

    def __repr__(self) -> str:
        return f"<call {self.call} {self.fault}>"


class Port:
    """A port each of whose methods is one call of the account."""

    def __init__(self, name: str, port: Any, call: Callable[[str, Sequence[Any], Callable[[], Any]], Any]) -> None:
        self._name, self._port, self._call = name, port, call

    def __getattr__(self, method: str) -> Any:
        act = getattr(self._port, method)
        if method == "browser_host":
            return act

        def call(*args: Any, **named: Any) -> Any:
            def effect() -> Any:
                result = act(*args, **named)
                return list(result) if isinstance(result, Iterator) else result

            given = [*args, *named.values()]
            found = self._call(f"{self._name}.{method}", given, effect)
            return iter(found) if isinstance(found, list) else found

        return call


@dataclass(repr=False)
class Task:
    """One Fargate task. `last` and `desired` are ECS's lastStatus and desiredStatus."""

    number: int
    arn: str
    request: TaskRequest = field(repr=False)
    listed: datetime = field(repr=False)
    last: str = "PROVISIONING"
    desired: str = "RUNNING"
    code: str | None = None
    reason: str = ""
    exit_code: int | None = None

    @property
    def name(self) -> str:
        return self.request.name

    @property
    def user(self) -> str:
        """Whose it was from the beginning; empty for a warm server."""
        return self.request.environment.get("USER_ID", "")

    @property
    def alive(self) -> bool:
        """Whether nobody and nothing has told it to stop."""
        return self.desired == "RUNNING"

    @property
    def ended(self) -> bool:
        """Whether its container runs no more."""
        return self.last in ("DEPROVISIONING", "STOPPED")

    @property
    def interface(self) -> str:
        return f"eni-{self.number}"

    @property
    def host(self) -> str:
        return f"198.51.100.{self.number}"

    def __repr__(self) -> str:
        return f"<task {self.number}, {self.user or 'a warm server'}: {self.last}{'' if self.alive else ', to stop'}>"

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        """What hypothesis prints."""
        printer.text(repr(self))

    def event(self) -> dict[str, Any]:
        """An ECS Task State Change event."""
        return task_event(
            self.arn,
            self.name,
            self.last,
            self.desired,
            cluster=self.request.cluster,
            interface=self.interface,
            stop_code=self.code,
            reason=self.reason,
            exit_code=self.exit_code,
        )


class Fleet:
    """ECS on Fargate, with EC2's addresses."""

    def __init__(self, account: Account) -> None:
        self._account = account
        self.tasks: dict[str, Task] = {}
        self.own_clusters: set[str] = set()
        self.spot = self.demand = "room"  # or "full", or "refused"
        self.lag = 0  # seconds until a new task is found by lists
        self.addresses_known = True
        self._by_token: dict[tuple[str, str, bool, str], str] = {}

    def run(self, request: TaskRequest) -> str:
        token = (request.cluster, request.name, request.spot, request.nonce)
        if token in self._by_token:
            return self._by_token[token]
        weather = self.spot if request.spot else self.demand
        if weather == "refused":
            raise Refused("ClientException: no such task definition")
        if weather == "full":
            raise NoCapacity("Capacity is unavailable at this time.")
        if request.cluster != self._account.settings.cluster and request.cluster not in self.own_clusters:
            raise Unreachable("ClusterNotFoundException")
        number = len(self.tasks) + 1
        arn = f"arn:aws:ecs:us-east-1:{ACCOUNT}:task/{request.cluster}/{number:032x}"
        listed = self._account.now() + timedelta(seconds=self.lag)
        self.tasks[arn] = Task(number, arn, request, listed)
        self._by_token[token] = arn
        self._account.tell(
            f"ECS: task {number} for {self._account.who(request.name)}, {'Spot' if request.spot else 'on demand'}"
        )
        return arn

    def stop(self, task: str, cluster: str, reason: str) -> None:
        if task in self.tasks:
            self.end(self.tasks[task], "UserInitiated", reason)

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        there = [task for task in self.tasks.values() if task.interface in interfaces and task.last == "RUNNING"]
        return {task.interface: Address(task.host, 5000) for task in there if self.addresses_known}

    def find(self, name: str, cluster: str) -> str | None:
        return next((t.arn for t in self._listed() if t.name == name and t.request.cluster == cluster), None)

    def list(self) -> Iterator[RunningTask]:
        return iter(
            [
                RunningTask(task.arn, task.request.cluster, task.name, task.interface, task.last == "RUNNING")
                for task in self._listed()
            ]
        )

    def create_cluster(self, name: str) -> None:
        self.own_clusters.add(name)

    def delete_cluster(self, name: str) -> None:
        if any(task.request.cluster == name and task.last != "STOPPED" for task in self.tasks.values()):
            raise Refused("ClusterContainsTasksException")
        self.own_clusters.discard(name)

    def clusters(self) -> Iterator[str]:
        return iter(sorted(self.own_clusters))

    def _listed(self) -> list[Task]:
        now = self._account.now()
        return [task for task in self.tasks.values() if task.alive and task.listed <= now]

    # What AWS and trials do

    def go_on(self, task: Task) -> None:
        """The task runs from now on; or its container has ended; or it has stopped."""
        following = {"PROVISIONING": "DEPROVISIONING", "RUNNING": "DEPROVISIONING", "DEPROVISIONING": "STOPPED"}
        task.last = "RUNNING" if task.alive else following[task.last]
        self._changed(task)

    def end(self, task: Task, code: str, reason: str, exit_code: int | None = None) -> None:
        """The task is told to stop, or begins to by itself; `go_on` does the rest."""
        if task.alive:
            task.desired, task.code, task.reason, task.exit_code = "STOPPED", code, reason, exit_code
            self._account.tell(f"ECS: task {task.number} is to stop: {reason or code}")
            self._changed(task)

    def _changed(self, task: Task) -> None:
        """EventBridge's rule lets these through."""
        if task.last != "PROVISIONING":
            self._account.send("tasks", task.event())


class Bus:
    """SNS's topics and the queue of `task_changed`."""

    def __init__(self, account: Account) -> None:
        self._account = account

    def publish(self, topic: Topic, message: Message) -> None:
        self._account.send(str(topic), message)

    def send_delayed(self, message: Message, seconds: int) -> None:
        assert 0 <= seconds <= 900
        self._account.send("tasks", message, seconds)


class Account(FakePlatform):
    """The platform that functions see (`documents`, `tasks` …), and what stands behind it (`kept`, `fleet`, `zone` …)."""

    def __init__(
        self,
        send: Callable[..., None],
        tell: Callable[[str], None],
        who: Callable[[str], str],
        call: Callable[[str, Sequence[Any], Callable[[], Any]], Any],
    ) -> None:
        super().__init__()
        self.send, self.tell, self.who = send, tell, who
        self.kept, self.due = self.documents.kept, self.timers.due
        self.put = self.documents.put
        self.fleet, self.zone = Fleet(self), FakeDns()
        self.zone.slow = True
        ports = {"documents": self.documents, "timers": self.timers, "bus": Bus(self)}
        for name, port in {**ports, "tasks": self.fleet, "dns": self.zone}.items():
            setattr(self, name, Port(name, port, call))
