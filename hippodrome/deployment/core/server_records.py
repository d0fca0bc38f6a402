"""Reads servers' records (`_servers/{label}.json`). A listing tells which records have changed; only these are read."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta

from hippodrome.control.model import ids, server
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import RECORDS, PastAttempt, Server, past_attempt
from hippodrome.control.ports import Documents, Entry
from hippodrome.protocol.keys import handover_key

READERS = 8  # documents read at once; botocore keeps ten connections
SETTLED = timedelta(seconds=5)  # S3's times are whole seconds: of two changes in one second, a listing hides one
SLACK = timedelta(hours=1)  # how long a record may stay open after its server's deadline


class Records:
    """Reads the records of servers, and keeps them: the next call of `since` reads only records that have changed."""

    def __init__(self, documents: Documents) -> None:
        self._documents = documents
        self._kept: dict[str, tuple[datetime, Server | None]] = {}

    @property
    def unreadable(self) -> int:
        """The number of records that cannot be read."""
        return len(self.unreadable_labels)

    @property
    def unreadable_labels(self) -> list[str]:
        """The labels of the records that cannot be read."""
        keys = sorted(key for key, (_, record) in self._kept.items() if record is None)
        return [key.removeprefix(RECORDS).removesuffix(".json") for key in keys]

    def since(self, moment: datetime | None = None, advance: Callable[[int, int], None] | None = None) -> list[Server]:
        """Return the records that were written at `moment` (an aware time) or later; without `moment`, all records.

        `advance` gets two numbers: how many records have been read, and how many have to be read.
        """
        listed = {entry.key: entry for entry in self._documents.list(RECORDS) if _is_record(entry.key)}
        self._kept = {key: kept for key, kept in self._kept.items() if key in listed}  # others have been deleted
        recent = [entry for entry in listed.values() if moment is None or entry.modified >= moment]
        stale = [entry for entry in recent if self._is_stale(entry)]
        stale_keys = [entry.key for entry in stale]
        with ThreadPoolExecutor(READERS) as pool:
            for done, (entry, record) in enumerate(zip(stale, pool.map(self._load, stale_keys), strict=True), 1):
                self._kept[entry.key] = (entry.modified, record)
                if advance:
                    advance(done, len(stale))
        records = [self._kept[entry.key][1] for entry in recent]
        now = datetime.now(UTC)
        for entry in recent:
            if now - entry.modified < SETTLED and self._kept[entry.key][1] is not None:
                del self._kept[entry.key]
        return [record for record in records if record is not None]

    def open(self, max_runtime: int, now: datetime) -> list[Server]:
        """Read the records of servers that are not closed. `max_runtime` is the installation's, in minutes.

        An open record was written last when its server became ready, so no longer ago than a server may live.
        """
        recent = self.since(now - timedelta(minutes=max_runtime) - SLACK)
        return [record for record in recent if not record.is_closed]

    def read(self, labels: Iterable[str]) -> dict[str, Server]:
        """Read the present records of these labels. Return them by label, without the records that cannot be read."""
        keys = sorted({server.key(label) for label in labels})
        with ThreadPoolExecutor(READERS) as pool:
            loaded = pool.map(self._load, keys)
            return {record.label: record for record in loaded if record is not None}

    def owners(self, names: Iterable[str]) -> dict[str, Server]:
        """Find the records that own these resource names, by the rule of `Repository.owner`. Other names are left out.

        It takes two rounds of reads: an assigned warm server leads from its own record to the participant's.
        """
        names = [*names]
        records = self.read(parsed[0] for name in names if (parsed := ids.parse_server_name(name)))
        records |= self.read({record.assigned_to for record in records.values() if record.assigned_to})
        owner_ids = {name: server.owner(name, records.get, lambda record: record) for name in names}
        return {name: record for name, record in owner_ids.items() if record is not None}

    def _is_stale(self, entry: Entry) -> bool:
        kept = self._kept.get(entry.key)
        return kept is None or kept[0] != entry.modified

    def _load(self, key: str) -> Server | None:
        document = self._documents.get(key)
        try:
            record = from_json(document.body, Server) if document else None
        except ValueError:
            return None
        # A record names its server. A record under another server's key does not count.
        return record if record and key == server.key(record.label) else None


def _is_record(key: str) -> bool:
    label = key.removeprefix(RECORDS).removesuffix(".json")
    return key.endswith(".json") and ids.parse_server_name(f"{label}-1") is not None


def attempts_of(record: Server) -> list[PastAttempt]:
    """Return all attempts of a record, oldest first; the last is the present one."""
    return [*record.earlier, past_attempt(record)]


def warm_servers_of(record: Server | None) -> list[str]:
    """Return the names of the warm servers that a record's owner was given, in all attempts."""
    return [attempt.warm_server_name for attempt in attempts_of(record) if attempt.warm_server_name] if record else []


def keys_of_warm_servers(project_id: str, names: Collection[str]) -> list[str]:
    """Return the keys of these warm servers' handover documents and records, sorted."""
    labels = [parsed[0] for name in names if (parsed := ids.parse_server_name(name))]
    return sorted([*(handover_key(project_id, name) for name in names), *(server.key(label) for label in labels)])
