"""Measures crowds on the simulated account, and every fault of every journey.

The figures are those of the simulation, not of AWS. The simulation's assumptions are printed beside the figures
(`testing/simulation/assumptions.py`), and crowds come again under worse assumptions. A participant waits from the
moment at which they send the answer for which their server is started until their page gets its address: topic, queue,
functions, events, DNS and the page's polls are all included. The yardstick is the time of AWS alone, without our code
(`testing/simulation/aws_bound.py`).
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import msgspec

from bench.bill import bill, server_seconds
from bench.table import Row, each, row, simulated
from deploy.aws.concurrency import starts
from deploy.cost.prices import Prices, Usd
from testing.clock import EPOCH
from testing.quiet_log import quiet
from testing.simulation import faults
from testing.simulation.assumptions import assumptions, changed
from testing.simulation.aws_bound import aws_alone
from testing.simulation.cloud import CONCURRENCY, QUOTAS
from testing.simulation.conditions import Conditions
from testing.simulation.functions import Wire
from testing.simulation.hippo import ASSUMED, Hippo
from testing.simulation.people import SimulatedParticipant, SimulatedVisit
from testing.simulation.tasks import ADDRESSES
from testing.simulation.world import PROJECT, TIMEOUTS, WIRES, SimulatedWorld

CROWD, WITHIN, SEED = 1000, 60.0, 2026
SEEDS = range(2026, 2044)  # seeds of the crowds whose waits are judged; with only six, slow spans change the p95 by 3 %
SMALL, SMALL_WITHIN = 250, 600.0
MANY, MANY_WITHIN = 10_000, 900.0
HOUR = 3600.0  # seconds for which the MANY participants play
HOURS = 2.0  # hours after which a crowd must have finished, and its servers must be gone
WORSE: Mapping[str, Conditions] = {
    "a zone busy for 2 to 5 s": Conditions(busy_zone=(2.0, 5.0)),
    "a zone busy for 5 to 15 s": Conditions(busy_zone=(5.0, 15.0)),
    "Spot sold out": Conditions(no_spot=lambda seconds: True),
    "10 % interruptions": Conditions(interrupted=0.1, interrupted_after=(5.0, 120.0)),
    "Route 53 slow all the time": Conditions(slow_zone=1.0),
    "3 % of the events lost": Conditions(lost=0.03),
}
FEW, FEW_WITHIN, FEW_EXECUTIONS = 200, 60.0, 10  # participants, seconds, and the concurrent executions of a new account
DEFAULT_QUOTAS = {  # Service Quotas can raise each of them
    "network interfaces in the Region": 5_000,  # VPC User Guide, "Amazon VPC quotas"
    "records in the hosted zone": 10_000,  # Route 53 Developer Guide, "Quotas"
    "Fargate Spot vCPUs": 6,  # Amazon ECS endpoints and quotas; AWS raises it with use
}


def rows() -> Iterator[Row]:
    """Measure crowds with our functions and in HIPPO's way, and then all faults; about six minutes."""
    with quiet():
        yield from simulated(each([crowds, worse_crowds, small_crowd, small_account, many_at_once, faults_of_journeys]))


# Crowds


@dataclass(frozen=True)
class ServedCrowd:
    """The outcome of a crowd. Times are virtual seconds."""

    world: SimulatedWorld
    visits: Sequence[SimulatedVisit]
    seed: int
    conditions: Conditions

    @property
    def served(self) -> float:
        """The percentage of the participants who have finished."""
        return 100 * sum(visit.finished is not None for visit in self.visits) / len(self.visits)

    @property
    def waits(self) -> list[float]:
        """The waits from the answer that starts a server until the page has its address, or until now without one."""
        now = self.world.clock.seconds
        asked = [(visit, visit.asked) for visit in self.visits if visit.asked is not None]
        return [(now if visit.ready is None else visit.ready) - at for visit, at in asked]

    @property
    def alone(self) -> list[float]:
        """The times that the same participants would wait with AWS alone."""
        return aws_alone(self._asked, self.seed, self.conditions)

    @property
    def alone_early(self) -> list[float]:
        """The times with AWS alone, if each task's name were made as soon as its network interface has an address."""
        return aws_alone(self._asked, self.seed, self.conditions, early=True)

    @property
    def _asked(self) -> list[float]:
        return [visit.asked for visit in self.visits if visit.asked is not None]


