"""How long AWS alone would take: the bound for every way to serve a crowd, with none of our code in it.

An ideal control plane asks at the moment at which the participant asks, has no latency, and looks at nothing: it calls
RunTask as early as the account's token buckets admit, changes the zone at the moment at which EC2 shows the address of
a task that runs (or, while another change keeps the zone busy, with everything that has come to run since), and shows
`ready` at the moment at which the change is INSYNC. Only AWS's quotas, start times, late addresses, DNS times with
their slow spans, and the busy zone remain.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence

from testing.simulation.cloud import QUOTAS
from testing.simulation.conditions import Conditions, address_lag, draws, propagation, start_time
from testing.simulation.ports import MAX_CHANGES


def aws_alone(asked: Sequence[float], seed: int, conditions: Conditions | None = None) -> list[float]:
    """Seconds that each participant waits who asks at these seconds. The same arguments give the same result.

    The seed is that of the simulated run, whose start times and DNS times are drawn in the same order.

    Interruptions are left out: they only add to what participants wait. Where Spot is sold out, on demand has the same
    quotas and start times.
    """
    return [ready - came for came, ready in _served(asked, seed, conditions)]


def aws_alone_together(
    under_way: Sequence[float], lobby: Sequence[float], players: int, seed: int, conditions: Conditions | None = None
) -> list[float]:
    """Seconds from the lobby until the server is ready, of those who come there at these seconds to play together.

    One server is asked for as soon as the first of each `players` is under way. The first `players` who come to the
    lobby are a session at the moment at which the last of them comes, and get the server that is ready first. Those who
    are left over are left out.
    """
    asked = sorted(under_way)[::players]
    ready = sorted(ready for _, ready in _served(asked, seed, conditions))
    came = sorted(lobby)
    sessions = [came[at : at + players] for at in range(0, len(came) - players + 1, players)]
    pairs = zip(sessions, ready, strict=False)
    return [max(members[-1], server) - one for members, server in pairs for one in members]


def _served(asked: Sequence[float], seed: int, conditions: Conditions | None = None) -> Iterator[tuple[float, float]]:
    """For each server that is asked for at these seconds: this second, and that at which it is ready."""
    conditions, starts, spreads = conditions or Conditions(), draws(seed, "starts"), draws(seed, "propagation")
    chance, lags = random.Random(seed), draws(seed, "addresses")
    arrivals = sorted(asked)
    runs = sorted(
        (launched + start_time(starts, conditions.starts) + address_lag(lags, conditions), came)
        for launched, came in zip(_admitted(arrivals), arrivals, strict=True)
    )
    free, change = 0.0, QUOTAS["route53"]
    most, gap = MAX_CHANGES // 2, 1 / change[0]
    while runs:
        begins = max(free, runs[0][0])
        batch = [run for run in runs[:most] if run[0] <= begins]
        runs = runs[len(batch) :]
        free = begins + max(gap, chance.uniform(*conditions.busy_zone))
        in_sync = begins + propagation(spreads, conditions, seed, begins)
        yield from ((came, in_sync) for _, came in batch)


def _admitted(arrivals: Sequence[float]) -> list[float]:
    """When RunTask is called for each arrival: as early as its own bucket and the bucket of launches have a token."""
    found = list(arrivals)
    for quota in ("ecs:RunTask", "launch:spot"):
        rate, burst = QUOTAS[quota]
        tokens, since, admitted = burst, 0.0, list[float]()
        for arrival in found:
            now = max(arrival, since)
            tokens = min(burst, tokens + (now - since) * rate)
            wait = max(0.0, (1 - tokens) / rate)
            tokens, since = tokens + wait * rate - 1, now + wait
            admitted.append(since)
        found = admitted
    return found
