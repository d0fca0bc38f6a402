"""The work of the functions that start, register and stop servers, as one object, for tests that need no events."""

from __future__ import annotations

from collections.abc import Sequence

from hippodrome.control.model.messages import DnsChanged, KeepWarm, StartServer, StopServer, StopUser, TaskChanged
from hippodrome.control.model.server import Reason
from hippodrome.control.ports import Platform
from hippodrome.control.servers.causes import Cause
from hippodrome.control.servers.dns import DnsRecords
from hippodrome.control.servers.services import ServerServices
from hippodrome.control.servers.start import Start
from hippodrome.control.servers.stops import Stops
from hippodrome.control.servers.termination import ENDED, Termination
from hippodrome.control.storage.repository import Versioned


class Servers:
    """Does what `start_server`, `task_changed` and `stop_server` do, in one process with one project cache."""

    def __init__(self, platform: Platform) -> None:
        self._services = services = ServerServices(platform)
        self._start, self._dns, self._termination = Start(services), DnsRecords(services), Termination(services)

    def start(self, message: StartServer | KeepWarm) -> None:
        """Do what `start_server` does for one message."""
        self._start.handle(message)

    def tasks_changed(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """Do what `task_changed` does for ECS events; return those that should be delivered again."""
        again = self._dns.tasks_running([event for event in events if event.status == "RUNNING"])
        return again + self._termination.tasks_ended([event for event in events if event.status in ENDED])

    def dns_changed(self, *messages: DnsChanged) -> list[DnsChanged]:
        """Do what `task_changed` does for its own messages; return those that should be delivered again."""
        return self._dns.dns_changed(messages)

    def stop(self, batch: Sequence[StopServer | StopUser]) -> list[StopServer | StopUser]:
        """Do what `stop_server` does for a batch; return the messages that should be delivered again."""
        return Stops(self._services).handle(batch)

    def clean_up_lost(self, stored: Versioned, reason: Reason) -> None:
        """Do what the sweep does for a server whose task is gone."""
        self._termination.clean_up_lost(stored, reason, Cause.VANISHED)

    def failures(self) -> list[Cause]:
        """Return the causes that the functions would report as metrics."""
        return self._services.failures()
