"""Backends for the contract tests: their ports, and functions that read and change what is behind the ports."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import pytest

from hippodrome.control.model import ids
from hippodrome.control.ports import Platform, TaskRequest
from hippodrome.local.backend.platform import LocalPlatform
from hippodrome.local.backend.processes import end_everything
from testing.fake_platform import FakePlatform
from testing.moto_world import MotoWorld

concurrent = pytest.mark.parametrize("backend", ["aws", "local"], indirect=True)
"""For tests with many threads: the fake in memory is for one thread, and no test asks more of it."""

_REQUEST = TaskRequest(
    "", "hippodrome", "hippodrome", cpu=1, memory=2, environment={"TOKEN": "secret", "PROJECT_ID": "maze"}
)


def name(attempt: int = 1, user: str = "P1") -> str:
    return ids.server_name(ids.server_label("study", user), attempt)


class Backend(Protocol):
    """A platform, and functions that act behind its ports."""

    platform: Platform

    def request(self, name: str, **changes: Any) -> TaskRequest:
        """Return the request for a server; in the installation's cluster unless `changes` say otherwise."""
        return replace(_REQUEST, name=name, **changes)

    def interface(self, task: str) -> str:
        """Let the task reach RUNNING; return the id of its network interface, as in the task's event."""

    def fire(self, name: str) -> None:
        """Let the timer fire now."""

    def arrived(self, queue: str) -> list[Any]:
        """Take the messages that the function behind "start", "stop" or "task" would get; delayed messages come at once."""


class MotoBackend(Backend):
    """`hippodrome.control.aws` on moto; `testing/moto_world.py` adds, and notes, what moto lacks."""

    def __init__(self, world: MotoWorld) -> None:
        self.world = world
        self.platform: Platform = world.platform

    def interface(self, task: str) -> str:
        details = self.world.task_event(task, "RUNNING")["detail"]["attachments"][0]["details"]
        return str(next(item["value"] for item in details if item["name"] == "networkInterfaceId"))

    def fire(self, name: str) -> None:
        self.world.fire_timer(name)

    def arrived(self, queue: str) -> list[Any]:
        self.world.skip_delays()
        return [json.loads(record["body"]) for record in self.world.receive(queue)["Records"]]


class LocalBackend(Backend):
    """`local`: files and processes. Its queues and timers are not started, so that only a test takes from them."""

    def __init__(self, platform: LocalPlatform) -> None:
        self.local = platform
        self.platform: Platform = platform

    def interface(self, task: str) -> str:
        until = time.monotonic() + 30
        while time.monotonic() < until:
            for event in self.local.bus.take("task"):
                detail = event["detail"]
                if (detail["taskArn"], detail["lastStatus"]) == (task, "RUNNING"):
                    details = {item["name"]: item["value"] for item in detail["attachments"][0]["details"]}
                    return str(details["networkInterfaceId"])
            time.sleep(0.02)
        raise AssertionError("no event says that the task runs")

    def fire(self, name: str) -> None:
        self.local.timers.fire(name)

    def arrived(self, queue: str) -> list[Any]:
        return self.local.bus.take(queue)


class MemoryBackend(Backend):
    """The fake platform of the services' tests: they prove something only if it keeps the contract."""

    def __init__(self) -> None:
        self.fake = FakePlatform()
        self.platform: Platform = self.fake

    def interface(self, task: str) -> str:
        return "eni-" + task[-17:]

    def fire(self, name: str) -> None:
        _, message = self.fake.timers.due.pop(name)
        self.fake.bus.sent.append(("stop", message))  # type: ignore[arg-type]

    def arrived(self, queue: str) -> list[Any]:
        bus = self.fake.bus
        if queue == "task":
            found, bus.delayed = [message for _, message in bus.delayed], []
        else:
            found = [message for topic, message in bus.sent if topic == queue]
            bus.sent = [(topic, message) for topic, message in bus.sent if topic != queue]
        return found


@contextmanager
def local_backend(folder: Path) -> Iterator[Backend]:
    state = folder / "state"
    command = (sys.executable, str(Path(__file__).parent / "stub_server.py"))
    platform = LocalPlatform(folder / "data", state, handlers={}, command=command, stop_timeout=5, say=lambda _: None)
    platform.tasks.add_project("maze", folder)
    try:
        yield LocalBackend(platform)
    finally:
        platform.tasks.close()
        end_everything(state)
