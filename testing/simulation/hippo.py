"""HIPPO Gym's AWS functions as their source has them, for comparison on the same simulated account.

Read in the repository IRLL/HIPPO_Gym_AWS (`start_server.py`, `stop_server.py`, `next_step.py`, August 2021), and
modelled call by call. `start_server` sets an EventBridge rule with a target as shutdown timer, makes a cluster of the
participant's own, and tries RunTask three times, 20 s apart. Then it looks three times for the task's address, 20 s
before each look, and gives up after the third. It makes one DNS change, and what that raises is swallowed. boto3's own
retries are those of its default, "legacy" mode: five attempts. SNS invokes the function asynchronously; a function that
raises is invoked again after one minute and after two more (Lambda Developer Guide, "Asynchronous invocation").

In HIPPO's favour: it gets functions without end, CreateCluster and PutRule have no rate quota here, and each name in
the zone counts as a server. When a task's address can be found decides much, since DNS changes that meet fail: soon,
with the network interface (`early`), or when the task runs. Both are modelled, and the better one is compared with.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from hippodrome.ports import DnsRecord, NoCapacity, TaskRequest
from testing.simulation.cloud import Throttled
from testing.simulation.tasks import TimedTask
from testing.simulation.world import SimulatedWorld
from testing.tasks import Life

TRIES, PAUSE = 3, 20.0  # of RunTask and of the look for an address; seconds
ATTEMPTS = 5  # of botocore's legacy mode
AGAIN = (60.0, 120.0)  # seconds until Lambda invokes a function again that has raised
ATTACHED = (5.0, 15.0)  # seconds from RunTask until the network interface has its address: our assumption
RULES = 300  # of an event bus: EventBridge quotas
ASSUMED = (
    f"the interface has its address {ATTACHED[0]:g} to {ATTACHED[1]:g} s after RunTask (our assumption); functions have "
    "no timeout, CreateCluster and PutRule no quota of rate, and who has a name has a server; the rest is its source "
    "(IRLL/HIPPO_Gym_AWS, August 2021)"
)


@dataclass
class HippoStart:
    """How one start went. Times are virtual seconds."""

    asked: float
    named: float | None = None
    ready: float | None = None  # when the DNS change is everywhere and the task runs
    billed: float = 0.0
    failed: str = ""


class Hippo:
    """The starts of one world."""

    def __init__(self, world: SimulatedWorld, *, early: bool) -> None:
        self._early = early
        self.world, self.clock, self.cloud = world, world.clock, world.cloud
        self.starts: list[HippoStart] = []
        self._rules: set[int] = set()

    def start(self, number: int) -> None:
        """One participant's `start_server`, with Lambda's further invocations of it. To be spawned."""
        made = HippoStart(self.clock.seconds)
        self.starts.append(made)
        for pause in (*AGAIN, None):
            begun = self.clock.seconds
            try:
                made.failed = ""
                self._start(number, made)
            except (Throttled, TooMany) as error:
                made.failed = f"{type(error).__name__}: {error}"
            made.billed += self.clock.seconds - begun
            if not made.failed.startswith(("Throttled", "TooMany")) or pause is None:
                return  # it returned: Lambda does not invoke it again
            self.clock.sleep(pause)

    def _start(self, number: int, made: HippoStart) -> None:
        self._call("s3:GetObject")
        self.cloud.call("events:PutRule", lambda: self._rule(number), ATTEMPTS)
        self._call("events:PutTargets")
        self._call("ecs:CreateCluster")
        task = self._run(number)
        if task is None:
            made.failed = "RunTask failed three times"
            return
        if not self._address(task):
            made.failed = "no address after a minute"
            return
        names = self.world.platform.dns
        name = f"{task.name}.example.org"
        try:
            change = self.cloud.call(
                "route53:ChangeResourceRecordSets", lambda: names.changed([DnsRecord(name, task.host)]), ATTEMPTS
            )
        except Throttled:
            made.failed = "the DNS change failed"
            return
        made.named = self.clock.seconds
        made.ready = max(names.in_sync_at(change), task.runs)

    def _call(self, action: str) -> None:
        self.cloud.call(action, lambda: None, ATTEMPTS)

    def _rule(self, number: int) -> None:
        if number not in self._rules and len(self._rules) >= RULES:
            raise TooMany("rules of the event bus")
        self._rules.add(number)

    def _run(self, number: int) -> TimedTask | None:
        environment = {"DEADLINE": str(self.clock.now().timestamp() + 3600)}
        request = TaskRequest(f"hippo{number}", "hippo", f"hippo{number}", 1, 2, environment)
        tasks = self.world.platform.tasks
        for _ in range(TRIES):
            try:
                return tasks.tasks[tasks.run(request, ATTEMPTS)]
            except (Throttled, NoCapacity):
                self.clock.sleep(PAUSE)
        return None

    def _address(self, task: TimedTask) -> bool:
        """Whether the address is found; each look is two calls."""
        there = task.born + self.clock.random.uniform(*ATTACHED) if self._early else task.runs
        for _ in range(TRIES):
            self.clock.sleep(PAUSE)
            self._call("ecs:DescribeTasks")
            if task.last in (Life.PROVISIONING, Life.RUNNING) and self.clock.seconds >= there:
                with contextlib.suppress(Throttled):  # what this look raises is swallowed, and the next look comes
                    self._call("ec2:DescribeNetworkInterfaces")
                    return True
        return False


class TooMany(Exception):
    """A quota that is no rate."""


# What a participant costs


def calls(steps: Mapping[str, str], *, start: str, stop: str, waits: int = 1) -> Iterator[tuple[str, str]]:
    """Every AWS call of one participant of HIPPO from the link to the clean-up: the function and the call.

    `steps` are the pages by step, `start` and `stop` the steps that publish. Each step is asked for once, and the game
    step `waits` more times while the server starts. The address is found at the first look.
    """
    for step, page in steps.items():
        for waiting in (*[True] * (waits if page == "game" else 0), False):
            yield from (
                ("next_step", call) for call in page_calls(page, publishes=step in (start, stop), waiting=waiting)
            )
    yield from (("start_server", call) for call in START_CALLS)
    yield from (("stop_server", call) for call in STOP_CALLS)


def page_calls(page: str, *, publishes: bool = False, waiting: bool = False) -> Iterator[str]:
    """One request of a step: the project list, the participant's record, the events, the page."""
    yield from ("s3:GetObject", "s3:GetObject", "s3:PutObject")
    if publishes:
        yield "sns:Publish"
    if page != "game":
        yield from ("s3:ListObjects", "s3:GetObject")
        return
    yield "route53:ListResourceRecordSets"
    if waiting:  # the step is counted back
        yield from ("s3:GetObject", "s3:PutObject")


START_CALLS = (
    "s3:GetObject", "events:PutRule", "events:PutTargets", "ecs:CreateCluster", "ecs:RunTask", "ecs:DescribeTasks",
    "ec2:DescribeNetworkInterfaces", "route53:ChangeResourceRecordSets",
)  # fmt: skip
STOP_CALLS = (
    "ecs:ListTasks", "ecs:StopTask", "ecs:DeleteCluster", "route53:ListResourceRecordSets",
    "route53:ChangeResourceRecordSets", "events:RemoveTargets", "events:DeleteRule",
)  # fmt: skip


class HippoRecord:
    """A participant's record as HIPPO keeps it: the event of every request is appended, and the whole is written."""

    def __init__(self) -> None:
        self.record: dict[str, Any] = {"created": "2026-11-21 14:46:40.123456+00:00", "nextStep": 1, "requests": []}

    def request(self, event: Mapping[str, Any]) -> int:
        """Take a request; the bytes written for it."""
        self.record["requests"].append(event)
        return len(json.dumps(self.record).encode())
