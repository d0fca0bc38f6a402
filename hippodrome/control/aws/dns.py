"""Creates, deletes and lists the servers' DNS records in a Route 53 hosted zone.

Facts (Route 53 Developer Guide and API Reference, read November 2026):

* A batch is applied as a whole or not at all. It may hold 1,000 records, an UPSERT counting twice.
* A DELETE must name the record's present values and TTL. Otherwise the batch is refused with InvalidChangeBatch, whose
  message names each offender: "[Tried to delete resource record set [name='a.example.org.', type='A'] but it was not
  found]", or "… but the values provided do not match the current values".
* Route 53 returns names with a final dot, and characters other than letters, digits and `-_.` as octal codes (`\\052`).
* Concurrent changes of a zone are refused with PriorRequestNotComplete. The account may make 10 calls/s (burst 50) and,
  as of 2026, 100 changes/s (burst 1,500), an UPSERT counting twice ("Throttling for Amazon Route 53 API requests").
  `aws/retry.py` repeats refused calls for up to 30 seconds. A batch larger than the burst would never be accepted.
* An UPSERT that cannot be applied refuses the whole batch too, with InvalidChangeBatch or InvalidInput: a label of more
  than 63 bytes ("FATAL problem: DomainLabelTooLong (Domain label is too long) encountered with '…'", external-dns
  2839), or a name that has a CNAME ("RRSet of type A with DNS name … is not permitted because a conflicting RRSet of
  type CNAME with the same DNS name already exists", external-dns 1517). Such a batch is halved until only those remain.
* A zone that was deleted (NoSuchHostedZone) has no records. Removals succeed then, so that servers can be stopped.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.control.aws import errors
from hippodrome.control.aws.retry import retry_while_busy
from hippodrome.control.model import ids
from hippodrome.control.ports import DnsRecord, RefusedDnsRecords, ServiceBusy

TTL = 60  # seconds. Never change it: DELETE must name a record's TTL, so earlier records could not be deleted.
BATCH = 400  # records in a batch

_Changes = list[dict[str, Any]]
_Refused = list[str]  # the names of records that Route 53 refuses

_REFUSALS = ("InvalidChangeBatch", "InvalidInput")
_NAMED = re.compile(r"name='([^']*)'")
_NO_ZONE = "NoSuchHostedZone"
_ALREADY_DELETED = re.compile(r"not found|do not match the current values")
_OCTAL = re.compile(r"\\([0-7]{3})")


class Route53Dns:
    """Implements `control.ports.Dns`. A change's id is Route 53's; with several batches, theirs joined by commas."""

    def __init__(self, client: Callable[[], Any], need: Callable[[str], str], host: str = "") -> None:
        """Use this client. `need` returns an environment variable. Servers' names lie in `{host}.{ROOT_DOMAIN}`."""
        self._client = client
        self._need = need
        self._host = host

    def change(self, add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        """Make these changes of the zone, and return an id for `in_sync`; "" if nothing had to change.

        A record that is both added and removed is added. If a record to remove does not exist, or has another value,
        the batch is sent again without it. A refused addition is left out as well; all other changes are made, and then
        this raises `RefusedDnsRecords`, which names it. AWS calls: one ChangeResourceRecordSets for each 400 records.
        """
        added = {record.name: record for record in add}
        changes = [_change("DELETE", record) for record in dict.fromkeys(remove) if record.name not in added]
        changes += [_change("UPSERT", record) for record in added.values()]
        refused: _Refused = []
        batches = [self._change_batch(changes[at : at + BATCH], refused) for at in range(0, len(changes), BATCH)]
        change = ",".join(change for change in batches if change)
        if refused:
            raise RefusedDnsRecords([added[name] for name in refused], change)
        return change

    def in_sync(self, change: str) -> bool:
        """Return whether all name servers have this change; True for "". Raises `ServiceBusy`.

        AWS calls: one GetChange for each of the ids in `change`.
        """
        try:
            return all(
                self._client().get_change(Id=part)["ChangeInfo"]["Status"] == "INSYNC"
                for part in change.split(",")
                if part
            )
        except ClientError as error:
            if _busy(error):
                raise ServiceBusy from error
            raise

    def list(self) -> Iterator[DnsRecord]:
        """Yield the A records that have the form of the servers' records, which `change` creates.

        AWS calls: one for each 300 records of the zone.
        """
        domain = f"{self._host}.{self._need('ROOT_DOMAIN').strip('.').lower()}"
        for page in self._pages():
            for record in page["ResourceRecordSets"]:
                name = _normalised(record["Name"])
                label, _, parent = name.partition(".")
                values = [item["Value"] for item in record.get("ResourceRecords", ())]
                like_ours = record["Type"] == "A" and record.get("TTL") == TTL and "SetIdentifier" not in record
                if like_ours and len(values) == 1 and parent == domain and ids.parse_server_name(label):
                    yield DnsRecord(name, values[0])

    def browser_host(self, record: DnsRecord) -> str:
        return record.name

    def _pages(self) -> Iterator[Mapping[str, Any]]:
        pages = self._client().get_paginator("list_resource_record_sets")
        try:
            yield from pages.paginate(HostedZoneId=self._need("HOSTED_ZONE_ID"))
        except ClientError as error:
            if errors.code(error) != _NO_ZONE:
                raise

    def _change_batch(self, changes: _Changes, refused: _Refused) -> str:
        """Make these changes; return the change's id, or "" if none was left. Appends refused names to `refused`."""
        while changes:
            try:
                return self._send(changes)
            except ClientError as error:
                if errors.code(error) == _NO_ZONE and all(change["Action"] == "DELETE" for change in changes):
                    return ""
                if errors.code(error) not in _REFUSALS:
                    raise
                remaining = _without_deleted(changes, _error_text(error))
                if len(remaining) == len(changes):
                    return self._change_halves(changes, refused, error)
                changes = remaining
        return ""

    def _change_halves(self, changes: _Changes, refused: _Refused, error: ClientError) -> str:
        """Send each half on its own, down to the single refused change: the error does not say which one it is."""
        if len(changes) > 1:
            half = len(changes) // 2
            halves = [self._change_batch(part, refused) for part in (changes[:half], changes[half:])]
            return ",".join(change for change in halves if change)
        (change,) = changes
        if change["Action"] != "DELETE":
            refused.append(change["ResourceRecordSet"]["Name"])
        elif not _ALREADY_DELETED.search(_error_text(error)):
            raise error
        return ""

    def _send(self, changes: _Changes) -> str:
        def call() -> str:
            answer = self._client().change_resource_record_sets(
                HostedZoneId=self._need("HOSTED_ZONE_ID"), ChangeBatch={"Changes": changes}
            )
            return str(answer["ChangeInfo"]["Id"])

        return retry_while_busy(call, _busy)


def _busy(error: Exception) -> bool:
    return isinstance(error, ClientError) and errors.code(error) in ("PriorRequestNotComplete", "Throttling")


def _change(action: str, record: DnsRecord) -> dict[str, Any]:
    return {
        "Action": action,
        "ResourceRecordSet": {
            "Name": record.name,
            "Type": "A",
            "TTL": TTL,
            "ResourceRecords": [{"Value": record.host}],
        },
    }


def _without_deleted(changes: _Changes, text: str) -> _Changes:
    """The changes without the removals of records that do not exist any more, according to Route 53's error text."""
    deleted: set[str] = set()
    for sentence in re.split(r"(?=Tried to )", text):
        if sentence.startswith("Tried to delete") and _ALREADY_DELETED.search(sentence):
            deleted.update(_normalised(name) for name in _NAMED.findall(sentence))
    return [c for c in changes if c["Action"] != "DELETE" or _normalised(c["ResourceRecordSet"]["Name"]) not in deleted]


def _error_text(error: ClientError) -> str:
    return " ".join([errors.message(error), *map(str, error.response.get("messages", ()))])


def _normalised(name: str) -> str:
    """The name unescaped, in lower case, without the final dot."""
    return _OCTAL.sub(lambda digits: chr(int(digits[1], 8)), name).rstrip(".").lower()
