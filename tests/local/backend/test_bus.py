"""Queues: real-shaped batches, retries, and messages that are given up."""

from __future__ import annotations

import errno
import json
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import pytest

from hippodrome.control.ports import Topic
from hippodrome.local.backend import bus as bus_module
from hippodrome.local.backend.bus import LocalBus
from hippodrome.local.backend.retry import Retry
from testing.waiting import until

Event = dict[str, Any]
QUICK = (0.02, 0.02, 0.02, 0.02)


class Functions:
    """Handlers that record their batches, and return what a test sets."""

    def __init__(self, answer: Callable[[Event], Any] = lambda event: None) -> None:
        self.events: list[Event] = []
        self.answer = answer
        self.came = threading.Condition()

    def handler(self, event: Event, context: object) -> Any:
        try:
            return self.answer(event)
        finally:
            with self.came:
                self.events.append(event)
                self.came.notify_all()

    def bodies(self) -> list[Any]:
        return [json.loads(record["body"]) for event in self.events for record in event["Records"]]

    def wait(self, count: int, seconds: float = 60) -> None:
        """Wait until the handlers have received so many records."""
        with self.came:
            assert self.came.wait_for(lambda: len(self.bodies()) >= count, seconds), self.bodies()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus_module, "RETRY", QUICK)


@pytest.fixture
def made() -> Iterator[list[LocalBus]]:
    buses: list[LocalBus] = []
    yield buses
    for bus in buses:
        bus.close(2)


def _bus(made: list[LocalBus], said: list[str] | None = None, **functions: Functions) -> LocalBus:
    handlers = {name: function.handler for name, function in functions.items()}
    bus = LocalBus(handlers, (said if said is not None else []).append)
    made.append(bus)
    return bus


def test_a_message_arrives_as_an_sqs_batch(made: list[LocalBus]) -> None:
    start = Functions()
    bus = _bus(made, start=start)
    bus.publish(Topic.START, {"userId": "Zoë"})
    bus.start()
    start.wait(1)
    [record] = start.events[0]["Records"]
    assert json.loads(record["body"]) == {"userId": "Zoë"}
    assert record["eventSource"] == "aws:sqs"
    assert record["attributes"]["ApproximateReceiveCount"] == "1"
    assert record["messageId"]
    assert bus.drain(20)


def test_no_message_is_taken_while_it_is_checked_whether_the_queue_is_idle(made: list[LocalBus]) -> None:
    queue = _bus(made, start=Functions())._queues["start"]

    class Watched(list[Any]):
        """When its length is read, another thread takes the messages, if the lock is free."""

        def __len__(self) -> int:
            count = super().__len__()
            other = threading.Thread(target=self._take)
            other.start()
            other.join()
            return count

        def _take(self) -> None:
            if queue._changed.acquire(blocking=False):
                self.clear()
                queue._changed.release()

    queue.put({"userId": "ada"})
    queue._waiting, queue._open = Watched(queue._waiting), True
    assert not queue.idle


def test_batches_have_at_most_ten(made: list[LocalBus]) -> None:
    stop = Functions()
    bus = _bus(made, stop=stop)
    for n in range(25):
        bus.publish(Topic.STOP, {"n": n})
    bus.start()
    stop.wait(25)
    assert {message["n"] for message in stop.bodies()} == set(range(25))
    assert max(len(event["Records"]) for event in stop.events) == 10


def test_only_failed_items_are_delivered_again(made: list[LocalBus], quick: None) -> None:
    def answer(event: Event) -> Any:
        bad = [r["messageId"] for r in event["Records"] if json.loads(r["body"])["n"] == 2]
        first = all(r["attributes"]["ApproximateReceiveCount"] == "1" for r in event["Records"])
        return {"batchItemFailures": [{"itemIdentifier": id_} for id_ in bad] if first else []}

    task = Functions(answer)
    bus = _bus(made, task=task)
    for n in range(4):
        bus.emit({"n": n})
    bus.start()
    task.wait(5)
    assert bus.drain(20)
    assert sorted(message["n"] for message in task.bodies()) == [0, 1, 2, 2, 3]
    assert task.events[-1]["Records"][0]["attributes"]["ApproximateReceiveCount"] == "2"


@pytest.mark.parametrize(
    "answer",
    [
        lambda event: 1 / 0,
        lambda event: {"batchItemFailures": [{"itemIdentifier": "nobody"}]},
        lambda event: {"batchItemFailures": [{"nonsense": 1}]},
        lambda event: "nonsense",
    ],
    ids=["raises", "unknown id", "no id", "a text"],
)
def test_after_five_receives_a_message_is_given_up(
    made: list[LocalBus], quick: None, answer: Callable[[Event], Any]
) -> None:
    start, said = Functions(answer), list[str]()
    bus = _bus(made, said, start=start)
    bus.publish(Topic.START, {"userId": "P1"})
    bus.start()
    start.wait(5)
    assert bus.drain(20)
    assert [int(event["Records"][0]["attributes"]["ApproximateReceiveCount"]) for event in start.events] == [
        *range(1, 6)
    ]
    assert any("given up" in line for line in said)
    assert "P1" not in "".join(line for line in said if "given up" in line)


@pytest.mark.parametrize("waits", [(0.1,), (0.1, 0.3)])
def test_each_wait_between_receives_has_its_length(
    made: list[LocalBus], monkeypatch: pytest.MonkeyPatch, waits: tuple[float, ...]
) -> None:
    """Only lower bounds are checked, because a busy machine delays; with a later, longer wait the message would miss the test's deadline."""
    monkeypatch.setattr(bus_module, "RETRY", (*waits, 600))
    times: list[float] = []
    start = Functions(lambda event: times.append(time.monotonic()) or 1 / 0)
    bus = _bus(made, start=start)
    bus.publish(Topic.START, {})
    bus.start()
    start.wait(len(waits) + 1)
    assert all(later - earlier >= wait for (earlier, later), wait in zip(pairwise(times), waits, strict=True))


def test_later_waits(made: list[LocalBus]) -> None:
    task = Functions()
    bus = _bus(made, task=task)
    bus.start()
    began = time.monotonic()
    bus.send_delayed({"n": 2}, 3)
    bus.send_delayed({"n": 1}, 0)
    task.wait(2)
    assert [message["n"] for message in task.bodies()] == [1, 2]
    assert time.monotonic() - began >= 3


def test_a_message_is_never_given_up_while_the_machine_refuses_something(quick: None) -> None:
    retry, tries = Retry(lambda text: None), list[int]()

    def handler(event: Any, context: object) -> Any:
        tries.append(1)
        if len(tries) < 12:
            retry.report(OSError(errno.ENOSPC, "No space left on device"))
            raise RuntimeError

    bus = LocalBus({"start": handler}, lambda text: None, retry)
    bus.publish(Topic.START, {})
    bus.start()
    until(lambda: len(tries) == 12)
    assert bus.drain(20)
    bus.close(2)
