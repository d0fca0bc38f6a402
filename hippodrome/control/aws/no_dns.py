"""An installation without a domain: servers have no names, and browsers connect to their addresses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from hippodrome.control.ports import DnsRecord


class NoDns:
    """Implements `hippodrome.control.ports.Dns`. There are no records, and none can be made."""

    def change(self, add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        if add:
            raise RuntimeError("the environment variable HOSTED_ZONE_ID is missing; the port 'dns' needs it for names")
        return ""

    def in_sync(self, change: str) -> bool:
        return True

    def list(self) -> Iterator[DnsRecord]:
        return iter(())

    def browser_host(self, record: DnsRecord) -> str:
        return record.name
