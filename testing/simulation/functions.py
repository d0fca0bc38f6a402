"""Simulated Lambda functions and SQS queues: one event at a time in each container, and delivery at least once.

**Loops** (Lambda Developer Guide, "Use Lambda recursive loop detection to prevent infinite loops"). Each message that a
function sends to SQS or SNS carries how often each function has been invoked in its chain of requests. When a function
has been invoked about 16 times in one chain, Lambda refuses its next invocation with RecursiveInvocationException,
unless the function has `RecursiveLoop: Allow`; the metric RecursiveInvocationsDropped counts the refusals. For the
poller of a queue, a refusal is a failure: it costs a receive, and the message comes again after its visibility timeout.
It is refused again, and becomes a dead letter when its receives are used up. A batch inherits the highest count of its
messages, and each message that is sent while the batch is served inherits it, too. (The guide does not say what a batch
inherits; this is the worst possible case.) Events of ECS and the Scheduler begin a new chain here, since the guide
names neither.

**Throttling** (the same guide, "Backoff strategy for failed invocations"). A mapping with MaximumConcurrency fetches no
more messages than it may pass on, but the account may have no concurrency left for them. Then Lambda tries the batch
again until its visibility timeout is over, and drops it. Users report that its messages then come back with one receive
less (Z. Charles, "Lambda Concurrency Limits and SQS Triggers Don't Mix Well", 2019, and "Does Maximum Concurrency Solve
the Lambda+SQS Issue?", 2023). The simulation does not try the batch again within the visibility timeout, which is the
worst possible case. An asynchronous invocation, such as EventBridge's, waits in Lambda's own queue instead; Lambda
tries it again after 1 s, 2 s, 4 s … (the same guide, "How Lambda handles errors and retries with asynchronous
invocation").
"""

from __future__ import annotations

import itertools
import json
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import greenlet

from hippodrome.control.ports import Platform
from hippodrome.functions import installed
from testing import aws_events
from testing.port_faults import Crash
from testing.simulation.clock import GreenletClock
from testing.simulation.cloud import Cloud, NoRoom

COLD = (0.5, 1.0)  # seconds of a cold start; billed
POLL = (0.02, 0.2)  # seconds until a visible message is fetched
BATCHES = 5  # invocations at once that Lambda begins with for a standard queue
MORE_BATCHES = 5.0  # further invocations at once for each second of backlog
HOPS = 16  # allowed invocations of one function in a chain of requests
ASYNC = (1.0, 300.0)  # seconds until Lambda tries an asynchronous invocation again: the first time, and at most
Handler = Callable[[dict[str, Any], object], Any]
Lineage = Mapping[str, int]  # how often each function has been invoked in a chain of requests
NO_LINEAGE: Lineage = MappingProxyType({})


class Recursive(Exception):
    """RecursiveInvocationException: a function was invoked too often in one chain of requests."""


@dataclass
class Container:
    """An execution environment: the objects of `hippodrome.functions.installed` that a function keeps between its invocations."""

    platform: Platform
    made: dict[Any, Any] = field(default_factory=dict)
    ends: float = math.inf  # the second at which its present invocation times out
    lineage: Lineage = field(default_factory=dict)  # the lineage of its present invocation


class SimulatedFunction:
    """One Lambda function. `billed` are the seconds of all its invocations."""

    def __init__(
        self, name: str, handler: Handler, cloud: Cloud, platform: Platform, timeout: float, *, loops: bool = False
    ) -> None:
        """`timeout` is in seconds. `loops`: whether it has `RecursiveLoop: Allow`."""
        self.name, self._handler, self._cloud, self._platform = name, handler, cloud, platform
        self._loops = loops
        self._clock, self._timeout = cloud.clock, timeout
        self._free: list[Container] = []
        self.invocations = 0
        self.crashed = 0  # invocations that ended by a crash or a timeout
        self.billed = 0.0

    def invoke(self, event: dict[str, Any], lineage: Lineage = NO_LINEAGE) -> Any:
        """Run the handler in the greenlet of the caller, and return its answer. A crash loses the container.

        Raises what the handler raises; NoRoom if the account has no concurrency left; Crash when the function times
        out; and Recursive if the event's chain of requests has invoked it too often.
        """
        times = lineage.get(self.name, 0) + 1
        if times > HOPS and not self._loops:
            self._cloud.dropped[self.name] += 1
            raise Recursive(self.name)
        with self._cloud.invocation():
            return self._invoke(event, {**lineage, self.name: times})

    def later(self, event: dict[str, Any]) -> None:
        """Invoke as asynchronous callers do: wait while there is no concurrency left. Raises what `invoke` raises.

        Call it in a greenlet of its own (`Clock.spawn`), since it waits.
        """
        wait, longest = ASYNC
        while True:
            try:
                self.invoke(event)
            except NoRoom:
                self._clock.sleep(wait)
                wait = min(longest, 2 * wait)
            else:
                return

    def _invoke(self, event: dict[str, Any], lineage: Lineage) -> Any:
        me: Any = greenlet.getcurrent()
        before = getattr(me, "owner", None)
        begun = self._clock.seconds
        self.invocations += 1
        if self._free:
            container = self._free.pop()
        else:
            container = Container(self._platform)
            self._clock.sleep(self._clock.random.uniform(*COLD))
        container.ends, container.lineage = self._clock.seconds + self._timeout, lineage
        me.owner = container
        enter(container)
        try:
            answer = self._handler(event, None)
        except Crash as error:
            self.crashed += 1
            self._cloud.log(f"{self.name}: {error}")
            raise
        except Exception:
            self._free.append(container)
            raise
        else:
            self._free.append(container)
            return answer
        finally:
            me.owner = before
            enter(before)
            self.billed += self._clock.seconds - begun


