"""Queues in memory, and the threads that hand their messages to the functions: at least once, in batches, as SQS does.

A message that failed because of this machine (a full disk, no more files) is never given up: it is delivered again
until it succeeds. If the process is killed, its messages are lost. That loses nothing that cannot be made again: the
next start reports each server as lost (`platform.py`), the participants' pages ask again for what they wait for, and
the sweep does what is left.
"""

from __future__ import annotations

import heapq
import json
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hippodrome.control.ports import Message, Topic
from hippodrome.local.backend.retry import Retry, start_thread

Handler = Callable[[dict[str, Any], object], Any]
Say = Callable[[str], None]

MAX_DELAY = 900  # seconds, as SQS
TASK = "task"  # the queue of `task_changed`: ECS events, and what `send_delayed` delays
QUEUES = (Topic.START.value, Topic.STOP.value, TASK)
BATCH = 10
WORKERS = 2  # threads for each queue: SQS calls a function with several batches at once, too
RETRY = (1, 2, 6, 24)
"""The seconds until a message that failed is delivered again: after its first failure, its second, and so on.

After one failure more than there are numbers, the message is given up. A message that has to wait until a server has
stopped succeeds before that, since a server stops within the sum of these seconds.
"""


@dataclass(order=True)
class _QueuedMessage:
    """A message on its way; ordered by when it is due (`time.monotonic`)."""

    due: float
    id: str
    body: str = field(compare=False)
    received: int = field(default=0, compare=False)

    def record(self) -> dict[str, Any]:
        """The message as a record of an SQS event, with what the functions read of it."""
        return {
            "messageId": self.id,
            "body": self.body,
            "attributes": {"ApproximateReceiveCount": str(self.received)},
            "eventSource": "aws:sqs",
        }


class _Queue:
    """One queue: the messages by when they are due, and the threads that call the handler."""

    def __init__(self, name: str, handler: Handler | None, say: Say, retry: Retry) -> None:
        self.name = name
        self.handler = handler
        self._retry = retry
        self._say = say
        self._changed = threading.Condition()
        self._waiting: list[_QueuedMessage] = []
        self._busy = 0
        self._open = False
        self._threads: list[threading.Thread] = []

    def put(self, message: Mapping[str, Any], seconds: float = 0) -> None:
        """Deliver a message in so many seconds."""
        body = json.dumps(message, separators=(",", ":"))
        self._push(_QueuedMessage(time.monotonic() + seconds, str(uuid.uuid4()), body))

    def start(self) -> None:
        self._open = True
        while len(self._threads) < WORKERS:
            self._threads.append(start_thread(self._work, name=f"queue {self.name}"))

    @property
    def idle(self) -> bool:
        """Whether no due message waits and no handler runs."""
        with self._changed:
            return not self._busy and not (self._open and self._is_due())

    def drain(self, until: float) -> bool:
        """Wait until the queue is idle, at most until `until` (monotonic); return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: self.idle, max(0.0, until - time.monotonic()))

    def take_all(self) -> list[Any]:
        """Remove all messages, and return them in the order in which they are due."""
        with self._changed:
            messages, self._waiting = sorted(self._waiting), []
        return [json.loads(queued.body) for queued in messages]

    def stop(self, until: float) -> None:
        """Deliver nothing more; wait for running handlers, at most until `until` (monotonic)."""
        with self._changed:
            self._open = False
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))

    def _push(self, queued: _QueuedMessage) -> None:
        with self._changed:
            heapq.heappush(self._waiting, queued)
            self._changed.notify()

    def _is_due(self) -> bool:
        return bool(self._waiting) and self._waiting[0].due <= time.monotonic()

    def _work(self) -> None:
        while batch := self._take():
            failed = self._call(batch)
            # If this machine refused something lately, that may be the cause of the failure, even in another function.
            counts = not self._retry.reported_within(RETRY[-1])
            for queued in batch:
                if queued.id in failed:
                    self._again(queued, counts=counts)
            with self._changed:
                self._busy -= 1
                self._changed.notify_all()

    def _take(self) -> list[_QueuedMessage]:
        """Wait for messages that are due, and return at most a batch of them; empty once the queue is stopped."""
        with self._changed:
            while self._open:
                if not self._is_due():
                    self._changed.wait(self._waiting[0].due - time.monotonic() if self._waiting else None)
                    continue
                batch: list[_QueuedMessage] = []
                while self._is_due() and len(batch) < BATCH:
                    batch.append(heapq.heappop(self._waiting))
                self._busy += 1
                return batch
        return []

    def _call(self, batch: Sequence[_QueuedMessage]) -> set[str]:
        """Call the function; return the ids of messages that failed: all if it raised or its answer is invalid."""
        everything = {queued.id for queued in batch}
        for queued in batch:
            queued.received += 1
        try:
            answer = self.handler and self.handler({"Records": [queued.record() for queued in batch]}, None)
            failed = {item["itemIdentifier"] for item in (answer or {}).get("batchItemFailures") or ()}
        except Exception as error:  # noqa: BLE001 - as with SQS, the batch is delivered again after any error
            if isinstance(error, OSError):
                self._retry.report(error)
            else:
                self._say(f"the function behind the {self.name} queue failed:\n{traceback.format_exc().rstrip()}")
            return everything
        return failed if failed <= everything else everything

    def _again(self, queued: _QueuedMessage, *, counts: bool) -> None:
        """Deliver this message again later. With `counts`, give it up if it has been received too often."""
        if counts and queued.received > len(RETRY):
            self._say(f"a message to the function behind the {self.name} queue failed too often and was given up")
            return
        queued.due = time.monotonic() + RETRY[min(queued.received, len(RETRY)) - 1]
        self._push(queued)


class LocalBus:
    """Implements `control.ports.Bus`. `handlers` are the functions behind the queues `start`, `stop`, `task`."""

    def __init__(self, handlers: Mapping[str, Handler], say: Say = print, retry: Retry | None = None) -> None:
        retry = retry or Retry(say)
        self._queues = {name: _Queue(name, handlers.get(name), say, retry) for name in QUEUES}

    def publish(self, topic: Topic, message: Message) -> None:
        self._queues[topic.value].put(message)

    def send_delayed(self, message: Message, seconds: int) -> None:
        if not 0 <= seconds <= MAX_DELAY:
            raise ValueError(f"a message can be delivered 0 to {MAX_DELAY} seconds later, not {seconds}")
        self._queues[TASK].put(message, seconds)

    def emit(self, event: Mapping[str, Any]) -> None:
        """Deliver an event to `task_changed`, as EventBridge does."""
        self._queues[TASK].put(event)

    def start(self) -> None:
        """Begin to deliver messages."""
        for queue in self._queues.values():
            queue.start()

    def drain(self, seconds: float) -> bool:
        """Wait up to `seconds` until everything that is due has been handled; return whether it has."""
        until = time.monotonic() + seconds
        quiet = 0
        # A queue's function may publish to the other queues, so all must be idle in one round.
        while quiet < len(self._queues) and time.monotonic() < until:
            quiet = sum(queue.drain(until) and queue.idle for queue in self._queues.values())
        return quiet == len(self._queues)

    def take(self, queue: str) -> list[Any]:
        """Remove all messages from a queue, due or not, and return them. For tests."""
        return self._queues[queue].take_all()

    def close(self, seconds: float = 5.0) -> None:
        """Stop delivering messages."""
        until = time.monotonic() + seconds
        for queue in self._queues.values():
            queue.stop(until)
