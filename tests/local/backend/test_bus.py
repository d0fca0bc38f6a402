"""Queues on disk: real-shaped batches, retries, dead letters, and what a `kill -9` leaves."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from hippodrome.control.ports import Topic
from hippodrome.local.backend import bus as bus_module
from hippodrome.local.backend.bus import FolderBus
from tests.local.conftest import ROOT

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
def made() -> Iterator[list[FolderBus]]:
    buses: list[FolderBus] = []
    yield buses
    for bus in buses:
        bus.close(2)


def _bus(tmp_path: Path, made: list[FolderBus], said: list[str] | None = None, **functions: Functions) -> FolderBus:
    handlers = {name: function.handler for name, function in functions.items()}
    bus = FolderBus(tmp_path, handlers, (said if said is not None else []).append)
    made.append(bus)
    return bus


def _files(tmp_path: Path) -> list[Path]:
    return sorted(path for path in (tmp_path / "queue").rglob("*.json"))


def test_a_message_arrives_as_an_sqs_batch_and_its_file_is_deleted(tmp_path: Path, made: list[FolderBus]) -> None:
    start = Functions()
    bus = _bus(tmp_path, made, start=start)
    bus.publish(Topic.START, {"userId": "Zoë"})
    assert len(_files(tmp_path)) == 1, "it is on disk before publish returns"
    bus.start()
    start.wait(1)
    [record] = start.events[0]["Records"]
    assert json.loads(record["body"]) == {"userId": "Zoë"}
    assert record["eventSource"] == "aws:sqs"
    assert record["attributes"]["ApproximateReceiveCount"] == "1"
    assert record["messageId"]
    assert abs(int(record["attributes"]["SentTimestamp"]) / 1000 - time.time()) < 10
    assert bus.drain(20)
    assert _files(tmp_path) == []


def test_no_message_is_taken_while_it_is_checked_whether_the_queue_is_idle(
    tmp_path: Path, made: list[FolderBus]
) -> None:
    queue = _bus(tmp_path, made, start=Functions())._queues["start"]

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


def test_batches_have_at_most_ten(tmp_path: Path, made: list[FolderBus]) -> None:
    stop = Functions()
    bus = _bus(tmp_path, made, stop=stop)
    for n in range(25):
        bus.publish(Topic.STOP, {"n": n})
    bus.start()
    stop.wait(25)
    assert {message["n"] for message in stop.bodies()} == set(range(25))
    assert max(len(event["Records"]) for event in stop.events) == 10


def test_only_failed_items_are_delivered_again(tmp_path: Path, made: list[FolderBus], quick: None) -> None:
    def answer(event: Event) -> Any:
        bad = [r["messageId"] for r in event["Records"] if json.loads(r["body"])["n"] == 2]
        first = all(r["attributes"]["ApproximateReceiveCount"] == "1" for r in event["Records"])
        return {"batchItemFailures": [{"itemIdentifier": id_} for id_ in bad] if first else []}

    task = Functions(answer)
    bus = _bus(tmp_path, made, task=task)
    for n in range(4):
        bus.emit({"n": n})
    bus.start()
    task.wait(5)
    assert bus.drain(20)
    assert sorted(message["n"] for message in task.bodies()) == [0, 1, 2, 2, 3]
    assert task.events[-1]["Records"][0]["attributes"]["ApproximateReceiveCount"] == "2"
    assert _files(tmp_path) == []


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
def test_after_five_receives_a_message_is_a_dead_letter(
    tmp_path: Path, made: list[FolderBus], quick: None, answer: Callable[[Event], Any]
) -> None:
    start, said = Functions(answer), list[str]()
    bus = _bus(tmp_path, made, said, start=start)
    bus.publish(Topic.START, {"userId": "P1"})
    bus.start()
    start.wait(5)
    assert bus.drain(20)
    assert [int(event["Records"][0]["attributes"]["ApproximateReceiveCount"]) for event in start.events] == [
        *range(1, 6)
    ]
    [dead] = (tmp_path / "dead" / "start").iterdir()
    assert json.loads(json.loads(dead.read_text())["body"]) == {"userId": "P1"}
    assert _files(tmp_path) == []
    assert any("put aside" in line for line in said)


@pytest.mark.parametrize("waits", [(0.1,), (0.1, 0.3)])
def test_each_wait_between_receives_has_its_length(
    tmp_path: Path, made: list[FolderBus], monkeypatch: pytest.MonkeyPatch, waits: tuple[float, ...]
) -> None:
    """Only lower bounds are checked, because a busy machine delays; with a later, longer wait the message would miss the test's deadline."""
    monkeypatch.setattr(bus_module, "RETRY", (*waits, 600))
    times: list[float] = []
    start = Functions(lambda event: times.append(time.monotonic()) or 1 / 0)
    bus = _bus(tmp_path, made, start=start)
    bus.publish(Topic.START, {})
    bus.start()
    start.wait(len(waits) + 1)
    assert all(later - earlier >= wait for (earlier, later), wait in zip(pairwise(times), waits, strict=True))


