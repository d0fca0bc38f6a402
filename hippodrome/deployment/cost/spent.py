"""Computes what servers have cost, from their records and the price table. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime

from hippodrome.control.model.server import PastAttempt, Reason, Server
from hippodrome.deployment.core.server_records import attempts_of
from hippodrome.deployment.cost.prices import FARGATE_MINIMUM, Prices, Usd

Size = tuple[float, float]  # vCPU, GB


@dataclass
class Spent:
    """The sum of what some servers have cost."""

    usd: Usd = field(default_factory=Usd)
    hours: float = 0.0  # the hours of servers
    attempts: int = 0  # attempts that ran; one on a warm server is not counted, since the warm server's own record is
    never_ran: int = 0  # attempts that are not in the sum: no room, refused, or lost before the task ran
    guessed: int = 0  # attempts whose record has no size

    def add(self, other: Spent) -> None:
        """Add the figures of another sum to this one."""
        self.usd += other.usd
        self.hours += other.hours
        self.attempts += other.attempts
        self.never_ran += other.never_ran
        self.guessed += other.guessed


def spent(
    records: Iterable[Server], prices: Prices, now: datetime, sizes: dict[str, Size], since: datetime | None = None
) -> Spent:
    """Compute what these servers have cost until now, from their start or from `since` on.

    Fargate bills from the download of the image on. That begins seconds after the request and is not in the record, so
    the time counts from the request. A warm server has two records: its own says how long it waited, and the record of
    the participant who got it says how long they played. `sizes` are the projects' sizes by id, for attempts whose
    record has no size.
    """
    total = Spent()
    for record in records:
        for attempt in attempts_of(record):
            total.add(_cost_of(attempt, prices, now, sizes.get(record.project_id, (1.0, 2.0)), since))
    return total


def _cost_of(attempt: PastAttempt, prices: Prices, now: datetime, usual: Size, since: datetime | None) -> Spent:
    end = attempt.closed or now
    if since and end <= since:
        return Spent()
    if attempt.running is None and attempt.closed is not None:
        return Spent(never_ran=1)
    begin = max(attempt.requested, since) if since else attempt.requested
    seconds = (end - begin).total_seconds()
    if begin == attempt.requested and not _is_part(attempt):
        seconds = max(seconds, FARGATE_MINIMUM)
    hours = max(seconds, 0.0) / 3600
    cpu, memory = (attempt.cpu, attempt.memory) if attempt.cpu else usual
    usd = prices.server_hour(cpu, memory, spot=attempt.spot) * hours
    return Spent(usd, hours, attempts=int(not attempt.warm_server_name), guessed=int(not attempt.cpu))


def _is_part(attempt: PastAttempt) -> bool:
    """Whether the attempt is one of the two parts of a warm server's task, which have one billed minimum together."""
    return attempt.reason is Reason.ASSIGNED or attempt.warm_server_name is not None
