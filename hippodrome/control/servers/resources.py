"""Lists the resources of servers: their tasks, DNS records, timers and clusters.

The sweep and the commands `stop`, `erase` and `destroy` use it. Each resource has the name of its server, and by that
name its owner's record is found (`hippodrome.control.model.server.owner`). Callers must list first and read the records
afterwards: a record is written before its server's resources are created, so every listed resource has its record.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from hippodrome.control.model import ids
from hippodrome.control.ports import DnsRecord, Platform, RunningTask


@dataclass(frozen=True)
class Resources:
    """The resources that a listing found. `cluster` is the installation's own."""

    tasks: list[RunningTask] = field(default_factory=list)
    dns_records: list[DnsRecord] = field(default_factory=list)
    timers: list[str] = field(default_factory=list)
    clusters: list[str] = field(default_factory=list)
    cluster: str = ""

    def __bool__(self) -> bool:
        return bool(self.tasks or self.dns_records or self.timers or self.clusters)

    def counts(self) -> dict[str, int]:
        """Return how many resources were found, by their kind."""
        return {
            "tasks": len(self.tasks),
            "timers": len(self.timers),
            "names": len(self.dns_records),
            "clusters": len(self.clusters),
        }

    def kinds(self) -> list[str]:
        """Return the kinds of resources of which at least one was found, as words in the singular."""
        return [kind.removesuffix("s") for kind, number in self.counts().items() if number]

    def names(self) -> Iterator[str]:
        """Yield the name of each resource. Not every name is the name of a server."""
        yield from (task.name for task in self.tasks)
        yield from (ids.first_label(record.name) for record in self.dns_records)
        yield from map(ids.timer_server, self.timers)
        yield from self.clusters

    def only(self, keep: Callable[[str], bool], ours: Callable[[str], bool] | None = None) -> Resources:
        """Return the resources whose names `keep` accepts.

        `ours` decides instead for resources that only this installation can have created: tasks in its cluster, and
        timers. The hosted zone and the account's other clusters may hold resources of another installation.
        """
        ours = ours or keep
        return replace(
            self,
            tasks=[task for task in self.tasks if (ours if task.cluster == self.cluster else keep)(task.name)],
            dns_records=[record for record in self.dns_records if keep(ids.first_label(record.name))],
            timers=[timer for timer in self.timers if ours(ids.timer_server(timer))],
            clusters=[cluster for cluster in self.clusters if keep(cluster)],
        )


def list_resources(platform: Platform) -> Resources:
    """List the resources of all kinds at the same time. If one listing raises, this raises its error."""
    listings: list[Callable[[], Iterator[Any]]] = [
        platform.tasks.list,
        platform.dns.list,
        platform.timers.list,
        platform.tasks.clusters,
    ]
    errors: list[Exception] = []

    def read(listing: Callable[[], Iterator[Any]]) -> list[Any]:
        try:
            return list(listing())
        except Exception as error:  # noqa: BLE001 - raised below, once all have ended
            errors.append(error)
            return []

    tasks, dns_records, timers, clusters = platform.run_all([partial(read, listing) for listing in listings])
    if errors:
        raise errors[0]
    return Resources(tasks, dns_records, timers, clusters, platform.settings.cluster)