def crowd(
    seed: int,
    people: int = CROWD,
    within: float = WITHIN,
    conditions: Conditions | None = None,
    *,
    wires: Mapping[str, Wire] = WIRES,
    concurrency: int = CONCURRENCY,
) -> ServedCrowd:
    """Simulate so many participants who come within so many seconds, until nothing is left, or for HOURS at most."""
    conditions = conditions or Conditions()
    world = SimulatedWorld(seed, conditions, wires=wires, concurrency=concurrency)
    arrived = [SimulatedParticipant(world, number) for number in range(people)]
    for person in arrived:
        world.clock.spawn(person.walk, delay=world.clock.random.uniform(0, within))
    world.settle(HOURS * 3600)
    return ServedCrowd(world, [person.visit for person in arrived], seed, conditions)


def crowds() -> Iterator[Row]:
    """Measure 1,000 participants within a minute, eighteen times."""
    begun = time.perf_counter()
    made = [crowd(seed) for seed in SEEDS]
    theirs = hippo(CROWD, WITHIN)
    seconds = time.perf_counter() - begun
    yield served(f"{CROWD:,} arrive within {WITHIN:.0f} s", made, theirs, seconds)
    yield from waiting(made)
    yield from costs(made[0], theirs)


def worse_crowds() -> Iterator[Row]:
    """Measure the same crowd under worse conditions than the usual ones of the simulation."""
    for worse, conditions in WORSE.items():
        begun = time.perf_counter()
        came = crowd(SEED, conditions=conditions)
        name = f"{CROWD:,} arrive within {WITHIN:.0f} s, {worse}"
        yield served(name, [came], hippo(CROWD, WITHIN, conditions), time.perf_counter() - begun)
        yield row(
            f"{name}: asked for a server until the page shows it, p95, beside AWS alone",
            quantile(came.waits, 0.95),
            "s",
            yardstick=quantile(came.alone, 0.95),
            detail={"p50, p95, max": spread(came.waits), "AWS alone": spread(came.alone)},
        )
        if waits_again := [wait for visit in came.visits for wait in visit.waits_again]:
            yield row(
                f"{name}: from the loss of a server until its participant plays again, p95",
                quantile(waits_again, 0.95),
                "s",
                detail={
                    "p50, p95, max": spread(waits_again),
                    "times that a participant lost a server": sum(visit.interruptions for visit in came.visits),
                },
            )


def small_crowd() -> Iterator[Row]:
    """Measure a crowd that is small enough for HIPPO's way."""
    begun = time.perf_counter()
    came, theirs = crowd(SEED, SMALL, SMALL_WITHIN), hippo(SMALL, SMALL_WITHIN)
    name = f"{SMALL} arrive within {SMALL_WITHIN / 60:.0f} minutes"
    yield served(name, [came], theirs, time.perf_counter() - begun)


def small_account() -> Iterator[Row]:
    """Measure a crowd in an account with ten executions, with the concurrency that the deploy command chooses there."""
    wires = {**WIRES, "start_server": WIRES["start_server"]._replace(concurrency=starts(FEW_EXECUTIONS))}
    begun = time.perf_counter()
    came = crowd(SEED, FEW, FEW_WITHIN, wires=wires, concurrency=FEW_EXECUTIONS)
    name = f"{FEW} arrive within {FEW_WITHIN:.0f} s in an account of {FEW_EXECUTIONS} executions"
    yield served(name, [came], hippo(FEW, FEW_WITHIN), time.perf_counter() - begun)
    pages = sum(visit.pages for visit in came.visits)
    later = sum(visit.unanswered for visit in came.visits)
    yield row(
        f"{name}: pages that come at the first try",
        100 * (1 - later / pages),
        "%",
        bound="ours: nearly all; the others come at a later try",
        at_least=99,
        detail={
            "pages, those that came at a later try": f"{pages:,}, {later}",
            "executions refused, polls included": came.world.cloud.throttled["lambda:Invoke"],
            "asked for a server until the page shows it, p50, p95, max": spread(came.waits),
            "AWS alone": spread(came.alone),
        },
    )


def served(name: str, made: Sequence[ServedCrowd], theirs: Mapping[str, Any], seconds: float) -> Row:
    """Return the row of the share that finishes (0 if anything is left), beside the share that HIPPO's way serves.

    `theirs` is what `hippo` returns; `seconds` is how long the simulation took.
    """
    left = Counter[str]()
    for one in made:
        left.update({thing: count for thing, count in one.world.left().items() if count})
    told = Counter(visit.reason for one in made for visit in one.visits if visit.finished is None)
    worst = min(one.served for one in made)
    return row(
        f"{name}: share that plays to the end, nothing left behind",
        0.0 if left else worst,
        "%",
        yardstick=100 * theirs["ready"],
        at_least=100,
        judge="value",
        bound="all participants finish, and nothing is left behind",
        detail={
            "the yardstick": "share that gets a server in HIPPO's way, the better of two models: "
            f"address with the interface {theirs['both'][0]}, when the task runs {theirs['both'][1]}",
            "assumed of HIPPO's way": ASSUMED,
            "what failed there": dict(theirs["failed"]) or "nothing",
            "left behind": dict(left) or "nothing",
            "played to the end, and what the others were told": f"{worst:g} %, {dict(told) or 'no others'}",
            "simulated in": f"{seconds:.1f} s",
            **{f"assumed: {thing}": text for thing, text in assumed(made[0].conditions).items()},
        },
    )


