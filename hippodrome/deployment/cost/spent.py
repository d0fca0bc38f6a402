"""Computes what servers have cost, from their records and list prices; and asks AWS what it has billed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import date, datetime

from hippodrome.control.model.server import PastAttempt, Reason, Server
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.aws.resource_names import TAG
from hippodrome.deployment.core.server_records import attempts_of
from hippodrome.deployment.cost.prices import FARGATE_MINIMUM, Range, server_hour


@dataclass
class Spent:
    """The sum of what some servers have cost, in US dollars."""

    usd: Range = field(default_factory=Range)
    hours: float = 0.0  # the hours of servers
    attempts: int = 0  # attempts that ran; one on a warm server is not counted, since the warm server's own record is
    never_ran: int = 0  # attempts that are not in the sum: no room, refused, or lost before the task ran

    def add(self, other: Spent) -> None:
        """Add the figures of another sum to this one."""
        self.usd += other.usd
        self.hours += other.hours
        self.attempts += other.attempts
        self.never_ran += other.never_ran


def spent(records: Iterable[Server], now: datetime, since: datetime | None = None) -> Spent:
    """Compute what these servers have cost until now, from their start or from `since` on.

    Fargate bills from the download of the image on. That begins seconds after the request and is not in the record, so
    the time counts from the request. A warm server has two records: its own says how long it waited, and the record of
    the participant who got it says how long they played.
    """
    total = Spent()
    for record in records:
        for attempt in attempts_of(record):
            total.add(_cost_of(attempt, now, since))
    return total


def _cost_of(attempt: PastAttempt, now: datetime, since: datetime | None) -> Spent:
    end = attempt.closed or now
    if since and end <= since:
        return Spent()
    if attempt.running is None and attempt.closed is not None:
        return Spent(never_ran=1)
    begin = max(attempt.requested, since) if since else attempt.requested
    seconds = (end - begin).total_seconds()
    # A warm server's task has two records, and one billed minimum.
    is_part = attempt.reason is Reason.ASSIGNED or attempt.warm_server_name is not None
    if begin == attempt.requested and not is_part:
        seconds = max(seconds, FARGATE_MINIMUM)
    hours = max(seconds, 0.0) / 3600
    usd = server_hour(attempt.cpu, attempt.memory, spot=attempt.spot) * hours
    return Spent(usd, hours, attempts=int(not attempt.warm_server_name))


def billed(account: Account, stack: str, start: date, end: date) -> dict[str, float]:
    """Ask Cost Explorer what AWS has billed by service, in US dollars, from `start` up to `end`, without that day.

    It is a day behind, costs `EXPLORER_REQUEST`, and knows the resources with the stack's tag, from the day on which
    the tag was made a cost allocation tag. Raises ClientError if Cost Explorer refuses.
    """
    answer = account.client("ce", "us-east-1").get_cost_and_usage(
        TimePeriod={"Start": start.isoformat(), "End": end.isoformat()},
        Granularity="MONTHLY",
        Metrics=["UnblendedCost"],
        Filter={"Tags": {"Key": TAG, "Values": [stack], "MatchOptions": ["EQUALS"]}},
        GroupBy=[{"Type": "DIMENSION", "Key": "SERVICE"}],
    )
    sums: dict[str, float] = {}
    for period in answer["ResultsByTime"]:
        for group in period["Groups"]:
            amount = float(group["Metrics"]["UnblendedCost"]["Amount"])
            sums[group["Keys"][0]] = sums.get(group["Keys"][0], 0.0) + amount
    return sums
