"""The work of `start_server`, `task_changed` and `stop_server`.

Everything here may be interrupted at any point and run again with the same messages: a server's record is written
before its resources are created, and closed after they are deleted. If a server ended by itself, its timer is deleted
after the record is closed (`termination.py`).
"""

from __future__ import annotations

from collections.abc import Sequence

from hippodrome.limits.slots import Slots
from hippodrome.model.messages import DnsChanged, KeepWarm, StartServer, StopServer, TaskChanged
from hippodrome.model.server import Reason, Server
from hippodrome.ports import Platform
from hippodrome.servers.causes import Cause
from hippodrome.servers.dns import DnsRegistration
from hippodrome.servers.start import Start
from hippodrome.servers.termination import ENDED, Termination
from hippodrome.servers.warm.handover import Handovers
from hippodrome.servers.warm.pools import Pools
from hippodrome.storage.project_cache import ProjectCache
from hippodrome.storage.repository import Repository, Versioned


class Servers:
    """Starts, registers and stops servers. One per running function."""

    def __init__(self, platform: Platform) -> None:
        project_cache, repository = ProjectCache(platform), Repository(platform.documents)
        slots, pools = Slots(platform), Pools(platform, project_cache)
        handovers = Handovers(platform, repository, slots, pools)
        termination = Termination(platform, project_cache, repository, slots=slots, pools=pools, handovers=handovers)
        self._pools, self._termination, self._dns = pools, termination, DnsRegistration(platform, repository, pools)
        self._start = Start(
            platform, project_cache, repository, slots=slots, pools=pools, handovers=handovers, termination=termination
        )

    def start(self, message: StartServer | KeepWarm) -> None:
        """Run the requested server, once, however often the message is delivered; or adjust a pool of warm servers."""
        if isinstance(message, KeepWarm):
            self._pools.adjust(message.keep_warm)
        else:
            self._start.start(message)

    def tasks_changed(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """Handle a batch of ECS events; return those that should be delivered again."""
        again = self._dns.tasks_running([event for event in events if event.status == "RUNNING"])
        return again + self._termination.tasks_ended([event for event in events if event.status in ENDED])

    def dns_changed(self, *messages: DnsChanged) -> list[DnsChanged]:
        """Mark the servers of DNS changes that are INSYNC ready; return the messages that should be delivered again."""
        return self._dns.dns_changed(*messages)

    def stop(self, batch: Sequence[StopServer]) -> list[StopServer]:
        """Stop servers; return the messages that should be delivered again."""
        return self._termination.stop(batch)

    def clean_up_lost(self, stored: Versioned, reason: Reason) -> None:
        """Clean up after a server whose task is gone, and request the next attempt if there should be one."""
        self._termination.clean_up_lost(stored, reason, Cause.VANISHED)

    def failures(self) -> list[Cause]:
        """The causes of the failed servers that were closed since the last call, one per server."""
        found: list[Cause] = []
        while self._termination.failures:
            found.append(self._termination.failures.popleft())
        return found

    def after_close(self, closed: Server) -> None:
        """Repeat what follows the closing of a record, in case that was interrupted."""
        self._termination.after_close(closed)
