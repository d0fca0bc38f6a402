"""ACME's DNS-01 challenges in a Route 53 hosted zone.

Facts (Route 53 API Reference and Developer Guide, read November 2026): a TXT value is quoted, at most 255 characters a
string; UPSERT replaces the whole record set, so others' values must be sent along; DELETE must give the values and TTL
that are there. INSYNC means that every name server of the zone answers with the change.

Needs route53:ListResourceRecordSets (on the zone; it knows no condition by name), route53:ChangeResourceRecordSets with
UPSERT and DELETE of TXT at `_acme-challenge.<domain>` only, and route53:GetChange.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.aws import errors
from hippodrome.certificate import OrderFailed, Trouble

TTL = 60  # seconds
PAUSE = 3.0  # seconds between two looks whether the name servers have it; usually they do within half a minute


class Route53Challenges:
    """Implements `hippodrome.certificate_renewal.Challenges`."""

    def __init__(
        self, client: Callable[[], Any], need: Callable[[str], str], sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._client = client
        self._need = need
        self._sleep = sleep

    def put(self, name: str, values: Sequence[str], seconds: float) -> None:
        deadline = time.monotonic() + seconds
        present = self._record(name)
        kept = [] if present is None else [item["Value"] for item in present["ResourceRecords"]]
        wanted = list(dict.fromkeys([*kept, *map(_quoted, values)]))
        try:
            change = self._change("UPSERT", _record(name, wanted, present))
        except ClientError as error:
            if errors.code(error) == "NoSuchHostedZone":
                raise OrderFailed(Trouble.DNS, "the hosted zone does not exist any more") from error
            if errors.code(error) == "InvalidChangeBatch":  # such as a CNAME in its place, or another zone's name
                raise OrderFailed(Trouble.DNS, f"Route 53 does not take the record {name}") from error
            raise
        while self._client().get_change(Id=change)["ChangeInfo"]["Status"] != "INSYNC":
            if time.monotonic() + PAUSE > deadline:
                raise OrderFailed(Trouble.TIMEOUT, "Route 53's name servers did not take over the record in time")
            self._sleep(PAUSE)

    def remove(self, name: str, values: Sequence[str]) -> None:
        present = self._record(name)
        if present is None:
            return
        gone = set(map(_quoted, values))
        left = [item["Value"] for item in present["ResourceRecords"] if item["Value"] not in gone]
        if len(left) == len(present["ResourceRecords"]):
            return
        if left:
            self._change("UPSERT", _record(name, left, present))
        else:
            self._change("DELETE", present)

    def _record(self, name: str) -> dict[str, Any] | None:
        """The TXT record of that name as it is."""
        found = self._client().list_resource_record_sets(
            HostedZoneId=self._need("HOSTED_ZONE_ID"), StartRecordName=name, StartRecordType="TXT", MaxItems="1"
        )["ResourceRecordSets"]
        for record in found:  # the first at or after that name
            if record["Name"].rstrip(".").lower() == name.lower() and record["Type"] == "TXT":
                exact: dict[str, Any] = record
                return exact
        return None

    def _change(self, action: str, record: dict[str, Any]) -> str:
        answer = self._client().change_resource_record_sets(
            HostedZoneId=self._need("HOSTED_ZONE_ID"),
            ChangeBatch={"Changes": [{"Action": action, "ResourceRecordSet": record}]},
        )
        return str(answer["ChangeInfo"]["Id"])


def _record(name: str, values: Sequence[str], present: dict[str, Any] | None) -> dict[str, Any]:
    return {
        "Name": name,
        "Type": "TXT",
        "TTL": present["TTL"] if present else TTL,
        "ResourceRecords": [{"Value": value} for value in values],
    }


def _quoted(value: str) -> str:
    return f'"{value}"'
