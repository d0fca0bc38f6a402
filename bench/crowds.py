"""Sends crowds to the simulated account (`testing/simulation/`), with a virtual clock.

The figures are those of the simulation, not of AWS; what it assumes is in `testing/simulation/assumptions.py`. A
participant waits from the moment at which they send the answer that calls for a server until their page has its
address. The yardstick is the time of AWS alone, without our code (`testing/simulation/aws_bound.py`).
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec

from bench.row import Row, row
from hippodrome.deployment.aws.concurrency import starts
from hippodrome.deployment.cost import prices
from hippodrome.deployment.cost.estimate import DNS_QUERIES
from hippodrome.deployment.cost.prices import FARGATE_MINIMUM
from testing import template
from testing.quiet_log import quiet
from testing.simulation import session_checks
from testing.simulation.assumptions import assumptions
from testing.simulation.aws_bound import aws_alone, aws_alone_together
from testing.simulation.conditions import AUTHORITY, Conditions
from testing.simulation.members import SimulatedMember
from testing.simulation.people import SimulatedParticipant
from testing.simulation.world import PROJECT, WIRES, SimulatedWorld

SEED = 2026
HOURS = 2.0  # hours after which a crowd must have finished, and its servers must be gone
CROWD, WITHIN = 1000, 60.0  # participants, seconds
PAIRS = 340  # participants in pairs, within a third of the time: as many a second
FEW, EXECUTIONS = 200, 10  # participants; the concurrent executions of a new account
SQS_REQUESTS = 3  # requests for a message: send, receive, delete
ALL = "whether a study can be opened to a crowd: everybody must get through, and nothing may go on costing"
WAIT = "a participant who waits long leaves"


def thousand() -> Iterator[Row]:
    """Send a thousand participants within a minute."""
    world, people = crowd(CROWD, WITHIN)
    yield through(f"{CROWD:,} within a minute", world, people)
    waits = [person.visit.ready - person.visit.asked for person in people]
    alone = aws_alone([person.visit.asked for person in people], SEED, world.conditions)
    yield row(
        f"simulated: {CROWD:,} within a minute: answer to server, p95, against AWS alone",
        quantile(waits, 0.95),
        "s",
        yardstick=quantile(alone, 0.95),
        at_most=1.25,
        decides=WAIT,
        detail={
            "p50, p95, max": spread(waits),
            "AWS alone": spread(alone),
            **{f"assumed: {what}": text for what, text in assumptions(world.conditions).items()},
        },
    )
    parts = bill(world)
    yield row(
        f"simulated: bill for each of {CROWD:,}, on Spot, without data and logs",
        sum(parts.values()) / CROWD,
        "$",
        decides="the bill; `cost` estimates it before a study",
        detail={part: usd / CROWD for part, usd in parts.items()},
    )


def interrupted() -> Iterator[Row]:
    """Send a thousand participants, and take one server in ten away."""
    world, people = crowd(CROWD, WITHIN, Conditions(interrupted=0.1, interrupted_after=(5.0, 120.0)))
    yield through(f"{CROWD:,} within a minute, Spot takes one server in ten", world, people)


def small_account() -> Iterator[Row]:
    """Send participants to a new account, with the concurrency that the deploy command chooses there."""
    wires = {**WIRES, "start_server": WIRES["start_server"]._replace(concurrency=starts(EXECUTIONS))}
    _, people = crowd(FEW, WITHIN, wires=wires, concurrency=EXECUTIONS)
    pages, late = (sum(getattr(person.visit, what) for person in people) for what in ("pages", "unanswered"))
    yield row(
        f"simulated: {FEW} within a minute in an account of {EXECUTIONS} executions: pages that come at the first try",
        100 * (1 - late / pages),
        "%",
        at_least=99,
        better="more",
        decides="whether a new account needs a quota increase before a study",
    )


def pairs() -> Iterator[Row]:
    """Send participants who play in pairs: they meet in the lobby."""
    project = msgspec.structs.replace(PROJECT, players=2, patience=300.0)
    world, people = crowd(PAIRS, WITHIN / 3, project=project, kind=SimulatedMember)
    wrong = session_checks.faults(world.platform.documents.kept, project, people)
    yield through(f"{PAIRS} in {WITHIN / 3:g} s, in pairs", world, people, wrong)
    asked, there = [person.visit.asked for person in people], [person.lobby for person in people]
    waits = [person.first_picture - person.lobby for person in people]
    alone = aws_alone_together(asked, there, 2, SEED, world.conditions)
    yield row(
        f"simulated: {PAIRS} in {WITHIN / 3:g} s, in pairs: lobby to first picture, p95, against AWS alone",
        quantile(waits, 0.95),
        "s",
        yardstick=quantile(alone, 0.95),
        at_most=1.5,
        decides=WAIT,
        detail={"p50, p95, max": spread(waits), "AWS alone": spread(alone)},
    )


def addresses() -> Iterator[Row]:
    """Compare certificates for addresses with names in Route 53: alone, and fifty participants in a minute."""
    for name, people, within in (("alone", 60, 3600.0), ("50 within a minute", 50, 60.0)):
        waits = {}
        for conditions in (Conditions(authority=AUTHORITY), Conditions()):
            world, came = crowd(people, within, conditions)
            if any(world.left().values()):
                yield through(name, world, came)
            waits[conditions.authority] = [person.visit.ready - person.visit.asked for person in came]
        with_addresses, with_names = waits[AUTHORITY], waits[None]
        yield row(
            f"simulated: without a domain, {name}: answer to server, p50, against names in Route 53",
            quantile(with_addresses, 0.5),
            "s",
            yardstick=quantile(with_names, 0.5),
            at_most=0.75,
            decides="whether an installation without a domain is only for trying",
            detail={
                "p50, p95, max": spread(with_addresses),
                "names": spread(with_names),
                "assumed: the authority": f"{AUTHORITY[0]:g} to {AUTHORITY[1]:g} s from RUNNING",
            },
        )


def warm() -> Iterator[Row]:
    """Compare ten warm servers with none, for participants who come one after the other for half an hour."""
    chance, arrivals = random.Random(SEED), [300.0]
    while arrivals[-1] < 2100:
        arrivals.append(arrivals[-1] + chance.uniform(10, 15))
    waits = {}
    for servers in (10, 0):
        world = SimulatedWorld(SEED, project=msgspec.structs.replace(PROJECT, warm_servers=servers))
        people: list[Any] = [SimulatedParticipant(world, number, read=2.0) for number in range(len(arrivals))]
        for person, comes in zip(people, arrivals, strict=True):
            world.clock.spawn(person.walk, delay=comes)
        with quiet():
            world.ask_for_warm_servers()
            world.run(3600)
        waits[servers] = [person.visit.ready - person.visit.asked for person in people]
    yield row(
        "simulated: ten warm servers, a participant every 10 to 15 s: answer to server, p50, against none",
        quantile(waits[10], 0.5),
        "s",
        yardstick=quantile(waits[0], 0.5),
        at_most=0.1,
        decides="whether warm servers are worth their price",
        detail={"p50, p95, max": spread(waits[10]), "none warm": spread(waits[0])},
    )


# Helpers


def crowd(
    people: int, within: float, conditions: Conditions | None = None, kind: Any = SimulatedParticipant, **world: Any
) -> tuple[SimulatedWorld, list[Any]]:
    """Let so many participants come within so many seconds, until nothing is left, or for `HOURS` at most."""
    simulated = SimulatedWorld(SEED, conditions, **world)
    came = [kind(simulated, number) for number in range(people)]
    for person in came:
        simulated.clock.spawn(person.walk, delay=simulated.clock.random.uniform(0, within))
    with quiet():
        simulated.settle(HOURS * 3600)
    return simulated, came


def through(name: str, world: SimulatedWorld, people: Sequence[Any], wrong: Sequence[str] = ()) -> Row:
    """Return the row of the share that plays to the end: 0 if anything is left, or wrong with their sessions."""
    left = {kind: count for kind, count in world.left().items() if count}
    finished = sum(person.visit.finished is not None for person in people)
    told = Counter(person.visit.reason for person in people if person.visit.finished is None)
    return row(
        f"simulated: {name}: share that plays to the end, nothing left behind",
        0.0 if left or wrong else 100 * finished / len(people),
        "%",
        at_least=100,
        better="more",
        decides=ALL,
        detail={"left behind": left or "nothing", "what the others were told": dict(told) or "no others"}
        | ({"wrong with sessions": list(wrong)} if wrong else {}),
    )


def bill(world: SimulatedWorld) -> dict[str, float]:
    """Return the likely US dollars of a run by kind of cost, from counts and list prices; all servers on Spot."""
    calls, now = world.cloud.calls, world.clock.seconds
    tasks = world.platform.tasks.tasks.values()
    hours = sum(max(FARGATE_MINIMUM, (task.closed or now) - task.born) for task in tasks) / 3600
    writes = calls["s3:PutObject"] + calls["s3:ListObjectsV2"]  # deletions are free
    messages = SQS_REQUESTS * sum(queue.sent for queue in world.queues)
    named, properties = template.functions(), template.resources("AWS::Lambda::Function")
    functions = 0.0
    for function in (world.next_step, *world.functions):
        gb = float(properties[named[function.name]]["MemorySize"]) / 1024
        functions += function.billed * gb * prices.LAMBDA_GB_SECOND + function.invocations * prices.LAMBDA_REQUEST
    return {
        "servers and their public IPv4 addresses": hours
        * prices.server_hour(world.project.size.cpu, world.project.size.memory, spot=True).likely,
        "Lambda": functions,
        "HTTP API": world.next_step.invocations * prices.HTTP_REQUEST,
        "S3 requests": calls["s3:GetObject"] * prices.S3_READ + writes * prices.S3_WRITE,
        "SNS and SQS": calls["sns:Publish"] * prices.SNS_PUBLISH + messages * prices.SQS_REQUEST,
        "Route 53 queries": DNS_QUERIES.likely * len(tasks) * prices.DNS_QUERY,
    }


def spread(values: Sequence[float]) -> list[float]:
    """Return p50, p95 and the maximum."""
    return [quantile(values, 0.5), quantile(values, 0.95), max(values)]


def quantile(values: Sequence[float], share: float) -> float:
    """Return the value below which this share of the values lies."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]
