"""A model of how HIPPO Gym starts a server, for comparison on the same simulated account.

Written from its documentation: one function per participant sets an EventBridge rule as shutdown timer, makes a
cluster, runs a task, looks every 20 s whether it runs, and makes one DNS change; nothing is tried again beyond what
botocore does, and the function is billed while it sleeps. It gets warm functions without end, which it would not.
"""

from __future__ import annotations

from dataclasses import dataclass

from bench.simulation.cloud import Throttled
from bench.simulation.ports import Life, Task
from bench.simulation.world import World
from hippodrome.platform import NameRecord, NoCapacity, TaskRequest

POLL = 20.0  # seconds
LONGEST = 900.0  # seconds that a Lambda function may run
RULES = 300  # of an event bus, EventBridge quotas


@dataclass
class Start:
    """How one start went. Times are virtual seconds."""

    asked: float
    named: float | None = None
    ready: float | None = None  # when the DNS change is everywhere
    billed: float = 0.0
    failed: str = ""


class Hippo:
    """The starts of one world."""

    def __init__(self, world: World) -> None:
        self.world, self.clock, self.cloud = world, world.clock, world.cloud
        self.starts: list[Start] = []
        self._rules = 0

    def start(self, number: int) -> None:
        """One participant's `start_server`. To be spawned."""
        made = Start(self.clock.seconds)
        self.starts.append(made)
        try:
            self._start(number, made)
        except (Throttled, NoCapacity, TooMany, TooLong) as error:
            made.failed = type(error).__name__ + f": {error}"
        made.billed = self.clock.seconds - made.asked

    def _start(self, number: int, made: Start) -> None:
        self.cloud.call("events:PutRule", self._rule)
        self.cloud.call("ecs:CreateCluster", lambda: None)
        environment = {"DEADLINE": str(self.clock.now().timestamp() + 3600)}
        request = TaskRequest(f"hippo{number}", "hippo", f"hippo{number}", 1, 2, environment)
        tasks = self.world.platform.tasks
        task = tasks.tasks[tasks.run(request)]
        self._wait_for(task, made)
        names = self.world.platform.names
        change = self.cloud.call(
            "route53:ChangeResourceRecordSets",
            lambda: names.changed([NameRecord(f"{request.name}.example.org", task.host)]),
        )
        made.named = self.clock.seconds
        made.ready = names.in_sync_at(change)

    def _rule(self) -> None:
        if self._rules >= RULES:
            raise TooMany("rules of the event bus")
        self._rules += 1

    def _wait_for(self, task: Task, made: Start) -> None:
        while self.cloud.call("ecs:DescribeTasks", lambda: task.last) is not Life.RUNNING:
            if self.clock.seconds - made.asked > LONGEST:
                raise TooLong("the function's 15 minutes were over")
            self.clock.sleep(POLL)


class TooMany(Exception):
    """A quota that is no rate."""


class TooLong(Exception):
    """Lambda ended the function."""
