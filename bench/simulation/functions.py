"""Lambda and SQS: containers that serve one event at a time, queues that deliver at least once, dead letters."""

from __future__ import annotations

import itertools
import json
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import greenlet

from bench.simulation.clock import Clock
from bench.simulation.cloud import Cloud, Crash
from hippodrome.platform import Platform
from lambdas import installed

COLD = (0.5, 1.0)  # seconds of a cold start; billed
POLL = (0.02, 0.2)  # seconds until a message that lies there is fetched
BATCHES, MORE_BATCHES = (
    5,
    5.0,
)  # that Lambda fetches at once from a standard queue at first; more each second of backlog
Handler = Callable[[dict[str, Any], object], Any]


@dataclass
class Container:
    """What a function keeps between its invocations: `lambdas.installed`'s objects."""

    platform: Platform
    made: dict[Any, Any] = field(default_factory=dict)
    ends: float = math.inf  # the second at which its present invocation times out


class Function:
    """One Lambda function. `billed` is seconds of all its invocations."""

    def __init__(self, name: str, handler: Handler, cloud: Cloud, platform: Platform, timeout: float) -> None:
        self.name, self._handler, self._cloud, self._platform = name, handler, cloud, platform
        self._clock, self._timeout = cloud.clock, timeout
        self._free: list[Container] = []
        self.containers = 0
        self.invocations = 0
        self.crashed = 0
        self.billed = 0.0
        self.longest = 0.0  # seconds of one invocation

    def invoke(self, event: dict[str, Any]) -> Any:
        """Run the handler, in the greenlet of the caller. Raises what it raises; a crash loses the container.

        Raises `Throttled` if the account has no concurrency left, and `Crash` when the function's timeout is over.
        """
        with self._cloud.invocation():
            return self._invoke(event)

    def _invoke(self, event: dict[str, Any]) -> Any:
        me: Any = greenlet.getcurrent()
        before = getattr(me, "owner", None)
        begun = self._clock.seconds
        self.invocations += 1
        if self._free:
            container = self._free.pop()
        else:
            container = Container(self._platform)
            self.containers += 1
            self._clock.sleep(self._clock.random.uniform(*COLD))
        container.ends = self._clock.seconds + self._timeout
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
            self.longest = max(self.longest, self._clock.seconds - begun)


def enter(owner: object) -> None:
    """What runs next runs in this container: its objects are those that `lambdas.installed` hands out."""
    if isinstance(owner, Container):
        installed._platform, installed._made = owner.platform, owner.made
    else:
        installed._platform, installed._made = None, {}


def ends(owner: object) -> float:
    """The second until which an invocation may run."""
    return owner.ends if isinstance(owner, Container) else math.inf


@dataclass
class Held:
    """A message in a queue."""

    number: int
    body: str
    receives: int = 0
    receipt: int = 0
    gone: bool = False


class Wire(NamedTuple):
    """Between a queue and its function: messages in a batch, seconds to gather them, invocations at once, and seconds
    until a message that failed comes again."""

    batch: int
    window: float
    concurrency: int
    visibility: float


class Queue:
    """An SQS standard queue with the event source mapping that empties it into a function."""

    def __init__(self, function: Function, clock: Clock, cloud: Cloud, wire: Wire, receives: int) -> None:
        self._function, self._clock, self._cloud = function, clock, cloud
        self._wire, self._receives = wire, receives
        self._visible: deque[Held] = deque()
        self._running = 0
        self._gathering = False
        self._backlog_since = 0.0  # since when the queue has not been empty
        self._numbers = itertools.count(1)
        self._receipts = itertools.count(1)
        self.sent = 0
        self.waiting = 0  # messages not yet gone
        self.dead: list[Held] = []

    def send(self, message: Mapping[str, Any], delay: float = 0.0) -> None:
        """A message, visible after `delay` seconds."""
        self.sent += 1
        self.waiting += 1
        held = Held(next(self._numbers), json.dumps(message))
        self._clock.after(delay, partial(self._show, held))

    def _show(self, held: Held) -> None:
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
        """Fetch a batch as soon as there is one, or the window is over."""
        if self._gathering or not self._visible or self._running >= self._wire.concurrency:
            return
        self._gathering = True
        full = len(self._visible) >= self._wire.batch
        wait = self._clock.random.uniform(*POLL) if full or not self._wire.window else self._wire.window
        self._clock.after(wait, self._fetch)

    def _fetch(self) -> None:
        """Many pollers at work: each takes a batch, as long as the mapping's concurrency has room.

        The pollers grow with the backlog (AWS Compute Blog, "Introducing faster polling scale-up for AWS Lambda
        functions configured with Amazon SQS", November 2023: 300 more invocations at once a minute, from 5).
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

    def _back(self, held: Held, receipt: int) -> None:
        """The visibility timeout is over and nobody has deleted it."""
        if not held.gone and held.receipt == receipt:
            self._show(held)

    def _serve(self, batch: list[Held]) -> None:
        event = {"Records": [{"messageId": str(held.number), "body": held.body} for held in batch]}
        try:
            answer = self._function.invoke(event) or {}
        except Crash:
            failed = {str(held.number) for held in batch}
        except Exception as error:  # noqa: BLE001 - as Lambda does: the whole batch comes again
            self._cloud.log(f"{self._function.name} failed: {type(error).__name__}")
            failed = {str(held.number) for held in batch}
        else:
            failed = {one["itemIdentifier"] for one in answer.get("batchItemFailures", [])}
        for held in batch:
            if str(held.number) not in failed and not held.gone:
                held.gone = True
                self.waiting -= 1
        self._running -= 1
        self._gather()