def test_later_waits(tmp_path: Path, made: list[FolderBus]) -> None:
    task = Functions()
    bus = _bus(tmp_path, made, task=task)
    bus.start()
    began = time.monotonic()
    bus.send_delayed({"n": 2}, 3)
    bus.send_delayed({"n": 1}, 0)
    task.wait(2)
    assert [message["n"] for message in task.bodies()] == [1, 2]
    assert time.monotonic() - began >= 3


def test_an_unhandled_message_is_delivered_again_by_the_next_process(tmp_path: Path, made: list[FolderBus]) -> None:
    _bus(tmp_path, made).publish(Topic.STOP, {"n": 1})
    began = time.time()
    _bus(tmp_path, made).send_delayed({"n": 2}, 1)
    stop, task = Functions(), Functions()
    bus = _bus(tmp_path, made, stop=stop, task=task)
    bus.start()
    stop.wait(1)
    task.wait(1)
    assert time.time() - began >= 1, "a delay lasts across processes"


DIE = """
import os, signal, sys, time
from pathlib import Path
from hippodrome.control.ports import Topic
from hippodrome.local.backend.bus import FolderBus

def handler(event, context):
    with open(sys.argv[2], "a") as seen:
        seen.write(event["Records"][0]["attributes"]["ApproximateReceiveCount"])
    os.kill(os.getpid(), signal.SIGKILL)

bus = FolderBus(Path(sys.argv[1]), {"start": handler})
if sys.argv[3:]:
    bus.publish(Topic.START, {"userId": "P1"})
bus.start()
time.sleep(30)
"""


def test_a_message_that_kills_its_process_is_delivered_a_limited_number_of_times(
    tmp_path: Path, made: list[FolderBus]
) -> None:
    state, seen = tmp_path / "state", tmp_path / "seen"
    for publish in (["yes"], [], [], [], []):
        command = [sys.executable, "-c", DIE, str(state), str(seen), *publish]
        assert subprocess.run(command, cwd=ROOT, check=False).returncode == -signal.SIGKILL
    assert seen.read_text() == "12345"
    start = Functions(lambda event: 1 / 0)
    said: list[str] = []
    bus = _bus(state, made, said, start=start)
    bus.start()
    start.wait(1)
    assert bus.drain(20)
    assert list((state / "dead" / "start").iterdir())


def test_a_deleted_message_file_does_not_stop_the_queue(tmp_path: Path, made: list[FolderBus]) -> None:
    start = Functions()
    bus = _bus(tmp_path, made, start=start)
    bus.publish(Topic.START, {"n": 1})
    os.unlink(_files(tmp_path)[0])
    bus.publish(Topic.START, {"n": 2})
    bus.start()
    start.wait(1)
    assert bus.drain(20)
    assert start.bodies() == [{"n": 2}]
