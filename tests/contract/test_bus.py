"""The contract of `hippodrome.control.ports.Bus`."""

from __future__ import annotations

from hippodrome.control.ports import Topic
from tests.contract.backends import Backend

MESSAGE = {
    "projectId": "study",
    "userId": "P1",
    "attempt": 2,
    "reason": "“déjà vu” ✓\n",
    "nothing": None,
    "more": [1.5],
}


def test_each_topic_feeds_its_own_queue(backend: Backend) -> None:
    backend.platform.bus.publish(Topic.START, MESSAGE)
    backend.platform.bus.publish(Topic.STOP, {"projectId": "study"})
    assert backend.arrived("start") == [MESSAGE]
    assert backend.arrived("stop") == [{"projectId": "study"}]
    assert backend.arrived("task") == []
    assert backend.arrived("start") == []


def test_a_delayed_message_comes_to_the_tasks_queue(backend: Backend) -> None:
    backend.platform.bus.send_delayed(MESSAGE, 900)
    backend.platform.bus.send_delayed({"changes": "C1"}, 0)
    arrived = backend.arrived("task")
    assert MESSAGE in arrived
    assert {"changes": "C1"} in arrived
    assert len(arrived) == 2
    assert backend.arrived("stop") == []
