"""The calls of HIPPO Gym's AWS functions on the same simulated account, for comparison.

The model follows the source, call by call: the repository IRLL/HIPPO_Gym_AWS (`start_server.py`, `stop_server.py`,
`next_step.py`, August 2021). `start_server` sets an EventBridge rule with a target as shutdown timer, creates a cluster
for the participant, and tries RunTask three times, 20 s apart. Then it looks for the task's address up to three times,
with a pause of 20 s before each look. It makes one DNS change, and ignores the exceptions of that call. boto3 makes
five attempts of each call, by its default mode, "legacy". SNS invokes the function asynchronously; Lambda invokes a
function that raises again after one minute and after two more (Lambda Developer Guide, "Asynchronous invocation").

The model favours HIPPO: its functions have no timeout and no limit of concurrency, CreateCluster and PutRule have no
rate quota, and each name in the zone counts as a server. The moment at which a task's address can be found matters,
since two DNS changes at the same time fail. It is either soon, with the network interface (`early`), or when the task
runs. Both are modelled, and the better one is the yardstick.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from hippodrome.ports import DnsRecord, NoCapacity, TaskRequest
from testing.simulation.aws_bound import ATTACHED
from testing.simulation.cloud import Throttled
from testing.simulation.tasks import TimedTask
from testing.simulation.world import SimulatedWorld
from testing.tasks import Life

TRIES, PAUSE = 3, 20.0  # tries of RunTask, and looks for the address; seconds between them
ATTEMPTS = 5  # attempts of botocore's legacy mode
AGAIN = (60.0, 120.0)  # seconds until Lambda invokes a function that has raised an exception again
RULES = 300  # rules of an event bus: EventBridge quotas
ASSUMED = (
    f"the interface has its address {ATTACHED[0]:g} to {ATTACHED[1]:g} s after RunTask (our assumption); functions have "
    "no timeout, CreateCluster and PutRule have no rate quota, and a name counts as a server; the rest follows its source "
    "(IRLL/HIPPO_Gym_AWS, August 2021)"
)


@dataclass
class HippoStart:
    """The outcome of one start. Times are virtual seconds."""

    asked: float
    named: float | None = None
    ready: float | None = None  # when the DNS change is in sync and the task runs
    billed: float = 0.0
    failed: str = ""


class Hippo:
    """Starts servers in one world in HIPPO's way. `early`: a task's address can be found before the task runs."""

    def __init__(self, world: SimulatedWorld, *, early: bool) -> None:
        self._early = early
        self.world, self.clock, self.cloud = world, world.clock, world.cloud
        self.starts: list[HippoStart] = []
        self._rules: set[int] = set()

    def start(self, number: int) -> None:
        """Do what HIPPO's `start_server` does for one participant; repeat it as Lambda does. Spawn it, since it waits."""
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
                return  # the function has returned, or this was its last invocation
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
        """Look for the task's address, and return whether it was found. A look is two calls if it finds the task."""
        there = task.born + self.clock.random.uniform(*ATTACHED) if self._early else task.runs
        for _ in range(TRIES):
            self.clock.sleep(PAUSE)
            self._call("ecs:DescribeTasks")
            if task.last in (Life.PROVISIONING, Life.RUNNING) and self.clock.seconds >= there:
                with contextlib.suppress(Throttled):  # the function ignores the exceptions of a look, and looks again
                    self._call("ec2:DescribeNetworkInterfaces")
                    return True
        return False


class TooMany(Exception):
    """A quota on how many things there may be was exceeded. `Throttled` is about quotas on calls per second."""


# The calls of one participant


def calls(steps: Mapping[str, str], *, start: str, stop: str, waits: int = 1) -> Iterator[tuple[str, str]]:
    """Yield every AWS call of one participant of HIPPO, from the link to the clean-up, as function and action.

    `steps` are the pages by step; the steps `start` and `stop` publish messages. Each step is requested once, and the
    game step `waits` more times while the server starts. The address is found at the first look.
    """
    for step, page in steps.items():
        for waiting in (*[True] * (waits if page == "game" else 0), False):
            actions = page_calls(page, publishes=step in (start, stop), waiting=waiting)
            yield from (("next_step", action) for action in actions)
    yield from (("start_server", action) for action in START_CALLS)
    yield from (("stop_server", action) for action in STOP_CALLS)


def page_calls(page: str, *, publishes: bool = False, waiting: bool = False) -> Iterator[str]:
    """Yield the AWS calls of one request of a step: project list, participant's record, messages, page."""
    yield from ("s3:GetObject", "s3:GetObject", "s3:PutObject")
    if publishes:
        yield "sns:Publish"
    if page != "game":
        yield from ("s3:ListObjects", "s3:GetObject")
        return
    yield "route53:ListResourceRecordSets"
    if waiting:  # the participant's record is set back by a step
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
    """A participant's record as HIPPO stores it: each request appends its event, and writes the whole record."""

    def __init__(self) -> None:
        self.record: dict[str, Any] = {"created": "2026-11-21 14:46:40.123456+00:00", "nextStep": 1, "requests": []}

    def request(self, event: Mapping[str, Any]) -> int:
        """Append a request; return the bytes that are written for it."""
        self.record["requests"].append(event)
        return len(json.dumps(self.record).encode())
