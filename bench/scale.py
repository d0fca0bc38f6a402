"""A crowd on the simulated account, and every fault of every journey. Figures of the simulation, not of AWS.

What the simulation assumes stands in `bench/simulation/`: start times of Fargate (median 25 s, tail to 90 s), changes
of the zone that take 20 to 60 s, quotas as AWS documents them.
"""

from __future__ import annotations

import contextlib
import json
import logging
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any

import msgspec

from bench.bill import bill, server_seconds
from bench.simulation import faults
from bench.simulation.clock import EPOCH
from bench.simulation.cloud import QUOTAS
from bench.simulation.hippo import Hippo
from bench.simulation.people import Person
from bench.simulation.world import PROJECT, World
from bench.table import Row, each, row
from deploy.prices import Prices, Usd
from hippodrome.log import logger

CROWD, WITHIN, SEED = 1000, 60.0, 2026
MANY, MANY_WITHIN = 10_000, 900.0


def rows() -> Iterator[Row]:
    """A crowd with our functions and with HIPPO's way; then all faults. About five minutes."""
    with quiet():
        yield from each([a_crowd, many_at_once, faults_of_journeys])


def a_crowd() -> Iterator[Row]:
    """1,000 participants in a minute."""
    begun = time.perf_counter()
    world = World(SEED)
    people = [Person(world, number) for number in range(CROWD)]
    for person in people:
        world.clock.spawn(person.walk, delay=world.clock.random.uniform(0, WITHIN))
    world.run(2 * 3600)
    took, bound = _times(world)
    served = sum(person.visit.finished is not None for person in people) / CROWD
    billed = sum(function.billed for function in world.functions) / CROWD
    theirs = _hippo()
    yield row(
        f"{CROWD:,} arrive within {WITHIN:.0f} s: share that plays to the end",
        100 * served,
        "%",
        at_least=100,
        detail={
            "HIPPO's way, same account": f"{100 * theirs['ready']:.1f} % get a server",
            "what failed there": dict(theirs["failed"]),
            "left behind": dict(world.left()),
            "simulated in": f"{time.perf_counter() - begun:.1f} s",
        },
    )
    yield row(
        "request to ready, p95, against what AWS alone takes (launch rate, start, DNS)",
        quantile(took, 0.95),
        "s",
        yardstick=quantile(bound, 0.95),
        at_most=1.1,
        detail={
            "ours p50, p95, max": [quantile(took, 0.5), quantile(took, 0.95), max(took)],
            "bound p50, p95, max": [quantile(bound, 0.5), quantile(bound, 0.95), max(bound)],
            "HIPPO's p50, p95, max of those that came": theirs["times"],
        },
    )
    yield row(
        "billed seconds per participant behind the pages",
        billed,
        "s",
        at_most=3,
        detail={
            **{f.name: f"{f.billed / CROWD:.2f} s, {f.containers} containers" for f in world.functions},
            "next_step, with the pages and polls": f"{world.next_step.billed / CROWD:.2f} s",
            "HIPPO's start_server": f"{theirs['billed']:.0f} s",
        },
    )
    yield row(
        "API calls per participant, throttled ones included",
        sum(world.cloud.calls.values()) / CROWD,
        "calls",
        detail={
            "throttled": dict(world.cloud.throttled) or "none",
            "HIPPO's throttled": dict(theirs["throttled"]),
        },
    )


