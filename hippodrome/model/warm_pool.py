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
LONGEST_WAIT = timedelta(hours=12)  # then a spare is replaced by a fresh one
COUNTED_WAIT = timedelta(hours=1)  # the same with maxServerHours: so much is reserved for each spare
SHORTEST_WAIT = timedelta(minutes=10)  # not worth a server's start below


def pool_key(project_id: str) -> str:
    """Where a project's pool lies."""
    return f"{POOLS}{project_id}.json"


def handovers(project_id: str) -> str:
    """Where the spares of a project learn whose they have become."""
    return f"{project_id}/spares/"


def handover_key(project_id: str, name: str) -> str:
    """Where the spare of this name learns whose it has become; see `Handover`."""
    return f"{handovers(project_id)}{name}.json"


def waits(project: Project, settings: Settings) -> timedelta:
    """How long a spare waits at most: the installation's maxRuntime holds for its waiting and the play together."""
    longest = LONGEST_WAIT if project.max_server_hours is None else COUNTED_WAIT
    return min(longest, timedelta(minutes=max(0, settings.max_runtime - project.max_runtime)))


def until(project: Project, settings: Settings, label: str, now: datetime) -> datetime:
    """When a spare is to go that is started now: up to a quarter earlier, so that those started together go apart."""
    share = hashlib.sha256(label.encode()).digest()[0] / 256
    return now + timedelta(seconds=round(waits(project, settings).total_seconds() * (1 - share / 4)))


class Handover(Record, frozen=True):
    """`{projectId}/spares/{name}.json`: tells the trial on a spare who plays there. Deleted when the server ends.

    `server` is the name under which the participant's recordings of this attempt lie.
    """

    user_id: str
    group: int | None
    server: str
    schema: int = 1


class Spare(Record, frozen=True):
    """A server in the pool. `version` is that of the project it was started for."""

    version: str
    asked: datetime
    ready: bool = False


class Pool(Record, frozen=True):
    """`_spares/{projectId}.json`: the servers that wait, or will, by their spare ids, and how many there ever were."""

    spares: Mapping[str, Spare] = msgspec.field(default_factory=dict)
    made: int = 0

    def first(self, version: str) -> str | None:
        """The spare that has waited longest of those that may be given out; None if there is none."""
        ready = [
            (spare.asked, spare_id)
            for spare_id, spare in self.spares.items()
            if spare.ready and spare.version == version
        ]
        return min(ready)[1] if ready else None

    def without_first(self, version: str) -> Pool:
        """With that one taken out."""
        first = self.first(version)
        return self.without([first]) if first else self

    def without(self, gone: Collection[str]) -> Pool:
        """With these taken out."""
        return self._with({spare_id: spare for spare_id, spare in self.spares.items() if spare_id not in gone})

    def made_ready(self, those: Collection[str]) -> Pool:
        """With these ready to be given out; those that are not in the pool (any more) stay out of it."""
        known = self.spares.keys() & those
        ready = {spare_id: msgspec.structs.replace(self.spares[spare_id], ready=True) for spare_id in known}
        return self._with({**self.spares, **ready})

    def back(self, spare_id: str, spare: Spare) -> Pool:
        """With one that was taken out and not needed."""
        return self._with({**self.spares, spare_id: spare})

    def fit(self, project: Project | None) -> Mapping[str, Spare]:
        """Those that were started for this registration."""
        version = project.version if project else None
        return {spare_id: spare for spare_id, spare in self.spares.items() if spare.version == version}

    def settled(self, project: Project | None, number: int, now: datetime) -> Pool:
        """With so many spares for this registration: others go.

        Of too many, first those that nobody could be given yet, then those that wait longest.
        """
        if project is None:
            return self._with({})
        fit = self.fit(project)
        best = sorted(fit, key=lambda spare_id: (fit[spare_id].ready, fit[spare_id].asked, spare_id), reverse=True)
        kept = {spare_id: fit[spare_id] for spare_id in best[:number]}
        return self._with(kept).asked(project, number - len(kept), now)

    def asked(self, project: Project, count: int, now: datetime) -> Pool:
        """With so many new ones, which are about to be started."""
        made = self.made + max(0, count)
        new = {ids.spare_id(project.id, now, n): Spare(project.version, now) for n in range(self.made, made)}
        return Pool({**self.spares, **new}, made)

    def _with(self, spares: Mapping[str, Spare]) -> Pool:
        return Pool(spares, self.made)


def wanted(project: Project | None, settings: Settings, waiting: int, room: int | None) -> int:
    """How many spares a project should have that has `waiting` now, and `room` for so many more (None: for any number).

    None unless participants may come and there is time to wait for them; and no more than find a place.
    """
    if project is None or not project.live or waits(project, settings) < SHORTEST_WAIT:
        return 0
    return project.warm_servers if room is None else max(0, min(project.warm_servers, waiting + room))
