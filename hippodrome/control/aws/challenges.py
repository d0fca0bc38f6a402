"""Publishes ACME's DNS-01 challenges as TXT records in a Route 53 hosted zone.

Facts (Route 53 API Reference and Developer Guide, read November 2026): a TXT value is one or more quoted strings of at
most 255 characters. UPSERT replaces the whole record. DELETE must name the present values and TTL; otherwise Route 53
refuses it with InvalidChangeBatch. INSYNC means that every name server of the zone answers with the change.

The caller's role needs route53:ChangeResourceRecordSets with UPSERT and DELETE of TXT at `_acme-challenge.<domain>`,
and route53:GetChange. It needs no right to list the zone, so an UPSERT also replaces another program's values in that
record: a program that proves the same domain in the same minute has to begin again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.control.aws import errors
from hippodrome.control.certificates.rules import FailureReason, OrderFailed

TTL = 60  # seconds. Never change it: DELETE must name a record's TTL, so earlier records could not be deleted.
POLL_PAUSE = 3.0  # seconds between two calls of GetChange; a change is usually INSYNC within 30 seconds


class Route53Challenges:
    """Implements `hippodrome.control.certificates.renewal.Challenges`."""

    def __init__(
        self, client: Callable[[], Any], need: Callable[[str], str], sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._client = client
        self._need = need
        self._sleep = sleep

    def put(self, name: str, values: Sequence[str], seconds: float) -> None:
        deadline = time.monotonic() + seconds
        try:
            change = self._change("UPSERT", name, values)
        except ClientError as error:
            if errors.code(error) == "NoSuchHostedZone":
                raise OrderFailed(FailureReason.DNS, "the hosted zone does not exist any more") from error
            if errors.code(error) == "InvalidChangeBatch":  # such as: a CNAME has that name already
                reason = error.response["Error"].get("Message") or "it does not say why"
                raise OrderFailed(FailureReason.DNS, f"Route 53 refuses the TXT record {name}: {reason}") from error
            raise
        while self._client().get_change(Id=change)["ChangeInfo"]["Status"] != "INSYNC":
            if time.monotonic() + POLL_PAUSE > deadline:
                raise OrderFailed(FailureReason.TIMEOUT, "the TXT record did not reach Route 53's name servers in time")
            self._sleep(POLL_PAUSE)

    def remove(self, name: str, values: Sequence[str]) -> None:
        try:
            self._change("DELETE", name, values)
        except ClientError as error:
            # InvalidChangeBatch: the record is deleted already, or another program has replaced its values.
            if errors.code(error) not in {"InvalidChangeBatch", "NoSuchHostedZone"}:
                raise

    def _change(self, action: str, name: str, values: Sequence[str]) -> str:
        record = {
            "Name": name,
            "Type": "TXT",
            "TTL": TTL,
            "ResourceRecords": [{"Value": f'"{value}"'} for value in dict.fromkeys(values)],
        }
        answer = self._client().change_resource_record_sets(
            HostedZoneId=self._need("HOSTED_ZONE_ID"),
            ChangeBatch={"Changes": [{"Action": action, "ResourceRecordSet": record}]},
        )
        return str(answer["ChangeInfo"]["Id"])