def many_at_once() -> Iterator[Row]:
    """10,000 servers that run at the same time for an hour."""
    world = World(SEED, project=msgspec.structs.replace(PROJECT, max_runtime=110))
    people = [Person(world, number, play=3600.0) for number in range(MANY)]
    for person in people:
        world.clock.spawn(person.walk, delay=world.clock.random.uniform(0, MANY_WITHIN))
    busiest: dict[str, float] = {}
    before: Counter[str] = Counter()
    for minute in range(5, 181, 5):
        world.run(minute * 60)
        for api, count in _by_quota(world.cloud.calls - before).items():
            busiest[api] = max(busiest.get(api, 0.0), count / 300)
        before = world.cloud.calls.copy()
    served = sum(person.visit.finished is not None for person in people) / MANY
    rates = {api: f"{rate:.1f} of {QUOTAS[api][0]:g} calls/s" for api, rate in sorted(busiest.items())}
    yield row(
        f"{MANY:,} servers at once for an hour: share that plays to the end",
        100 * served,
        "%",
        at_least=100,
        detail={
            "left behind": dict(world.left()),
            **{f"busiest five minutes, {api}": rate for api, rate in rates.items()},
            "throttled": dict(world.cloud.throttled) or "none",
        },
    )
    yield row(
        "the longest sweep among them; its function has 240 s",
        world.sweep.longest,
        "s",
        at_most=240,
        detail={"counted": "what AWS's answers take; what the function itself computes is not simulated"},
    )
    yield _cost(world)


def _cost(world: World) -> Row:
    """What the run costs for each who took part."""
    prices = Prices()
    spot, on_demand = (
        {what: usd * (1 / MANY) for what, usd in bill(world, prices, spot=kind).items()} for kind in (True, False)
    )
    total, dearer = (sum(parts.values(), Usd()) for parts in (spot, on_demand))
    return row(
        "cost per participant of them, Fargate Spot, data and logs left out",
        total.likely,
        "$",
        detail={
            "Spot from, to": [total.low, total.high],
            "on demand": dearer.likely,
            **{what: usd.likely for what, usd in spot.items()},
            "minutes of a server": server_seconds(world) / 60 / MANY,
            "prices": prices.note(prices.region),
        },
    )


def _by_quota(calls: Mapping[str, int]) -> Counter[str]:
    """Calls by the quota that they share."""
    found: Counter[str] = Counter()
    for action, count in calls.items():
        api = action if action in QUOTAS else action.partition(":")[0]
        if api in QUOTAS:
            found[api] += count
    return found


def faults_of_journeys() -> Iterator[Row]:
    """A crash before, after and with the lost reply of every call."""
    counts: Counter[str] = Counter()
    detail: dict[str, Any] = {}
    for journey in faults.JOURNEYS:
        outcomes = list(faults.explore(journey, SEED))
        bad = sum(not outcome.well for outcome in outcomes)
        counts["points"] += len(outcomes)
        counts["bad"] += bad
        detail[journey.name] = f"{len(outcomes)} faults, {bad} with something left or somebody stranded"
    yield row("fault points tried", counts["points"], "", detail=detail)
    yield row("of those, with something left or somebody stranded", counts["bad"], "", at_most=0)


def _times(world: World) -> tuple[list[float], list[float]]:
    """Seconds from request to ready of every server, and how many AWS itself took, to start it and spread its name."""
    took, bound = [], []
    for key, (body, _, _) in world.platform.documents.kept.items():
        record = json.loads(body) if key.startswith("_servers/") else {}
        if record.get("ready"):
            requested, ready = (seconds_of(record[name]) for name in ("requested", "ready"))
            task = world.platform.tasks.tasks[record["task"]]
            assert task.began is not None
            took.append(ready - requested)
            bound.append(task.began - requested + world.platform.names.spreads[record["dns"]])
    return took, bound


def _hippo() -> dict[str, Any]:
    world = World(SEED)
    hippo = Hippo(world)
    for number in range(CROWD):
        delay = world.clock.random.uniform(0, WITHIN)
        world.clock.spawn(lambda n=number: hippo.start(n), delay=delay)  # type: ignore[misc]
    world.run(1800)
    times = [start.ready - start.asked for start in hippo.starts if start.ready is not None]
    return {
        "ready": len(times) / CROWD,
        "times": [quantile(times, 0.5), quantile(times, 0.95), max(times)],
        "billed": sum(start.billed for start in hippo.starts) / CROWD,
        "failed": Counter(start.failed for start in hippo.starts if start.failed),
        "throttled": world.cloud.throttled,
    }


def seconds_of(moment: str) -> float:
    return (datetime.fromisoformat(moment) - EPOCH).total_seconds()


def quantile(values: Sequence[float], share: float) -> float:
    """The value below which that share of them lies."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    level = logger.log_level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
