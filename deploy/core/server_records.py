"""The servers' own records (`_servers/{label}.json`): a listing tells which have changed, and only those are read."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta

from hippodrome.model import ids, server
from hippodrome.model.records import from_json
from hippodrome.model.server import RECORDS, PastAttempt, Server, past_attempt
from hippodrome.ports import Documents, Entry
from protocol.keys import handover_key

READERS = 8  # documents read at once; botocore keeps ten connections
SETTLED = timedelta(seconds=5)  # S3's times are whole seconds: what changed a moment ago may change again unseen
SLACK = timedelta(hours=1)  # how long a server may outlive its deadline until a function has noticed


class Records:
    """The records of all servers. They are kept between two looks, so that a second one reads only what has changed."""

    def __init__(self, documents: Documents) -> None:
        self._documents = documents
        self._kept: dict[str, tuple[datetime, Server | None]] = {}

    @property
    def unreadable(self) -> int:
        """How many documents among the records cannot be read as a record."""
        return len(self.unreadable_labels)

    @property
    def unreadable_labels(self) -> list[str]:
        """The labels of the records that cannot be read."""
        keys = sorted(key for key, (_, record) in self._kept.items() if record is None)
        return [key.removeprefix(RECORDS).removesuffix(".json") for key in keys]

    def since(self, moment: datetime | None = None, advance: Callable[[int, int], None] | None = None) -> list[Server]:
        """The records written at `moment` (aware) or later; all without it. `advance`: so many of so many are read."""
        wanted = [
            entry
            for entry in self._documents.list(RECORDS)
            if _is_record(entry.key) and (moment is None or entry.modified >= moment)
        ]
        stale = [entry for entry in wanted if self._is_stale(entry)]
        with ThreadPoolExecutor(READERS) as pool:
            for done, (entry, record) in enumerate(zip(stale, pool.map(self._read, stale), strict=True), 1):
                self._kept[entry.key] = (entry.modified, record)
                if advance:
                    advance(done, len(stale))
        found = [self._kept[entry.key][1] for entry in wanted]
        now = datetime.now(UTC)
        for entry in wanted:
            if now - entry.modified < SETTLED and self._kept[entry.key][1] is not None:
                del self._kept[entry.key]
        return [record for record in found if record is not None]

    def open(self, max_runtime: int, now: datetime) -> list[Server]:
        """The records of servers that are not closed. `max_runtime` is the installation's, in minutes.

        An open record was written last when its server became ready, so no longer ago than a server may live.
        """
        recent = self.since(now - timedelta(minutes=max_runtime) - SLACK)
        return [record for record in recent if not record.is_closed]

    def read(self, labels: Iterable[str]) -> dict[str, Server]:
        """The records under these labels, as they are now; those that do not exist are missing."""
        keys = sorted({server.key(label) for label in labels})
        with ThreadPoolExecutor(READERS) as pool:
            found = pool.map(self._load, keys)
            return {record.label: record for record in found if record is not None}

    def owners(self, names: Iterable[str]) -> dict[str, Server]:
        """The records that own these resource names, by the rule of `Repository.owner`; names without one are missing.

        Two rounds of reads for all of them: an assigned warm server leads from its own record to the participant's.
        """
        names = [*names]
        records = self.read(parsed[0] for name in names if (parsed := ids.parse_server_name(name)))
        records |= self.read({record.assigned_to for record in records.values() if record.assigned_to})
        found = {name: server.owner(name, records.get, lambda record: record) for name in names}
        return {name: record for name, record in found.items() if record is not None}

    def _is_stale(self, entry: Entry) -> bool:
        kept = self._kept.get(entry.key)
        return kept is None or kept[0] != entry.modified

    def _read(self, entry: Entry) -> Server | None:
        return self._load(entry.key)

    def _load(self, key: str) -> Server | None:
        document = self._documents.get(key)
        try:
            record = from_json(document.body, Server) if document else None
        except (ValueError, RecursionError):
            return None
        # A record says whose it is; under another's key it would speak for the wrong server.
        return record if record and key == server.key(record.label) else None


def _is_record(key: str) -> bool:
    label = key.removeprefix(RECORDS).removesuffix(".json")
    return key.endswith(".json") and ids.parse_server_name(f"{label}-1") is not None


def runs(record: Server) -> list[PastAttempt]:
    """Every attempt that a record holds, oldest first."""
    return [*record.earlier, past_attempt(record)]


def warm_servers_of(record: Server | None) -> list[str]:
    """The names of the warm servers that were assigned to the owner of a record, in all attempts."""
    return [run.warm_server_name for run in runs(record) if run.warm_server_name] if record else []


def keys_of_warm_servers(project_id: str, names: Collection[str]) -> list[str]:
    """The handovers and records of warm servers that were assigned."""
    labels = [parsed[0] for name in names if (parsed := ids.parse_server_name(name))]
    return sorted([*(handover_key(project_id, name) for name in names), *(server.key(label) for label in labels)])
