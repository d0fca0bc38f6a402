"""Starting, naming and ending servers: what `start_server`, `task_changed` and `stop_server` do.

Everything here may be interrupted anywhere and run again with the same messages: the record is written before what it
speaks for is made, and closed after what it owned is gone.
"""

from __future__ import annotations

from collections.abc import Sequence

from hippodrome.limits.slots import Slots
from hippodrome.model.messages import DnsChanged, KeepWarm, StartServer, StopServer, TaskChanged
from hippodrome.model.server import Reason, Server
from hippodrome.ports import Platform
from hippodrome.servers.dns import DnsRegistration
from hippodrome.servers.failures import Cause
from hippodrome.servers.start import Launch
from hippodrome.servers.termination import ENDED, Termination
from hippodrome.servers.warm.handover import Handovers
from hippodrome.servers.warm.pools import Pools
from hippodrome.storage.project_cache import ProjectCache
from hippodrome.storage.repository import Repository, Versioned


class Servers:
    """What the functions do with servers. One per running function."""

    def __init__(self, platform: Platform) -> None:
        project_cache, repository = ProjectCache(platform), Repository(platform.documents)
        slots, pools = Slots(platform), Pools(platform, project_cache)
        handovers = Handovers(platform, repository, slots, pools)
        termination = Termination(platform, project_cache, repository, slots=slots, pools=pools, handovers=handovers)
        self._pools, self._termination, self._dns = pools, termination, DnsRegistration(platform, repository, pools)
        self._launch = Launch(
            platform, project_cache, repository, slots=slots, pools=pools, handovers=handovers, termination=termination
        )

    def start(self, message: StartServer | KeepWarm) -> None:
        """Run the server that a start message asks for, once, however often the message comes."""
        if isinstance(message, KeepWarm):
            self._pools.keep(message.keep_warm)
        else:
            self._launch.start(message)

    def tasks_changed(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """Deal with a batch of ECS events; those that should come again."""
        again = self._dns.running([event for event in events if event.status == "RUNNING"])
        return again + self._termination.stopped([event for event in events if event.status in ENDED])

    def dns_changed(self, *messages: DnsChanged) -> list[DnsChanged]:
        """The follow-ups of DNS changes: are the names known everywhere? Those that should come again."""
        return self._dns.dns_changed(*messages)

    def stop(self, batch: Sequence[StopServer]) -> list[StopServer]:
        """Let servers go; the messages that should come again."""
        return self._termination.stop(batch)

    def lost(self, stored: Versioned, reason: Reason) -> None:
        """Clean up after a server whose task is gone, and ask for the next attempt if there should be one."""
        self._termination.lost(stored, reason, Cause.VANISHED)

    def failures(self) -> list[Cause]:
        """Why servers have failed since this was asked last: a cause for each that was closed."""
        found: list[Cause] = []
        while self._termination.failures:
            found.append(self._termination.failures.popleft())
        return found

    def finish(self, closed: Server) -> None:
        """Do what a cut-off ending has left undone after it had closed the record."""
        self._termination.finish(closed)
