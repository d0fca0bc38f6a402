"""DNS names of servers in a Route 53 hosted zone.

Facts (Route 53 Developer Guide and API Reference, read November 2026). A batch is done as a whole or not at all and may
hold 1,000 records, an UPSERT counting twice. A DELETE must give the record's present values and TTL, else the batch is
refused with InvalidChangeBatch, whose message names each offender: "[Tried to delete resource record set
[name='a.example.org.', type='A'] but it was not found]", or "… but the values provided do not match the current
values". Names come back with a final dot, characters other than letters, digits and `-_.` as octal codes (`\\052`).
Changes of a zone that meet are PriorRequestNotComplete; the account has 10 calls/s (50 at once) and, as of 2026, 100
changes/s (1,500 at once), an UPSERT counting twice ("Throttling for Amazon Route 53 API requests"): all of that is
waited for a while. A batch must not be larger than what is allowed at once, or it would never be taken.
An addition that cannot be made refuses the whole batch too, with InvalidChangeBatch or InvalidInput: a label of more
than 63 bytes ("FATAL problem: DomainLabelTooLong (Domain label is too long) encountered with '…'", external-dns 2839),
or a name that is a CNAME already ("RRSet of type A with DNS name … is not permitted because a conflicting RRSet of
type CNAME with the same DNS name already exists", external-dns 1517). Such a batch is halved until only that is left.
A zone that somebody has deleted (NoSuchHostedZone) has no names, and nothing to remove: servers can be stopped then.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.aws import errors
from hippodrome.aws.patience import patiently
from hippodrome.model import ids
from hippodrome.ports import Busy, DnsRecord, RefusedDnsRecords

TTL = 60  # seconds. A record written with another TTL could not be deleted any more: DELETE must name it exactly.
BATCH = 400  # names in a batch

_Changes = list[dict[str, Any]]
_Refused = list[str]  # names

_REFUSALS = ("InvalidChangeBatch", "InvalidInput")
_NAMED = re.compile(r"name='([^']*)'")
_NO_ZONE = "NoSuchHostedZone"
_GONE = re.compile(r"not found|do not match the current values")
_OCTAL = re.compile(r"\\([0-7]{3})")


class Route53Dns:
    """Implements `hippodrome.ports.Dns`. A change's id is Route 53's; of a large change several, with commas."""

    def __init__(self, client: Callable[[], Any], need: Callable[[str], str], host: str = "") -> None:
        """`host`: the level below `ROOT_DOMAIN` where servers get their names."""
        self._client = client
        self._need = need
        self._host = host

    def change(self, add: Sequence[DnsRecord] = (), remove: Sequence[DnsRecord] = ()) -> str:
        """One ChangeResourceRecordSets (one per 400 names). A name that is both added and removed is added.

        A removal whose record is gone, or leads elsewhere by now, is left out and the rest asked for again; so is an
        addition that is refused, and `RefusedDnsRecords` says which. "" if nothing remained to change.
        """
        added = {record.name: record for record in add}
        changes = [_change("DELETE", record) for record in dict.fromkeys(remove) if record.name not in added]
        changes += [_change("UPSERT", record) for record in added.values()]
        rest = iter(changes)
        refused: _Refused = []
        made = [self._batch(batch, refused) for batch in iter(lambda: [*islice(rest, BATCH)], [])]
        change = ",".join(change for change in made if change)
        if refused:
            raise RefusedDnsRecords([added[name] for name in refused], change)
        return change

    def in_sync(self, change: str) -> bool:
        """One GetChange, none for "" (nothing had to change)."""
        try:
            return all(
                self._client().get_change(Id=part)["ChangeInfo"]["Status"] == "INSYNC"
                for part in change.split(",")
                if part
            )
        except ClientError as error:
            if _busy(error):
                raise Busy from error
            raise

    def list(self) -> Iterator[DnsRecord]:
        """Records such as `change` makes, below the servers' level; 300 records of the zone a request.

        Also those directly below `ROOT_DOMAIN`, where earlier versions made them.
        """
        domain = self._need("ROOT_DOMAIN").strip(".").lower()
        parents = {domain, f"{self._host}.{domain}"}
        for page in self._pages():
            for record in page["ResourceRecordSets"]:
                name = _plain(record["Name"])
                label, _, parent = name.partition(".")
                values = [item["Value"] for item in record.get("ResourceRecords", ())]
                like_ours = record["Type"] == "A" and record.get("TTL") == TTL and "SetIdentifier" not in record
                if like_ours and len(values) == 1 and parent in parents and ids.parse_server_name(label):
                    yield DnsRecord(name, values[0])

    def dial(self, record: DnsRecord) -> str:
        return record.name

    def _pages(self) -> Iterator[Mapping[str, Any]]:
        pages = self._client().get_paginator("list_resource_record_sets")
        try:
            yield from pages.paginate(HostedZoneId=self._need("HOSTED_ZONE_ID"))
        except ClientError as error:
            if errors.code(error) != _NO_ZONE:
                raise

    def _batch(self, changes: _Changes, refused: _Refused) -> str:
        """Make the changes, without the removals that Route 53 says are done already, and without what it refuses."""
        while changes:
            try:
                return self._ask(changes)
            except ClientError as error:
                if errors.code(error) == _NO_ZONE and all(one["Action"] == "DELETE" for one in changes):
                    return ""
                if errors.code(error) not in _REFUSALS:
                    raise
                left = _without_gone(changes, _sentences(error))
                if len(left) == len(changes):
                    return self._halves(changes, refused, error)
                changes = left
        return ""

    def _halves(self, changes: _Changes, refused: _Refused, error: ClientError) -> str:
        """When the message does not say which removals failed: the halves, down to the single change that is wrong."""
        if len(changes) > 1:
            half = len(changes) // 2
            made = [self._batch(part, refused) for part in (changes[:half], changes[half:])]
            return ",".join(change for change in made if change)
        (change,) = changes
        if change["Action"] != "DELETE":
            refused.append(change["ResourceRecordSet"]["Name"])
        elif not _GONE.search(_sentences(error)):
            raise error
        return ""

    def _ask(self, changes: _Changes) -> str:
        def ask() -> str:
            answer = self._client().change_resource_record_sets(
                HostedZoneId=self._need("HOSTED_ZONE_ID"), ChangeBatch={"Changes": changes}
            )
            return str(answer["ChangeInfo"]["Id"])

        return patiently(ask, _busy)


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


def _without_gone(changes: _Changes, text: str) -> _Changes:
    """The changes but for the removals that `text` says are done already."""
    gone: set[str] = set()
    for sentence in re.split(r"(?=Tried to )", text):
        if sentence.startswith("Tried to delete") and _GONE.search(sentence):
            gone.update(_plain(name) for name in _NAMED.findall(sentence))
    return [c for c in changes if c["Action"] != "DELETE" or _plain(c["ResourceRecordSet"]["Name"]) not in gone]


def _sentences(error: ClientError) -> str:
    return " ".join([errors.message(error), *map(str, error.response.get("messages", ()))])


def _plain(name: str) -> str:
    """A name as people write it: unescaped, in lower case, without the final dot."""
    return _OCTAL.sub(lambda found: chr(int(found[1], 8)), name).rstrip(".").lower()
