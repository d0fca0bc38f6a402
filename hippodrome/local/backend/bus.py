"""Queues on disk, and the threads that hand their messages to the functions: at least once, in batches, as SQS does.

A message is stored as a file before `publish` returns; the file is removed once its function has succeeded. The file's
name counts how often the message was received, so that a message that kills the process is given up too. A message that
failed because of this machine (a full disk, no more files) is never given up: it is delivered again until it succeeds.
Only the process that has locked the state folder writes here.
"""

from __future__ import annotations

import hashlib
import heapq
import json
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hippodrome.control.ports import Message, Topic
from hippodrome.local.backend import files
from hippodrome.local.backend.retry import Retry, reports_errors, start_thread
from hippodrome.protocol import disk

Handler = Callable[[dict[str, Any], object], Any]
Say = Callable[[str], None]

MAX_DELAY = 900  # seconds, as SQS
TASK = "task"  # the queue of `task_changed`: ECS events, and what `send_delayed` delays
QUEUES = (Topic.START.value, Topic.STOP.value, TASK)
BATCH = 10
WORKERS = 2  # threads for each queue: SQS calls a function with several batches at once, too
RETRY = (1, 2, 6, 24)
"""The seconds until a message that failed is delivered again: after its first failure, its second, and so on.

After one failure more than there are numbers, the message is put aside. A message that has to wait until a server has
stopped succeeds before that, since a server stops within the sum of these seconds.
"""


@dataclass(order=True)
class _QueuedMessage:
    """A message on its way; ordered by when it is due."""

    due: float
    sent: float
    id: str
    body: str = field(compare=False)
    received: int = field(default=0, compare=False)

    @property
    def file(self) -> str:
        return f"{self.id}.{self.received}.json"


