"""An AWS account in memory in which nothing happens by itself: the test starts tasks, settles names and fires timers.

Every call of a function goes through `Account.call`, where it may fail, be the function's last, lose its reply, or wait
while other functions go on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, TypeVar

from hippodrome.control.ports import Address, Message, NoCapacity, Refused, RunningTask, TaskRequest, Topic
from testing.fake_platform import FakeDns, FakePlatform
from testing.port_faults import Unreachable
from testing.tasks import Life, Task

T = TypeVar("T")


class Port:
    """A port: each of its methods is one call to the account."""

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
class ListedTask(Task):
    """A task that listings show from the time `listed` on."""

    listed: datetime = datetime.min

    def __repr__(self) -> str:
        return f"<task {self.number}, {self.user or 'a warm server'}: {self.last}{'' if self.alive else ', to stop'}>"

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        """Print the object in hypothesis's output."""
        printer.text(repr(self))


class Fleet:
    """ECS on Fargate, with EC2's addresses."""

    def __init__(self, account: Account) -> None:
        self._account = account
        self.tasks: dict[str, ListedTask] = {}
        self.own_clusters: set[str] = set()
        self.spot = self.demand = "room"  # "room", "full" or "refused"
        self.lag = 0  # seconds until listings show a new task
        self.addresses_known = True
        self._by_token: dict[tuple[str, str, bool, str], str] = {}

    def run(self, request: TaskRequest) -> str:
        token = (request.cluster, request.name, request.spot, request.nonce)
        if token in self._by_token:
            return self._by_token[token]
        conditions = self.spot if request.spot else self.demand
        if conditions == "refused":
            raise Refused("ClientException: no such task definition")
        if conditions == "full":
            raise NoCapacity("Capacity is unavailable at this time.")
        if request.cluster != self._account.settings.cluster and request.cluster not in self.own_clusters:
            raise Unreachable("ClusterNotFoundException")
        number = len(self.tasks) + 1
        listed = self._account.now() + timedelta(seconds=self.lag)
        task = ListedTask(number, request, f"198.51.100.{number}", f"eni-{number}", listed=listed)
        self.tasks[task.arn] = task
        self._by_token[token] = task.arn
        self._account.tell(
            f"ECS: task {number} for {self._account.who(request.name)}, {'Spot' if request.spot else 'on demand'}"
        )
        return task.arn

    def stop(self, task: str, cluster: str, reason: str) -> None:
        if task in self.tasks:
            self.end(self.tasks[task], "UserInitiated", reason)

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        there = [task for task in self.tasks.values() if task.interface in interfaces and task.last is Life.RUNNING]
        return {task.interface: Address(task.host, 5000) for task in there if self.addresses_known}

    def find(self, name: str, cluster: str) -> str | None:
        return next((t.arn for t in self._listed() if t.name == name and t.request.cluster == cluster), None)

    def list(self) -> Iterator[RunningTask]:
        return iter(
            [
                RunningTask(task.arn, task.request.cluster, task.name, task.interface, task.last is Life.RUNNING)
                for task in self._listed()
            ]
        )

    def create_cluster(self, name: str) -> None:
        self.own_clusters.add(name)

    def delete_cluster(self, name: str) -> None:
        if any(task.request.cluster == name and task.last is not Life.STOPPED for task in self.tasks.values()):
            raise Refused("ClusterContainsTasksException")
        self.own_clusters.discard(name)

    def clusters(self) -> Iterator[str]:
        return iter(sorted(self.own_clusters))

    def _listed(self) -> list[ListedTask]:
        now = self._account.now()
        return [task for task in self.tasks.values() if task.alive and task.listed <= now]

    # Actions of AWS and of trials

    def go_on(self, task: Task) -> None:
        """Move the task on: it runs, or its container has ended, or it has stopped."""
        if task.alive:
            task.last = Life.RUNNING
        else:
            task.last = Life.STOPPED if task.last is Life.DEPROVISIONING else Life.DEPROVISIONING
        self._changed(task)

    def end(self, task: Task, code: str, reason: str, exit_code: int | None = None) -> None:
        """Let the task begin to stop, by itself or on request; `go_on` does the rest."""
        if task.alive:
            task.stop(code, reason, exit_code)
            self._account.tell(f"ECS: task {task.number} is to stop: {reason or code}")
            self._changed(task)

    def _changed(self, task: Task) -> None:
        """Send the event, if EventBridge's rule selects it."""
        if task.last is not Life.PROVISIONING:
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
    """The platform that functions use (`documents`, `tasks` …), and the state behind it (`kept`, `fleet`, `zone` …)."""

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
