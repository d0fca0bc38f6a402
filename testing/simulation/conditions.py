"""The behaviour of AWS in a run of the simulation: durations, and the shares of faults."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

from testing.simulation.cloud import LATENCY

STARTS = (25.0, 0.4, 90.0)  # seconds from RunTask to RUNNING: median, sigma of its logarithm, and the longest
PROPAGATION = (20.0, 60.0)  # seconds until a change of the zone is INSYNC
SLOW_PROPAGATION = (60.0, 120.0)  # seconds, while Route 53 is slow: libdns/route53 issue 14, certbot pull request 6071
SLOW_ZONE, SLOW_FOR = 0.1, 5.0  # the share of the time in which it is slow; the seconds of each slow span
ADDRESS_LATE = (1.0, 20.0)  # seconds after RUNNING in which DescribeNetworkInterfaces may not have the address yet
AUTHORITY = (4.0, 9.0)  # seconds: two to start the process, and an order at Let's Encrypt: caddyserver/caddy issue 7399
"""(account and order in 1.3 s) and 6574 (the certificate in 1 s), certmate v2.53.0 (9 s on staging); no such order was
measured here."""
BUSY_ZONE = (0.2, 1.0)  # seconds during which another change of the zone is PriorRequestNotComplete


@dataclass
class Conditions:
    """The behaviour of AWS in a run. Shares are shares of tasks, events or messages; times are seconds."""

    repeated: float = 0.02  # events and messages that come twice
    late: float = 0.05  # events that come 1 to 20 s late, and so out of order
    lost: float = 0.0  # events that never come
    no_spot: Callable[[float], bool] = field(default=lambda seconds: False)  # whether Spot is sold out at that second
    interrupted: float = 0.0  # Spot tasks that are interrupted
    interrupted_after: tuple[float, float] = (5.0, 600.0)  # the seconds after which they are interrupted
    untold: float = 0.5  # the share of these whose events have no stopCode: aws/containers-roadmap issues 1565 and 797
    late_addresses: float = 0.05  # tasks whose address EC2 does not show at once
    address_late: tuple[float, float] = ADDRESS_LATE
    stillborn: float = 0.0  # tasks that end before they run: an image that cannot be pulled
    starts: tuple[float, float, float] = STARTS
    propagation: tuple[float, float] = PROPAGATION
    slow_zone: float = SLOW_ZONE
    slow_propagation: tuple[float, float] = SLOW_PROPAGATION
    busy_zone: tuple[float, float] = BUSY_ZONE
    authority: tuple[float, float] | None = None  # from RUNNING to an issued certificate; None: servers have names
    s3: tuple[float, float] = LATENCY["s3"]  # latency of a call of S3
    idle: float = 600.0  # seconds for which a trial waits for its participant


def draws(seed: int, kind: str) -> random.Random:
    """Return a generator for one kind of draw, so that `aws_bound.py` can draw the same numbers as the simulation."""
    return random.Random(f"{seed} {kind}")


def start_time(chance: random.Random, starts: tuple[float, float, float]) -> float:
    """Draw the seconds that one task takes from RunTask to RUNNING."""
    median, sigma, longest = starts
    return min(longest, median * math.exp(chance.gauss(0, sigma)))


def address_lag(chance: random.Random, conditions: Conditions) -> float:
    """Draw the seconds after RUNNING until EC2 shows the public address of one task.

    EC2 is "eventually consistent" (EC2 API Reference, "Troubleshooting API request errors"): it may not find an interface
    yet, or show it without its address (hashicorp/terraform-provider-aws issue 35568).
    """
    late = chance.random() < conditions.late_addresses
    return chance.uniform(*conditions.address_late) if late else 0.0


def propagation(chance: random.Random, conditions: Conditions, seed: int, seconds: float) -> float:
    """Draw the seconds until a change that is made at this second is INSYNC.

    In a slow span of Route 53, every change is slow. The seed and the second decide what is a slow span, so a caller
    that makes changes at other moments (`aws_bound.py`) has the same slow spans. One of every ten spans is slow if the
    share is 0.1.
    """
    slow = conditions.slow_zone and _is_slow(seed, round(1 / conditions.slow_zone), int(seconds // SLOW_FOR))
    return chance.uniform(*(conditions.slow_propagation if slow else conditions.propagation))


@cache
def _is_slow(seed: int, among: int, span: int) -> bool:
    """Return whether Route 53 is slow in this span. Of each `among` spans in a row, one is slow."""
    return random.Random(f"{seed} slow zone {span // among}").randrange(among) == span % among
