"""Servers' DNS records, in memory. Browsers do not look names up here: `local/web/names.py` does, with TLS."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence

from hippodrome.control.model import ids
from hippodrome.control.ports import DnsRecord


class LocalDns:
    """Implements `hippodrome.control.ports.Dns`. A change is in sync at once."""

    def __init__(self, *, named: bool = False) -> None:
        """`named`: browsers connect to servers' names (`hippodrome/local/web/names.py`), not to their addresses."""
        self._named = named
        self._lock = threading.Lock()
        self._zone: dict[str, str] = {}

    def change(self, add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        with self._lock:
            for record in remove:
                if self._zone.get(record.name) == record.host:
                    del self._zone[record.name]
            self._zone.update({record.name: record.host for record in add})
        return ""

    def in_sync(self, change: str) -> bool:
        return True

    def list(self) -> Iterator[DnsRecord]:
        with self._lock:
            records = [DnsRecord(name, host) for name, host in self._zone.items()]
        yield from (record for record in records if ids.parse_server_name(record.name.partition(".")[0]))

    def browser_host(self, record: DnsRecord) -> str:
        return record.name if self._named else record.host

    def has(self, name: str) -> bool:
        """Return whether there is a record of this name."""
        return name in self._zone
