"""What servers did cost: from their own records, and the price table. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime

from deploy.core.server_records import runs
from deploy.cost.prices import FARGATE_MINIMUM, Prices, Usd
from hippodrome.model.server import PastAttempt, Reason, Server

Size = tuple[float, float]  # vCPU, GB


@dataclass
class Spent:
    """The sum of what servers cost."""

    usd: Usd = field(default_factory=Usd)
    hours: float = 0.0  # of servers
    attempts: int = 0  # that ran; one that took over a warm server is no other server
    never_ran: int = 0  # asked for, and not counted: no room, refused, or lost before it ran
    guessed: int = 0  # whose size was not on record

    def add(self, other: Spent) -> None:
        self.usd += other.usd
        self.hours += other.hours
        self.attempts += other.attempts
        self.never_ran += other.never_ran
        self.guessed += other.guessed


def spent(
    records: Iterable[Server], prices: Prices, now: datetime, sizes: dict[str, Size], since: datetime | None = None
) -> Spent:
    """What these servers have cost until now, or since `since`.

    Fargate bills from the download of the image, which begins seconds after the request and is not on record: so from
    the request on. A warm server is two records: its own says how long it waited, and that of the participant who took
    it how long it was played on. `sizes` are those of the projects by id, for records that do not say what the server
    ran on.
    """
    total = Spent()
    for record in records:
        for run in runs(record):
            total.add(_of(run, prices, now, sizes.get(record.project_id, (1.0, 2.0)), since))
    return total


def _of(run: PastAttempt, prices: Prices, now: datetime, usual: Size, since: datetime | None) -> Spent:
    end = run.closed or now
    if since and end <= since:
        return Spent()
    if run.running is None and run.closed is not None:
        return Spent(never_ran=1)
    begin = max(run.requested, since) if since else run.requested
    seconds = (end - begin).total_seconds()
    if begin == run.requested and not _is_part(run):
        seconds = max(seconds, FARGATE_MINIMUM)
    hours = max(seconds, 0.0) / 3600
    cpu, memory = (run.cpu, run.memory) if run.cpu else usual
    usd = prices.server_hour(cpu, memory, spot=run.spot) * hours
    return Spent(usd, hours, attempts=int(not run.warm_server_name), guessed=int(not run.cpu))


def _is_part(run: PastAttempt) -> bool:
    """Whether it is the waiting, or the play, of one task: the minute that is billed at least is that of both."""
    return run.reason is Reason.ASSIGNED or run.warm_server_name is not None
