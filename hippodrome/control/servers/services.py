"""The services and caches that `Start`, `DnsRecords`, `Termination`, `Replacement` and `Sweep` share."""

from __future__ import annotations

from hippodrome.control.limits.slots import Slots
from hippodrome.control.lobby.lobby import Lobby
from hippodrome.control.ports import Platform
from hippodrome.control.servers.causes import Cause
from hippodrome.control.servers.warm.handover import Handovers
from hippodrome.control.servers.warm.pools import Pools
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.repository import Repository, Versioned
from hippodrome.control.storage.secret import SecretCache


class ServerServices:
    """The services and caches of one running function."""

    def __init__(self, platform: Platform) -> None:
        self.platform = platform
        self.project_cache = ProjectCache(platform)
        self.repository = Repository(platform.documents)
        self.secrets = SecretCache(platform.documents)
        self.lobby = Lobby(platform, self.repository)
        self.slots = Slots(platform)
        self.pools = Pools(platform, self.project_cache)
        self.handovers = Handovers(platform, self.repository, self.slots, self.pools)
        self.written: dict[tuple[str, int], Versioned] = {}  # records as last written in `naming`, by label and attempt
        self._failures: list[Cause] = []

    def note_failure(self, cause: Cause) -> None:
        """Note that a server was closed because it failed."""
        self._failures.append(cause)

    def failures(self) -> list[Cause]:
        """Return the causes of the failed servers that were closed since the last call, one per server."""
        failures, self._failures = self._failures, []
        return failures
