"""Servers' DNS records in a file. Browsers do not look names up in it: `local/web/names.py` does, with TLS."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from hippodrome.control.model import ids
from hippodrome.control.ports import DnsRecord
from hippodrome.local.backend import files
from hippodrome.local.backend.retry import Retry, reports_errors
from hippodrome.protocol import disk


@reports_errors
class FileDns:
    """Implements `hippodrome.control.ports.Dns`. A change is in sync at once."""

    def __init__(self, state: Path, retry: Retry | None = None, *, named: bool = False) -> None:
        """`named`: browsers connect to servers' names (`hippodrome/local/web/names.py`), not to their addresses."""
        self.retry = retry or Retry()
        self._file = state / "names.json"
        self._lock = state / "locks" / "names"
        disk.make_folder(self._lock.parent)
        self._named = named

    def change(self, add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        with files.locked(self._lock):
            before = self._zone()
            zone = dict(before)
            for record in remove:
                if zone.get(record.name) == record.host:
                    del zone[record.name]
            zone.update({record.name: record.host for record in add})
            if zone != before:
                files.write_json(self._file, zone, durable=False)  # a power cut ends every server, too
        return ""

    def in_sync(self, change: str) -> bool:
        return True

    def list(self) -> Iterator[DnsRecord]:
        for name, host in self._zone().items():
            if ids.parse_server_name(name.partition(".")[0]):
                yield DnsRecord(name, host)

    def browser_host(self, record: DnsRecord) -> str:
        return record.name if self._named else record.host

    def has(self, name: str) -> bool:
        """Return whether there is a record of this name."""
        return name in self._zone()

    def _zone(self) -> dict[str, str]:
        zone: dict[str, str] = files.read_json(self._file) or {}
        return zone
