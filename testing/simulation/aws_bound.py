"""Computes how long AWS alone would take to serve a crowd, without our code.

The lower bound is for control planes that name a server when its task runs, as ours does. An ideal one of these has no
latency. It calls RunTask as early as the account's token buckets admit after the participant's request. It changes the
zone as soon as EC2 shows the address of the running task; while another change keeps the zone busy, it collects the
tasks of the next change. It shows `ready` as soon as the change is INSYNC. Only AWS's quotas, start times, late
addresses, DNS times with their slow spans, and the busy zone remain.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence

from testing.simulation.cloud import QUOTAS
from testing.simulation.conditions import Conditions, address_lag, draws, propagation, start_time
from testing.simulation.ports import MAX_CHANGES


def aws_alone(asked: Sequence[float], seed: int, conditions: Conditions | None = None) -> list[float]:
    """Return the seconds that each participant waits; `asked` are the seconds at which they request a server.

    The seed is that of the simulated run, whose start times and DNS times are drawn in the same order. The same
    arguments give the same result. Interruptions are left out, since they only make waits longer. Spot that is sold out
    changes nothing, since Fargate on demand has the same quotas and start times.
    """
    return [ready - came for came, ready in _served(asked, seed, conditions)]


def aws_alone_together(
    under_way: Sequence[float], lobby: Sequence[float], players: int, seed: int, conditions: Conditions | None = None
) -> list[float]:
    """Return the seconds that participants of sessions wait, from the lobby until their server is ready.

    `under_way` and `lobby` are the seconds at which participants get under way, and at which they come to the lobby. A
    server is requested when the first of each `players` participants gets under way. Participants form sessions in the
    order in which they come to the lobby, each when its last member comes; the first session gets the server that is
    ready first. Participants of an incomplete session are left out.
    """
    asked = sorted(under_way)[::players]
    ready = sorted(ready for _, ready in _served(asked, seed, conditions))
    came = sorted(lobby)
    sessions = [came[at : at + players] for at in range(0, len(came) - players + 1, players)]
    pairs = zip(sessions, ready, strict=False)
    return [max(members[-1], server) - one for members, server in pairs for one in members]


def _served(asked: Sequence[float], seed: int, conditions: Conditions | None = None) -> Iterator[tuple[float, float]]:
    """Yield, for each server that is requested at these seconds, this second and the second at which it is ready."""
    conditions, starts, spreads = conditions or Conditions(), draws(seed, "starts"), draws(seed, "propagation")
    chance, lags = random.Random(seed), draws(seed, "addresses")
    arrivals = sorted(asked)
    runs = []  # for each task: when its address is known, when the task runs, and when the participant came
    for launched, came in zip(_admitted(arrivals), arrivals, strict=True):
        task_runs = launched + start_time(starts, conditions.starts)
        known = task_runs + address_lag(lags, conditions)
        runs.append((known, task_runs, came))
    runs.sort()
    free, change = 0.0, QUOTAS["route53"]
    most, gap = MAX_CHANGES // 2, 1 / change[0]
    while runs:
        begins = max(free, runs[0][0])
        batch = [run for run in runs[:most] if run[0] <= begins]
        runs = runs[len(batch) :]
        free = begins + max(gap, chance.uniform(*conditions.busy_zone))
        in_sync = begins + propagation(spreads, conditions, seed, begins)
        yield from ((came, max(in_sync, task_runs)) for _, task_runs, came in batch)


def _admitted(arrivals: Sequence[float]) -> list[float]:
    """Return the second of RunTask for each arrival: the first at which its own bucket and the launches' have a token."""
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
