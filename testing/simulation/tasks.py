"""ECS on Fargate on the simulated account: the start and the end of tasks, and their events."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hippodrome.control.ports import (
    Address,
    NoCapacity,
    Refused,
    RunningTask,
    TaskRequest,
)
from testing import template
from testing.clock import EPOCH
from testing.simulation.cloud import ATTEMPTS, Cloud, Throttled
from testing.simulation.conditions import Conditions, address_lag, draws, start_time
from testing.tasks import Life, Task

DEPROVISIONED = (10.0, 35.0)  # seconds from the end of a task's container to STOPPED, without its network interface
ADDRESSES = sum(
    ipaddress.ip_network(subnet["CidrBlock"]).num_addresses
    - 5  # AWS reserves five in each subnet: VPC User Guide, "Subnet CIDR blocks"
    for subnet in template.resources("AWS::EC2::Subnet").values()
)
LOOKS = 20.0  # seconds until a server looks again whether it has a participant or a formed session


@dataclass(repr=False)
class TimedTask(Task):
    """A task with the times of its states, in seconds of the clock."""

    born: float = 0.0  # when RunTask was called
    runs: float = 0.0  # when it is to be RUNNING
    lag: float = 0.0  # seconds from RUNNING until EC2 shows its address
    began: float | None = None  # when it was RUNNING
    closed: float | None = None  # when its container ended
    guests: int = 0  # connections so far
    interrupted: bool = False  # whether Spot has taken it back


class SimTasks:
    """ECS on Fargate, with EC2's addresses. `changed` is called with every event and its delay in seconds."""

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
        self.started: Callable[[str], None] = lambda name: None  # called with the name of a server whose process runs
        self.interfaces = 0  # network interfaces that exist now, each with an address of a subnet
        # Returns the id of the participant or formed session to whom a server belongs; empty until there is one.
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

    # Events of AWS and of trials

    def living(self) -> Iterator[TimedTask]:
        """Yield the tasks that were not told to stop."""
        return (task for task in self.tasks.values() if task.desired is not Life.STOPPED)

    def at(self, host: str) -> TimedTask | None:
        """Return the running task with this address; None if there is none."""
        task = self._by_host.get(host)
        return task if task and task.last is Life.RUNNING else None

    def end(self, arn: str, code: str | None, reason: str, exit_code: int | None = None) -> None:
        """Stop a task: its desired status changes now, its container ends some seconds later, and then it is STOPPED."""
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
        self.started(task.name)
        self._wait_for_guests(task)
        deadline = float(task.request.environment["DEADLINE"]) - EPOCH.timestamp()
        wait = deadline - self._cloud.clock.seconds
        self._cloud.clock.after(wait, lambda: self.end(task.arn, "EssentialContainerExited", "deadline", 0))

    def _wait_for_guests(self, task: TimedTask) -> None:
        """End the task if no participant connects within `idle` seconds.

        A warm server or a session's server begins to count when it has a participant or a formed session.
        """
        if (task.is_warm_server or task.session) and not self.owner(task):
            if task.last is Life.RUNNING:
                self._cloud.clock.after(LOOKS, lambda: self._wait_for_guests(task))
            return
        self._cloud.clock.after(self._conditions.idle, lambda: self._leave_if_alone(task))

    def _leave_if_alone(self, task: TimedTask) -> None:
        if not task.guests:
            self.end(task.arn, "EssentialContainerExited", "idle", 0)

    def _take_back(self, task: TimedTask) -> None:
        """Interrupt a Spot task: AWS sends an event and SIGTERM two minutes ahead, and the trial ends with status 0."""
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
        """Send an "ECS Task State Change" event, unless the task is PROVISIONING: the template's rule takes no such event."""
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
