"""Starting, naming and ending servers: what `start_server`, `task_changed` and `stop_server` do.

Everything here may be interrupted anywhere and run again with the same messages: the record is written before what it
speaks for is made, and closed after what it owned is gone.
"""

from __future__ import annotations

from collections.abc import Sequence

from hippodrome.limits.slots import Places
from hippodrome.model.messages import KeepWarm, NamesChanged, StartServer, StopServer, TaskChanged
from hippodrome.model.server import Reason, Server
from hippodrome.ports import Platform
from hippodrome.servers.dns import Naming
from hippodrome.servers.failures import Cause
from hippodrome.servers.start import Starting
from hippodrome.servers.termination import ENDED, Ending
from hippodrome.servers.warm.handover import Giving
from hippodrome.servers.warm.pools import Pools
from hippodrome.storage.project_cache import Library
from hippodrome.storage.repository import Ledger, Stored


class Servers:
    """What the functions do with servers. One per running function."""

    def __init__(self, platform: Platform) -> None:
        library, ledger = Library(platform), Ledger(platform.documents)
        places, pools = Places(platform), Pools(platform, library)
        giving = Giving(platform, ledger, places, pools)
        ending = Ending(platform, library, ledger, places=places, pools=pools, giving=giving)
        self._pools, self._ending, self._naming = pools, ending, Naming(platform, ledger, pools)
        self._starting = Starting(platform, library, ledger, places=places, pools=pools, giving=giving, ending=ending)

    def start(self, message: StartServer | KeepWarm) -> None:
        """Run the server that a start message asks for, once, however often the message comes."""
        if isinstance(message, KeepWarm):
            self._pools.keep(message.keep_warm)
        else:
            self._starting.start(message)

    def tasks_changed(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """Deal with a batch of ECS events; those that should come again."""
        again = self._naming.running([event for event in events if event.status == "RUNNING"])
        return again + self._ending.stopped([event for event in events if event.status in ENDED])

    def names_changed(self, *messages: NamesChanged) -> list[NamesChanged]:
        """The follow-ups of DNS changes: are the names known everywhere? Those that should come again."""
        return self._naming.names_changed(*messages)

    def stop(self, batch: Sequence[StopServer]) -> list[StopServer]:
        """Let servers go; the messages that should come again."""
        return self._ending.stop(batch)

    def lost(self, stored: Stored, reason: Reason) -> None:
        """Clean up after a server whose task is gone, and ask for the next attempt if there should be one."""
        self._ending.lost(stored, reason, Cause.VANISHED)

    def failures(self) -> list[Cause]:
        """Why servers have failed since this was asked last: a cause for each that was closed."""
        found: list[Cause] = []
        while self._ending.failures:
            found.append(self._ending.failures.popleft())
        return found

    def finish(self, closed: Server) -> None:
        """Do what a cut-off ending has left undone after it had closed the record."""
        self._ending.finish(closed)