class _Queue:
    """One queue: a folder, the messages by when they are due, and the threads that call the handler."""

    def __init__(self, name: str, folder: Path, dead: Path, *, handler: Handler | None, say: Say, retry: Retry) -> None:
        self.name = name
        self.handler = handler
        self._retry = retry
        self._folder = folder
        self._dead = dead
        self._say = say
        self._changed = threading.Condition()
        self._waiting: list[_QueuedMessage] = []
        self._busy = 0
        self._open = False
        self._threads: list[threading.Thread] = []
        disk.make_folder(folder)
        self._load()

    def _load(self) -> None:
        """Load the messages that an earlier process left; each is delivered when it is due. Raises OSError."""
        for name in files.names(self._folder, ".json"):
            path = self._folder / name
            stored = files.read_json(path)
            try:
                id_, received = name.removesuffix(".json").rsplit(".", 1)
                queued = _QueuedMessage(stored["due"], stored["sent"], id_, stored["body"], int(received))
            except (TypeError, KeyError, ValueError):
                self._say(f"a message in {path} cannot be read")
                continue
            heapq.heappush(self._waiting, queued)

    def put(self, message: Mapping[str, Any], seconds: float = 0) -> None:
        """Store a message; it is due in so many seconds. Raises OSError."""
        now = time.time()
        body = json.dumps(message, separators=(",", ":"))
        queued = _QueuedMessage(now + seconds, now, str(uuid.uuid4()), body)
        files.write_json(self._folder / queued.file, {"sent": queued.sent, "due": queued.due, "body": body})
        with self._changed:
            heapq.heappush(self._waiting, queued)
            self._changed.notify()

    def start(self) -> None:
        self._open = True
        while len(self._threads) < WORKERS:
            self._threads.append(start_thread(self._work, name=f"queue {self.name}"))

    @property
    def idle(self) -> bool:
        """Whether no due message waits and no handler runs."""
        with self._changed:
            due = self._open and bool(self._waiting) and self._waiting[0].due <= time.time()
            return not due and not self._busy

    def drain(self, until: float) -> bool:
        """Wait until the queue is idle, at most until `until` (monotonic); return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: self.idle, max(0.0, until - time.monotonic()))

    def take_all(self) -> list[Any]:
        """Remove all messages, and return them in the order in which they are due."""
        with self._changed:
            messages, self._waiting = sorted(self._waiting), []
        for queued in messages:
            (self._folder / queued.file).unlink(missing_ok=True)
        return [json.loads(queued.body) for queued in messages]

    def stop(self, until: float) -> None:
        """Deliver nothing more; wait for running handlers, at most until `until` (monotonic)."""
        with self._changed:
            self._open = False
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))

    def _work(self) -> None:
        while batch := self._take():
            try:
                self._deliver(batch)
            except Exception as error:  # noqa: BLE001 - the queue must go on, even with a full disk or without its folder
                self._retry.report(error)
                self._again(batch, counts=False)
            finally:
                with self._changed:
                    self._busy -= 1
                    self._changed.notify_all()

    def _take(self) -> list[_QueuedMessage]:
        """Wait for messages that are due, and return at most a batch of them; empty once the queue is stopped."""
        with self._changed:
            while self._open:
                wait = self._waiting[0].due - time.time() if self._waiting else None
                if wait is None or wait > 0:
                    # At most half a minute: the machine may sleep, and its clock may be set.
                    self._changed.wait(None if wait is None else min(wait, 30.0))
                    continue
                batch: list[_QueuedMessage] = []
                while self._waiting and len(batch) < BATCH and self._waiting[0].due <= time.time():
                    batch.append(heapq.heappop(self._waiting))
                self._busy += 1
                return batch
        return []

    def _deliver(self, batch: Sequence[_QueuedMessage]) -> None:
        """Call the function with these messages; remove each that succeeded, and deliver the others again later."""
        batch = [queued for queued in batch if self._count(queued)]
        if not batch:
            return
        failed = self._call(batch)
        # If this machine refused something lately, that may be the cause of the failure, even in another function.
        counts = not self._retry.reported_within(RETRY[-1])
        self._again([queued for queued in batch if queued.id in failed], counts=counts)
        done = [queued for queued in batch if queued.id not in failed]
        self._again([queued for queued in done if not self._remove(queued)], counts=False)

    def _remove(self, queued: _QueuedMessage) -> bool:
        """Remove the file of a message that has been handled; return False if this machine refuses that."""
        try:
            (self._folder / queued.file).unlink(missing_ok=True)
        except OSError as error:
            self._retry.report(error)
            return False
        return True

    def _count(self, queued: _QueuedMessage) -> bool:
        """Count one more receive in the file's name; return False if the file was removed. Raises OSError."""
        before, after = self._folder / queued.file, replace(queued, received=queued.received + 1).file
        try:
            before.rename(self._folder / after)
        except FileNotFoundError:
            self._say(f"the message in {before} is gone: another program removed it")
            return False
        queued.received += 1
        return True

    def _call(self, batch: Sequence[_QueuedMessage]) -> set[str]:
        """Call the function; return the ids of messages that failed: all if it raised or its answer is invalid."""
        everything = {queued.id for queued in batch}
        if self.handler is None:
            return everything
        try:
            answer = self.handler({"Records": [_record(queued, self.name) for queued in batch]}, None)
            failed = {item["itemIdentifier"] for item in (answer or {}).get("batchItemFailures") or ()}
        except Exception:  # noqa: BLE001 - as with SQS, the batch is delivered again after any error
            self._say(f"the function behind the {self.name} queue failed:\n{traceback.format_exc().rstrip()}")
            return everything
        return failed if failed <= everything else everything

    def _again(self, failed: Sequence[_QueuedMessage], *, counts: bool) -> None:
        """Deliver these again later. With `counts`, put a message aside that has been received too often."""
        for queued in failed:
            if counts and queued.received > len(RETRY) and self._put_aside(queued):
                continue
            queued.due = time.time() + RETRY[min(max(0, queued.received - 1), len(RETRY) - 1)]
            with self._changed:
                heapq.heappush(self._waiting, queued)
                self._changed.notify()

    def _put_aside(self, queued: _QueuedMessage) -> bool:
        """Move the message's file to the folder `dead`; return False if this machine refuses that."""
        try:
            disk.make_folder(self._dead)
            (self._folder / queued.file).rename(self._dead / queued.file)
        except OSError as error:
            self._retry.report(error)
            return False
        self._say(f"a message failed {queued.received} times and was put aside: {self._dead / queued.file}")
        return True


@reports_errors
class FolderBus:
    """Implements `control.ports.Bus`. `handlers` are the functions behind the queues `start`, `stop`, `task`."""

    def __init__(
        self, state: Path, handlers: Mapping[str, Handler], say: Say = print, retry: Retry | None = None
    ) -> None:
        """Raises OSError if messages cannot be read or stored in `state`."""
        self.retry = retry or Retry(say)
        self._queues = {
            name: _Queue(
                name,
                state / "queue" / name,
                state / "dead" / name,
                handler=handlers.get(name),
                say=say,
                retry=self.retry,
            )
            for name in QUEUES
        }

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
        """Stop delivering messages. Those that are left stay in their files."""
        until = time.monotonic() + seconds
        for queue in self._queues.values():
            queue.stop(until)


def _record(queued: _QueuedMessage, queue: str) -> dict[str, Any]:
    """The message as a record of an SQS event."""
    sent = str(int(queued.sent * 1000))
    return {
        "messageId": queued.id,
        "receiptHandle": queued.file,
        "body": queued.body,
        "attributes": {
            "ApproximateReceiveCount": str(queued.received),
            "SentTimestamp": sent,
            "SenderId": "local",
            "ApproximateFirstReceiveTimestamp": sent,
        },
        "messageAttributes": {},
        "md5OfBody": hashlib.md5(queued.body.encode(), usedforsecurity=False).hexdigest(),
        "eventSource": "aws:sqs",
        "eventSourceARN": f"arn:aws:sqs:local:000000000000:{queue}",
        "awsRegion": "local",
    }
