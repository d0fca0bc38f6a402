"""Which servers wait for participants (`warmServers`): pure records of a project's pool, and its rules."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from datetime import datetime, timedelta

import msgspec

from hippodrome.model import ids
from hippodrome.model.project import Project
from hippodrome.model.records import Record
from hippodrome.ports import Settings

POOLS = "_spares/"
LONGEST_WAIT = timedelta(hours=12)  # then a warm server is replaced by a fresh one
COUNTED_WAIT = timedelta(hours=1)  # the same with maxServerHours: so much is reserved for each warm server
SHORTEST_WAIT = timedelta(minutes=10)  # not worth a server's start below


def pool_key(project_id: str) -> str:
    """Where a project's pool lies."""
    return f"{POOLS}{project_id}.json"


def longest_wait(project: Project, settings: Settings) -> timedelta:
    """How long a warm server waits at most: the installation's maxRuntime holds for waiting and play together."""
    longest = LONGEST_WAIT if project.max_server_hours is None else COUNTED_WAIT
    return min(longest, timedelta(minutes=max(0, settings.max_runtime - project.max_runtime)))


def deadline(project: Project, settings: Settings, label: str, now: datetime) -> datetime:
    """The deadline of a warm server that starts now: up to a quarter earlier, so that a pool does not end at once."""
    share = hashlib.sha256(label.encode()).digest()[0] / 256
    return now + timedelta(seconds=round(longest_wait(project, settings).total_seconds() * (1 - share / 4)))


class WarmServer(Record, frozen=True):
    """A server in the pool. `version` is that of the project it was started for."""

    version: str
    requested: datetime = msgspec.field(name="asked")
    ready: bool = False


class Pool(Record, frozen=True):
    """`_spares/{projectId}.json`: the warm servers, or will, by their warm server ids, and how many there ever were."""

    warm_servers: Mapping[str, WarmServer] = msgspec.field(default_factory=dict, name="spares")
    made: int = 0

    def first(self, version: str) -> str | None:
        """The warm server that has waited longest of those that may be given out; None if there is none."""
        ready = [
            (warm_server.requested, warm_id)
            for warm_id, warm_server in self.warm_servers.items()
            if warm_server.ready and warm_server.version == version
        ]
        return min(ready)[1] if ready else None

    def without_first(self, version: str) -> Pool:
        """With that one taken out."""
        first = self.first(version)
        return self.without([first]) if first else self

    def without(self, gone: Collection[str]) -> Pool:
        """With these taken out."""
        return self._with(
            {warm_id: warm_server for warm_id, warm_server in self.warm_servers.items() if warm_id not in gone}
        )

    def with_ready(self, those: Collection[str]) -> Pool:
        """With these ready to be given out; those that are not in the pool (any more) stay out of it."""
        known = self.warm_servers.keys() & those
        ready = {warm_id: msgspec.structs.replace(self.warm_servers[warm_id], ready=True) for warm_id in known}
        return self._with({**self.warm_servers, **ready})

    def with_returned(self, warm_id: str, warm_server: WarmServer) -> Pool:
        """With one that was taken out and not needed."""
        return self._with({**self.warm_servers, warm_id: warm_server})

    def of_registration(self, project: Project | None) -> Mapping[str, WarmServer]:
        """Those that were started for this registration."""
        version = project.version if project else None
        return {
            warm_id: warm_server for warm_id, warm_server in self.warm_servers.items() if warm_server.version == version
        }

    def resized(self, project: Project | None, number: int, now: datetime) -> Pool:
        """With so many warm servers for this registration: others go.

        Of too many, first those that nobody could be given yet, then those that wait longest.
        """
        if project is None:
            return self._with({})
        fit = self.of_registration(project)
        best = sorted(fit, key=lambda warm_id: (fit[warm_id].ready, fit[warm_id].requested, warm_id), reverse=True)
        kept = {warm_id: fit[warm_id] for warm_id in best[:number]}
        return self._with(kept).with_new(project, number - len(kept), now)

    def with_new(self, project: Project, count: int, now: datetime) -> Pool:
        """With so many new ones, which are about to be started."""
        made = self.made + max(0, count)
        new = {ids.warm_id(project.id, now, n): WarmServer(project.version, now) for n in range(self.made, made)}
        return Pool({**self.warm_servers, **new}, made)

    def _with(self, warm_servers: Mapping[str, WarmServer]) -> Pool:
        return Pool(warm_servers, self.made)


def target_size(project: Project | None, settings: Settings, waiting: int, room: int | None) -> int:
    """How many warm servers a project should have; it has `waiting` now, and `room` for more (None: for any number).

    None unless participants may come and there is time to wait for them; and no more than find a place.
    """
    if project is None or not project.live or longest_wait(project, settings) < SHORTEST_WAIT:
        return 0
    return project.warm_servers if room is None else max(0, min(project.warm_servers, waiting + room))