def assumed(conditions: Conditions) -> Mapping[str, str]:
    """Return the assumptions to print: all of the usual conditions, of others those that differ from them."""
    return changed(conditions) or assumptions(conditions)


def waiting(made: Sequence[ServedCrowd]) -> Iterator[Row]:
    """Yield the rows of the time that participants wait for their servers."""
    waits = [wait for one in made for wait in one.waits]
    alone = [wait for one in made for wait in one.alone]
    early = [wait for one in made for wait in one.alone_early]
    for name, share in (("p50", 0.5), ("p95", 0.95)):
        yield row(
            f"asked for a server until the page shows it, {name}, against AWS alone (quotas, start, and then DNS)",
            quantile(waits, share),
            "s",
            yardstick=quantile(alone, share),
            at_most=1.1,
            detail={
                "participants": f"{len(waits):,} in {len(made)} crowds",
                "ours p50, p95, max": spread(waits),
                "AWS alone p50, p95, max": spread(alone),
                "AWS alone, if names were made while tasks start": spread(early),
            },
        )


def costs(came: ServedCrowd, theirs: Mapping[str, Any]) -> Iterator[Row]:
    """Yield the rows of the billed seconds and the calls of one crowd."""
    world, people = came.world, len(came.visits)
    yield row(
        "billed seconds per participant behind the pages, beside HIPPO's start_server",
        sum(function.billed for function in world.functions) / people,
        "s",
        yardstick=theirs["billed"],
        at_most=3,
        judge="value",
        bound="ours: no function waits for a server to start",
        detail={
            **{f.name: f"{f.billed / people:.2f} s, {f.containers} containers" for f in world.functions},
            "next_step, with the pages and polls": f"{world.next_step.billed / people:.2f} s",
            "functions at once, at most": world.cloud.most_invocations,
        },
    )
    yield row(
        "API calls per participant in a crowd, throttled ones included",
        sum(world.cloud.calls.values()) / people,
        "calls",
        detail={
            "throttled": dict(world.cloud.throttled) or "none",
            "HIPPO's throttled": dict(theirs["throttled"]),
            "requests of next_step": world.next_step.invocations / people,
        },
    )


# Many at once


def many_at_once() -> Iterator[Row]:
    """Measure 10,000 servers that run at the same time for an hour."""
    world = SimulatedWorld(SEED, project=msgspec.structs.replace(PROJECT, max_runtime=110))
    people = [SimulatedParticipant(world, number, play=HOUR) for number in range(MANY)]
    for person in people:
        world.clock.spawn(person.walk, delay=world.clock.random.uniform(0, MANY_WITHIN))
    busiest: dict[str, float] = {}
    before: Counter[str] = Counter()
    for minute in range(5, 181, 5):
        world.run(minute * 60)
        for api, count in _by_quota(world.cloud.calls - before).items():
            busiest[api] = max(busiest.get(api, 0.0), count / 300)
        before = world.cloud.calls.copy()
    rates = {api: f"{rate:.1f} of {QUOTAS[api][0]:g} calls/s" for api, rate in sorted(busiest.items())}
    yield served_many(
        ServedCrowd(world, [person.visit for person in people], SEED, world.conditions),
        {
            **needs(world),
            "assumed": f"they play for {HOUR:g} s; the rest is as in the rows above",
            **{f"busiest five minutes, {api}": rate for api, rate in rates.items()},
            "throttled": dict(world.cloud.throttled) or "none",
        },
    )
    yield from sweeps(world)
    yield _cost(world)


def sweeps(world: SimulatedWorld) -> Iterator[Row]:
    """Yield the rows of the sweeps. If a sweep was cut off, the time of the longest one is the timeout."""
    yield row(
        "the longest sweep among them, beside its function's timeout",
        world.sweep.longest,
        "s",
        yardstick=TIMEOUTS["sweep"],
        detail={"counted": "the latency of AWS's calls; the function's own processor time is not simulated"},
    )
    yield row(
        "sweeps among them that are cut off by the timeout",
        world.sweep.crashed,
        "sweeps",
        bound="infra/template.yml: the timeout of the function",
        at_most=0,
        detail={"sweeps": world.sweep.invocations},
    )


