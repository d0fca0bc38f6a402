"""Deliver messages and events of a platform in memory to the functions that start and stop servers."""

from __future__ import annotations

import json

from hippodrome.control.model import messages
from hippodrome.control.model.messages import TaskChanged
from hippodrome.control.ports import Topic
from testing.fake_platform import FakePlatform
from testing.servers import Servers


def events(platform: FakePlatform, status: str, **changes: object) -> list[TaskChanged]:
    """Return the event of this status for each task that runs."""
    given = {"interface": "eni-1", "stop_code": None, "stopped_reason": "", "exit_code": None, **changes}
    return [
        TaskChanged(task=task, cluster=request.cluster, name=request.name, status=status, **given)  # type: ignore[arg-type]
        for task, request in platform.tasks.running.items()
    ]


def deliver(platform: FakePlatform, servers: Servers) -> None:
    """Deliver each message once, and each that follows from it; tasks run and get their names."""
    servers.tasks_changed(events(platform, "RUNNING"))
    while platform.bus.sent or platform.bus.delayed:
        sent, platform.bus.sent = platform.bus.sent, []
        later, platform.bus.delayed = platform.bus.delayed, []
        for topic, message in sent:
            body = json.loads(json.dumps(message))
            if topic is Topic.START:
                start = messages.parse_start_server(body)
                assert start
                servers.start(start)
            else:
                stop = messages.parse_stop_server(body)
                assert stop
                assert servers.stop([stop]) == []
        for _, message in later:
            changed = messages.parse_dns_changed(json.loads(json.dumps(message)))
            assert changed
            servers.dns_changed(changed)
        servers.tasks_changed(events(platform, "RUNNING"))
