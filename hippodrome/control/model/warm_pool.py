"""A project's pool of warm servers (`warmServers`): its records and rules. Pure."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from datetime import datetime, timedelta

import msgspec

from hippodrome.control.model import ids, sessions
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import Record
from hippodrome.control.ports import Settings

POOLS = "_warm/"
MAX_WAIT = timedelta(hours=12)  # after this time a warm server is replaced
COUNTED_WAIT = timedelta(hours=1)  # the same with maxServerHours, from which the waiting time is reserved
MIN_LONGEST_WAIT = timedelta(minutes=10)  # if warm servers can only wait for a shorter time, none is started


def pool_key(project_id: str) -> str:
    """Return the key of a project's pool."""
    return f"{POOLS}{project_id}.json"


def longest_wait(project: Project, settings: Settings) -> timedelta:
    """Return how long a warm server waits at most. The installation's maxRuntime bounds the sum of waiting and play."""
    longest = MAX_WAIT if project.max_server_hours is None else COUNTED_WAIT
    return min(longest, timedelta(minutes=settings.max_runtime) - sessions.lifetime(project, settings))


def deadline(project: Project, settings: Settings, label: str, now: datetime) -> datetime:
    """Return the deadline of a warm server that starts now.

    It is 75 to 100 % of `longest_wait` away, different for each label, so that not all warm servers end at once.
    """
    share = hashlib.sha256(label.encode()).digest()[0] / 256
    return now + timedelta(seconds=round(longest_wait(project, settings).total_seconds() * (1 - share / 4)))


class WarmServer(Record, frozen=True):
    """A warm server in the pool. `version` is the project's when the server was requested."""

    version: str
    requested: datetime
    ready: bool = False


class Pool(Record, frozen=True):
    """`_warm/{projectId}.json`: warm servers that wait or start, by warm id; `total` counts all ever requested."""

    warm_servers: Mapping[str, WarmServer] = msgspec.field(default_factory=dict)
    total: int = 0

    def first(self, version: str) -> str | None:
        """Return the id of the oldest warm server that is ready and of this version; None if there is none."""
        ready = [
            (warm_server.requested, warm_id)
            for warm_id, warm_server in self.warm_servers.items()
            if warm_server.ready and warm_server.version == version
        ]
        return min(ready)[1] if ready else None

    def without_first(self, version: str) -> Pool:
        """Return the pool without the warm server that `first` returns."""
        first = self.first(version)
        return self.without([first]) if first else self

    def without(self, warm_ids: Collection[str]) -> Pool:
        """Return the pool without these warm servers."""
        return self._with(
            {warm_id: warm_server for warm_id, warm_server in self.warm_servers.items() if warm_id not in warm_ids}
        )

    def with_ready(self, warm_ids: Collection[str]) -> Pool:
        """Return the pool with these warm servers marked ready; ids that are not in the pool are ignored."""
        pool_ids = self.warm_servers.keys() & warm_ids
        ready = {warm_id: msgspec.structs.replace(self.warm_servers[warm_id], ready=True) for warm_id in pool_ids}
        return self._with({**self.warm_servers, **ready})

    def with_returned(self, warm_id: str, warm_server: WarmServer) -> Pool:
        """Return the pool with a warm server that was taken out and is not needed."""
        return self._with({**self.warm_servers, warm_id: warm_server})

    def of_registration(self, project: Project | None) -> Mapping[str, WarmServer]:
        """Return the warm servers that were requested for this registration."""
        version = project.version if project else None
        return {
            warm_id: warm_server for warm_id, warm_server in self.warm_servers.items() if warm_server.version == version
        }

    def resized(self, project: Project | None, number: int, now: datetime) -> Pool:
        """Return the pool with `number` warm servers of this registration, and no others.

        If there are too many, those that are not ready are removed first, then the oldest.
        """
        if project is None:
            return self._with({})
        fit = self.of_registration(project)
        best = sorted(fit, key=lambda warm_id: (fit[warm_id].ready, fit[warm_id].requested, warm_id), reverse=True)
        remaining = {warm_id: fit[warm_id] for warm_id in best[:number]}
        return self._with(remaining).with_new(project, number - len(remaining), now)

    def with_new(self, project: Project, count: int, now: datetime) -> Pool:
        """Return the pool with `count` new warm servers, which are to be started."""
        total = self.total + max(0, count)
        new = {ids.warm_id(project.id, now, n): WarmServer(project.version, now) for n in range(self.total, total)}
        return Pool({**self.warm_servers, **new}, total)

    def _with(self, warm_servers: Mapping[str, WarmServer]) -> Pool:
        return Pool(warm_servers, self.total)


def target_size(project: Project | None, settings: Settings, waiting: int, room: int | None) -> int:
    """Return how many warm servers a project should have.

    `waiting` is how many it has now; `room` is for how many more there are slots (None: no limit). The result is 0 if
    the project is closed, or if warm servers could only wait for less than `MIN_LONGEST_WAIT`.
    """
    if project is None or not project.live or longest_wait(project, settings) < MIN_LONGEST_WAIT:
        return 0
    return project.warm_servers if room is None else max(0, min(project.warm_servers, waiting + room))