def served_many(came: ServedCrowd, detail: Mapping[str, Any]) -> Row:
    """Return the row of the share that finishes, in the network that the template makes.

    It is 0 if anything is left, or if their servers have never been there all at once.
    """
    left = {thing: count for thing, count in came.world.left().items() if count}
    at_once = came.world.platform.tasks.most_interfaces >= len(came.visits)
    return row(
        f"{len(came.visits):,} servers at once for an hour: share that plays to the end, nothing left behind",
        0.0 if left or not at_once else came.served,
        "%",
        bound="all participants, in the network that infra/template.yml makes",
        at_least=100,
        detail={"left behind": left or "nothing", "played to the end": f"{came.served:g} %", **detail},
    )


def needs(world: SimulatedWorld) -> Mapping[str, str]:
    """Return how much the run needed at once, and how much AWS allows."""
    tasks = world.platform.tasks.most_interfaces
    needed = {
        "network interfaces in the Region": tasks,
        "records in the hosted zone": world.platform.dns.most_records,
        "Fargate Spot vCPUs": tasks * world.project.size.cpu,
    }
    quotas = {
        f"{quota} at once": f"{count:,.0f}; AWS allows {DEFAULT_QUOTAS[quota]:,} unless that quota is raised"
        for quota, count in needed.items()
    }
    return {"addresses at once": f"{tasks:,} of {ADDRESSES:,} in the template's subnets", **quotas}


def _cost(world: SimulatedWorld) -> Row:
    """Return the row of the cost of the run per participant."""
    prices = Prices()
    spot, on_demand = (
        {part: usd * (1 / MANY) for part, usd in bill(world, prices, spot=kind).items()} for kind in (True, False)
    )
    total, dearer = (sum(parts.values(), Usd()) for parts in (spot, on_demand))
    return row(
        "cost per participant of them, Fargate Spot, data and logs left out",
        total.likely,
        "$",
        detail={
            "Spot from, to": [total.low, total.high],
            "on demand": dearer.likely,
            **{part: usd.likely for part, usd in spot.items()},
            "minutes of a server": server_seconds(world) / 60 / MANY,
            "prices": prices.note(prices.region),
        },
    )


def _by_quota(calls: Mapping[str, int]) -> Counter[str]:
    """Return the number of calls by the quota that they share."""
    found: Counter[str] = Counter()
    for action, count in calls.items():
        api = action if action in QUOTAS else action.partition(":")[0]
        if api in QUOTAS:
            found[api] += count
    return found


# Faults


def faults_of_journeys() -> Iterator[Row]:
    """Run every journey with each of its faults: a crash before and after every call, and its lost reply."""
    counts: Counter[str] = Counter()
    detail: dict[str, Any] = {}
    for journey in faults.JOURNEYS:
        outcomes = list(faults.explore(journey, SEED))
        bad = sum(not outcome.well for outcome in outcomes)
        counts["points"] += len(outcomes)
        counts["bad"] += bad
        detail[journey.name] = f"{len(outcomes)} faults; after {bad}, something is left or a participant stranded"
    yield row("fault points tried", counts["points"], "", detail=detail)
    yield row(
        "of those, with something left or a participant stranded",
        counts["bad"],
        "",
        bound="no fault strands a participant or leaves anything",
        at_most=0,
    )


# Helpers


def hippo(people: int, within: float, conditions: Conditions | None = None) -> dict[str, Any]:
    """Simulate the same crowd in HIPPO's way; return the outcome of the better of its two models."""
    models = [_hippo(people, within, conditions, early=early) for early in (True, False)]
    best = max(models, key=lambda model: float(model["ready"]))
    return best | {"both": [f"{model['ready']:.1%}" for model in models]}


def _hippo(people: int, within: float, conditions: Conditions | None, *, early: bool) -> dict[str, Any]:
    world = SimulatedWorld(SEED, conditions)
    starts = Hippo(world, early=early)
    for number in range(people):
        delay = world.clock.random.uniform(0, within)
        world.clock.spawn(lambda n=number: starts.start(n), delay=delay)  # type: ignore[misc]
    world.run(HOURS * 3600)
    return {
        "ready": sum(start.ready is not None for start in starts.starts) / people,
        "billed": sum(start.billed for start in starts.starts) / people,
        "failed": Counter(start.failed for start in starts.starts if start.failed),
        "throttled": world.cloud.throttled,
    }


def spread(values: Sequence[float]) -> list[float]:
    """Return p50, p95 and the maximum."""
    return [quantile(values, 0.5), quantile(values, 0.95), max(values)]


def seconds_of(moment: str) -> float:
    """Return the virtual seconds from the beginning to a time in ISO format."""
    return (datetime.fromisoformat(moment) - EPOCH).total_seconds()


def quantile(values: Sequence[float], share: float) -> float:
    """Return the value below which this share of the values lies."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]
