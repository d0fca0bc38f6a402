"""The simulated APIs of AWS: every call has a latency, a quota, and a number at which a fault can be injected."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TypeVar

from testing import template
from testing.port_faults import FaultAt, call_with_fault
from testing.simulation.clock import GreenletClock

T = TypeVar("T")
ATTEMPTS = 3  # of botocore's standard mode, as hippodrome.control.aws.platform sets it
BACKOFF = 1.0  # seconds, doubled at each attempt; a call waits a random share of it


class Throttled(Exception):
    """Rate exceeded. The effect of a call may raise it, too. The call is tried again, as botocore does."""

    expected = True


class NoRoom(Throttled):
    """A function was not invoked, since the account has no concurrency left."""


@dataclass
class TokenBucket:
    """A token bucket: it admits `burst` calls at once, then `rate` calls per second."""

    rate: float
    burst: float
    tokens: float = field(init=False)
    since: float = 0.0

    def __post_init__(self) -> None:
        self.tokens = self.burst

    def take(self, now: float, number: int = 1) -> bool:
        """Take so many tokens, and return True; return False and take none if there are fewer."""
        self.tokens = min(self.burst, self.tokens + (now - self.since) * self.rate)
        self.since = now
        if self.tokens < number:
            return False
        self.tokens -= number
        return True


_REQUESTS = float(template.template()["Parameters"]["RequestsPerSecond"]["Default"])
QUOTAS: dict[str, tuple[float, float]] = {  # (sustained per second, burst)
    "http": (_REQUESTS, _REQUESTS),  # requests of the site: infra/template.yml
    "ecs:RunTask": (20, 20),  # ECS Developer Guide, "AWS Fargate throttling quotas"
    "ecs:StopTask": (40, 100),  # cluster resource modify actions, ECS "Request throttling"
    "ecs:DescribeTasks": (20, 100),
    "ecs:ListTasks": (20, 100),
    "route53": (10, 50),  # all actions of the account together: Route 53 Developer Guide, "Throttling for API requests"
    "route53:changes": (100, 1500),  # names, an UPSERT counts twice: the same guide, "Change throughput limiting"
    "ec2:DescribeNetworkInterfaces": (20, 100),
    "scheduler:CreateSchedule": (1000, 1000),
    "scheduler:DeleteSchedule": (1000, 1000),
    "launch:spot": (20, 100),  # Fargate launch rates, Spot and on demand apart
    "launch:demand": (20, 100),
}
CONCURRENCY = 1000  # invocations at once in an account, Lambda quotas; a new account may have 10
LATENCY: dict[str, tuple[float, float]] = {  # seconds, uniform: our assumption
    "s3": (0.015, 0.06),
    "sns": (0.015, 0.05),
    "sqs": (0.01, 0.03),
    "ecs:RunTask": (0.4, 1.2),
    "ecs": (0.08, 0.25),
    "ec2": (0.1, 0.3),
    "route53": (0.1, 0.4),
    "scheduler": (0.04, 0.12),
    "events": (0.04, 0.12),
}


class Cloud:
    """The account's APIs. Calls of functions are numbered; those of participants and trials are not, and take no time."""

    def __init__(
        self,
        clock: GreenletClock,
        concurrency: int = CONCURRENCY,
        latency: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    ) -> None:
        """`latency`: the entries that differ from `LATENCY`."""
        self.clock = clock
        self._latency = {**LATENCY, **latency}
        self.concurrency = concurrency
        self.dropped: Counter[str] = Counter()  # RecursiveInvocationsDropped, by function
        self.calls: Counter[str] = Counter()  # attempts by action, throttled ones included
        self.throttled: Counter[str] = Counter()
        self.conflicts: Counter[str] = Counter()  # conditional writes that were refused, by key
        self.number = 0  # the number of the functions' calls so far
        self.fault: FaultAt | None = None
        self.timeline: list[tuple[float, str]] = []
        self.invocations = 0  # invocations of all functions that run now
        self.most_invocations = 0  # the most that ran at once
        self._buckets = {name: TokenBucket(*quota) for name, quota in QUOTAS.items()}

    def log(self, text: str) -> None:
        """Add a line to the timeline."""
        self.timeline.append((self.clock.seconds, text))

    def call(self, action: str, effect: Callable[[], T], attempts: int = ATTEMPTS) -> T:
        """Make a call of a function, with its latency, its quota and its fault, and return what `effect` returns.

        Raises Throttled after so many attempts, and what `effect` and the fault raise.
        """
        self.number += 1
        fault = self.fault.fault if self.fault and self.fault.call == self.number else None
        if fault:
            self.log(f"  {action} {fault}")
        return call_with_fault(action, lambda: self._patiently(action, effect, attempts), fault)

    @contextlib.contextmanager
    def invocation(self) -> Iterator[None]:
        """Count an invocation as running within the block. Raises NoRoom if the account has no concurrency left."""
        if self.invocations >= self.concurrency:
            self.throttled["lambda:Invoke"] += 1
            raise NoRoom("lambda:Invoke")
        self.invocations += 1
        self.most_invocations = max(self.most_invocations, self.invocations)
        try:
            yield
        finally:
            self.invocations -= 1

    def take(self, bucket: str, number: int = 1) -> bool:
        """Take so much of the account's quota of this name, and return True; return False if less is left."""
        return self._buckets[bucket].take(self.clock.seconds, number)

    def _patiently(self, action: str, effect: Callable[[], T], attempts: int) -> T:
        """Make the call, and try again when it is throttled, as botocore's standard mode does."""
        for attempt in range(attempts):
            self.calls[action] += 1
            try:
                self._admit(action)
                self._wait(action)
                return effect()
            except Throttled:
                self.throttled[action] += 1
                if attempt + 1 == attempts:
                    raise
                self.clock.sleep(self.clock.random.random() * BACKOFF * 2**attempt)
        raise AssertionError

    def _admit(self, action: str) -> None:
        bucket = action if action in self._buckets else action.partition(":")[0]
        if bucket in self._buckets and not self.take(bucket):
            raise Throttled(action)

    def _wait(self, action: str) -> None:
        low, high = self._latency.get(action) or self._latency[action.partition(":")[0]]
        self.clock.sleep(self.clock.random.uniform(low, high))