def enter(owner: object) -> None:
    """Let `hippodrome.functions.installed` use the objects of this container; if the owner is no container, it gets no objects."""
    if isinstance(owner, Container):
        installed._platform, installed._made = owner.platform, owner.made
    else:
        installed._platform, installed._made = None, {}


def lineage() -> Lineage:
    """Return the lineage of a message that is sent now: the present invocation's, if there is one."""
    owner = getattr(greenlet.getcurrent(), "owner", None)
    return owner.lineage if isinstance(owner, Container) else NO_LINEAGE


def together(lineages: Iterable[Lineage]) -> Lineage:
    """Return the lineage of a batch: the highest count of each function."""
    found: dict[str, int] = {}
    for one in lineages:
        for name, times in one.items():
            found[name] = max(times, found.get(name, 0))
    return found


def ends(owner: object) -> float:
    """Return the second at which the owner's invocation times out; infinity if the owner is no container."""
    return owner.ends if isinstance(owner, Container) else math.inf


@dataclass
class HeldMessage:
    """A message in a queue. `receipt` is the number of its latest receive. `deleted`: whether it was deleted."""

    number: int
    body: str
    lineage: Lineage = field(default_factory=dict)
    receives: int = 0
    receipt: int = 0
    deleted: bool = False


class Wire(NamedTuple):
    """An event source mapping: messages in a batch, seconds to gather them, invocations at once, visibility timeout (s)."""

    batch: int
    window: float
    concurrency: int
    visibility: float


class SimulatedQueue:
    """An SQS standard queue with the event source mapping that passes its messages to a function.

    `receives` is how often a message is received before it becomes a dead letter.
    """

    def __init__(
        self, function: SimulatedFunction, clock: GreenletClock, cloud: Cloud, wire: Wire, receives: int
    ) -> None:
        self._function, self._clock, self._cloud = function, clock, cloud
        self._wire, self._receives = wire, receives
        self._visible: deque[HeldMessage] = deque()
        self._running = 0
        self._gathering = False
        self._backlog_since = 0.0  # the second since which there has been a backlog
        self._numbers = itertools.count(1)
        self._receipts = itertools.count(1)
        self.sent = 0
        self.waiting = 0  # messages that are neither deleted nor dead letters
        self.dead: list[HeldMessage] = []

    def send(self, message: Mapping[str, Any], delay: float = 0.0, lineage: Lineage = NO_LINEAGE) -> None:
        """Send a message that is visible after `delay` seconds."""
        self.sent += 1
        self.waiting += 1
        held = HeldMessage(next(self._numbers), json.dumps(message), lineage)
        self._clock.after(delay, partial(self._show, held))

    def _show(self, held: HeldMessage) -> None:
        if held.receives >= self._receives:
            self.waiting -= 1
            self.dead.append(held)
            self._cloud.log(f"dead letter of {self._function.name}")
            return
        if not self._visible and not self._running:
            self._backlog_since = self._clock.seconds
        self._visible.append(held)
        self._gather()

    def _gather(self) -> None:
        """Arrange the next fetch: soon if a batch is full, else after the window."""
        if self._gathering or not self._visible or self._running >= self._wire.concurrency:
            return
        self._gathering = True
        full = len(self._visible) >= self._wire.batch
        wait = self._clock.random.uniform(*POLL) if full or not self._wire.window else self._wire.window
        self._clock.after(wait, self._fetch)

    def _fetch(self) -> None:
        """Start an invocation for each batch, as long as the mapping's concurrency allows more.

        The number of pollers grows with the backlog (AWS Compute Blog, "Introducing faster polling scale-up for AWS
        Lambda functions configured with Amazon SQS", November 2023: 300 more invocations at once a minute, from 5).
        """
        self._gathering = False
        backlog = self._clock.seconds - self._backlog_since
        room = min(self._wire.concurrency, BATCHES + int(backlog * MORE_BATCHES))
        while self._visible and self._running < room:
            batch = [self._visible.popleft() for _ in range(min(self._wire.batch, len(self._visible)))]
            for held in batch:
                held.receives += 1
                held.receipt = next(self._receipts)
                self._clock.after(self._wire.visibility, partial(self._back, held, held.receipt))
            self._running += 1
            self._clock.spawn(partial(self._serve, batch))
        self._gather()

    def _back(self, held: HeldMessage, receipt: int) -> None:
        """Show the message again after its visibility timeout, unless it was deleted or received again."""
        if not held.deleted and held.receipt == receipt:
            self._show(held)

    def _serve(self, batch: list[HeldMessage]) -> None:
        event = aws_events.queue_event([held.body for held in batch], [str(held.number) for held in batch])
        try:
            answer = self._function.invoke(event, together(held.lineage for held in batch)) or {}
        except Crash:
            failed = {str(held.number) for held in batch}
        except Exception as error:  # noqa: BLE001 - as with Lambda, the whole batch comes again
            self._cloud.log(f"{self._function.name} failed: {type(error).__name__}")
            failed = {str(held.number) for held in batch}
        else:
            failed = {one["itemIdentifier"] for one in answer.get("batchItemFailures", [])}
        for held in batch:
            if str(held.number) not in failed and not held.deleted:
                held.deleted = True
                self.waiting -= 1
        self._running -= 1
        self._gather()
