"""Measures crowds that play together on the simulated account, and faults of their journeys.

`python -m bench sessions`. The figures are those of the simulation, not of AWS; its assumptions are printed beside
them. Participants come within a minute, read two pages, meet in the lobby, and play in pairs or fours. A server for
each session starts ahead, while they read. A wait begins in the lobby and ends with the first picture. The yardstick is
the time of AWS alone, where the next session gets the server that is ready first (`testing/simulation/aws_bound.py`).
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from bench.scale import assumed, quantile, spread
from bench.table import Row, each, row, simulated
from deploy.cost.prices import Prices
from hippodrome.lobby import decisions
from hippodrome.model.project import Project
from hippodrome.model.records import from_json
from hippodrome.model.server import RECORDS, Server
from testing.clock import EPOCH
from testing.exploration import sample_of_each
from testing.quiet_log import quiet
from testing.simulation import faults, lobby, session_checks
from testing.simulation.aws_bound import aws_alone_together
from testing.simulation.conditions import Conditions
from testing.simulation.members import Habits, SimulatedMember
from testing.simulation.people import SimulatedVisit
from testing.simulation.world import PROJECT, SimulatedWorld

CROWD, WITHIN, SEED = 1000, 60.0, 2026
SMALLER, SMALLER_WITHIN = 340, 20.0  # as many per second: for worse conditions, and for crowds that come several times
SEEDS = range(2026, 2029)  # one for each crowd: in a single crowd, a slow span of Route 53 decides the p95
HOURS = 2.0  # hours after which a crowd must have finished, and its servers must be gone
PAIRS: Project = msgspec.structs.replace(PROJECT, players=2, patience=300.0)
FOURS: Project = msgspec.structs.replace(PAIRS, players=4)
POINTS = 30  # about so many faults of each journey are tried; `make hunt` tries all
USUAL = Habits()
LEAVE = (Habits(leaves=0.8), Habits(leaves=1.6, beacon=None))  # they close the lobby's page, with a beacon and without


def rows() -> Iterator[Row]:
    """Measure crowds, then faults; about twenty minutes of one processor."""
    with quiet():
        yield from simulated(each([crowds, faults_of_groups]))


@dataclass(frozen=True)
class Together:
    """The outcome of a crowd. Times are virtual seconds."""

    world: SimulatedWorld
    came: Sequence[SimulatedMember]
    seconds: float  # the seconds of real time that the simulation took

    @property
    def project(self) -> Project:
        return self.world.project

    @property
    def wrong(self) -> list[str]:
        """The faults of the sessions, as `session_checks.faults` finds them."""
        return session_checks.faults(self.world.platform.documents.kept, self.project, self.came)

    @property
    def waits(self) -> list[float]:
        """The waits from the lobby to the first picture; until now, of those who should have seen one and have not."""
        now, found = self.world.clock.seconds, list[float]()
        for one in self.came:
            if one.lobby is not None and (one.first_picture is not None or not served(one.visit)):
                found.append((now if one.first_picture is None else one.first_picture) - one.lobby)
        return found

    @property
    def matched(self) -> list[float]:
        """The waits from the lobby until the page says that the participant is matched, or unmatched."""
        return [one.matched - one.lobby for one in self.came if one.lobby is not None and one.matched is not None]

    @property
    def alone(self) -> list[float]:
        """The times that the participants who stayed in the lobby would wait with AWS alone."""
        asked = [one.visit.asked for one in self.came if one.visit.asked is not None]
        there = [one.lobby for one in self.came if one.lobby is not None and one.matched is not None]
        return aws_alone_together(asked, there, self.project.players, self.world.clock.seed, self.world.conditions)

    @property
    def at_best(self) -> list[float]:
        """The times that they would wait if each ready server went at once to the next session, in order of arrival."""
        found = (from_json(body, Server) for key, (body, _, _) in self._documents.items() if key.startswith(RECORDS))
        ready = sorted((one.ready - EPOCH).total_seconds() for one in found if one.ready)
        there = sorted(one.lobby for one in self.came if one.lobby is not None and one.matched is not None)
        players = self.project.players
        sessions = [there[at : at + players] for at in range(0, len(there) - players + 1, players)]
        pairs = zip(sessions, ready, strict=False)
        return [max(members[-1], server) - one for members, server in pairs for one in members]

    @property
    def _documents(self) -> lobby.StoredDocuments:
        return self.world.platform.documents.kept


def crowd(
    project: Project,
    conditions: Conditions | None = None,
    habits: Callable[[int], Habits] = lambda number: USUAL,
    *,
    people: int = CROWD,
    within: float = WITHIN,
    seed: int = SEED,
) -> Together:
    """Simulate `people` participants who come within `within` seconds, until nothing is left, or for `HOURS` hours.

    `habits` says how the participant of this number behaves.
    """
    begun = time.perf_counter()
    world = SimulatedWorld(seed, conditions, project)
    came = [SimulatedMember(world, number, habits=habits(number)) for number in range(people)]
    for one in came:
        world.clock.spawn(one.walk, delay=world.clock.random.uniform(0, within))
    world.settle(HOURS * 3600)
    return Together(world, came, time.perf_counter() - begun)


def crowds() -> Iterator[Row]:
    """Measure 1,000 participants within a minute as pairs; then smaller crowds, as fours and under worse conditions."""
    usual = crowd(PAIRS)
    yield from judged("in pairs", usual)
    yield from costs(usual)
    yield waits_of([smaller(PAIRS, seed=seed) for seed in SEEDS])
    yield from judged("in fours", smaller(FOURS))
    spot = Conditions(interrupted=1 / 3, interrupted_after=(5.0, 120.0))
    yield from judged("in pairs, a third of the servers lost", smaller(PAIRS, spot))
    yield from judged("in pairs, 10 % leave the lobby", smaller(PAIRS, None, one_in_ten_leaves))
    yield from judged("in pairs, 100 to 200 ms a call of S3", smaller(PAIRS, Conditions(s3=(0.1, 0.2))))


def smaller(
    project: Project,
    conditions: Conditions | None = None,
    habits: Callable[[int], Habits] = lambda number: USUAL,
    seed: int = SEED,
) -> Together:
    """Simulate a crowd of a third of the size in a third of the time."""
    return crowd(project, conditions, habits, people=SMALLER, within=SMALLER_WITHIN, seed=seed)


def spreads(waits: Sequence[float], alone: Sequence[float]) -> dict[str, list[float]]:
    """Return the quantiles of the waits and of those with AWS alone, for the details of a row."""
    return {"p50, p95, max": spread(waits), "AWS alone p50, p95, max": spread(alone)}


def waits_of(crowds: Sequence[Together]) -> Row:
    """Return the row of the waits of several crowds together."""
    waits = [wait for one in crowds for wait in one.waits]
    alone = [wait for one in crowds for wait in one.alone]
    return row(
        f"{len(crowds)} crowds of {SMALLER} within {SMALLER_WITHIN:.0f} s, in pairs: "
        "from the lobby to the first picture, p95, beside AWS alone",
        quantile(waits, 0.95),
        "s",
        yardstick=quantile(alone, 0.95),
        detail={
            **spreads(waits, alone),
            "with these servers, given at once, p50, p95, max": spread(
                [wait for one in crowds for wait in one.at_best]
            ),
            "of each crowd, p95 beside AWS alone": ", ".join(
                f"{quantile(one.waits, 0.95):.0f} and {quantile(one.alone, 0.95):.0f} s" for one in crowds
            ),
        },
    )


def one_in_ten_leaves(number: int) -> Habits:
    """Let one member in ten leave the lobby; half of these close the page without a beacon."""
    return USUAL if number % 10 else LEAVE[number // 10 % 2]


def served(visit: SimulatedVisit) -> bool:
    """Return whether the participant has finished, has left by themselves, or was told that no others came.

    A participant whose server failed is told so, and is not served.
    """
    return faults.served_or_told(visit) and not visit.reason.startswith(("failed", "ended"))


def judged(how: str, found: Together) -> Iterator[Row]:
    """Yield the rows of a crowd: the share that is `served`, and the waits.

    The share is 0 if a session is split or merged, or if anything is left.
    """
    world, came = found.world, found.came
    left = {kind: count for kind, count in world.left().items() if count}
    ended = Counter("played to the end" if one.visit.finished is not None else one.visit.reason for one in came)
    well = 100 * sum(served(one.visit) for one in came) / len(came)
    sizes = Counter(len(one.members) for one in lobby.formed(world.platform.documents.kept, found.project))
    within = WITHIN if len(came) == CROWD else SMALLER_WITHIN
    name = f"{len(came):,} arrive within {within:.0f} s and play {how}"
    yield row(
        f"{name}: share that plays to the end, leaves, or finds no others; "
        "0 if groups are split or merged, or anything is left",
        0.0 if left or found.wrong else well,
        "%",
        bound="ours: no server fails for good, no group is split or merged, and nobody is matched who has gone",
        at_least=100,
        detail={
            "how it ended for them": dict(ended),
            "groups by size": dict(sizes),
            "split, merged, ghosts": dict(Counter(text.split(":")[0] for text in found.wrong)) or "none",
            "left behind": left or "nothing",
            "servers that Spot took": sum(task.interrupted for task in world.platform.tasks.tasks.values()),
            "simulated in": f"{found.seconds:.0f} s",
            **{f"assumed: {thing}": text for thing, text in assumed(world.conditions).items()},
        },
    )
    waits, alone = found.waits, found.alone
    yield row(
        f"{name}: from the lobby to the first picture, p95, beside AWS alone",
        quantile(waits, 0.95),
        "s",
        yardstick=quantile(alone, 0.95),
        detail={
            **spreads(waits, alone),
            "of it until they are matched, p50, p95, max": spread(found.matched),
            "longest page": f"{world.next_step.longest:.1f} s",
        },
    )


def costs(found: Together) -> Iterator[Row]:
    """Yield the rows of the lobby's calls and costs per participant."""
    world, people, calls = found.world, len(found.came), found.world.cloud.lobby_calls
    yield row(
        "calls of S3 about the lobby and the session, per participant of these pairs",
        sum(calls.values()) / people,
        "calls",
        detail={
            **{action: count / people for action, count in calls.items()},
            "polls of the lobby's page": sum(one.polls for one in found.came) / people,
            "writes of the lobby's document that were refused, in all": world.cloud.conflicts[
                decisions.key(found.project.id)
            ],
        },
    )
    yield row(
        "cost of these calls and of the lobby's polls per participant",
        lobby_cost(calls, sum(one.polls for one in found.came), Prices()) / people,
        "$",
        detail={"left out": "the seconds of next_step, which rows of `scale` count"},
    )


def lobby_cost(calls: Mapping[str, int], polls: int, prices: Prices) -> float:
    """Return the US dollars for these calls of S3, and for so many polls of `next_step`."""
    writes = calls.get("s3:PutObject", 0) + calls.get("s3:ListObjectsV2", 0)
    requests = prices.http_request.usd + prices.lambda_request.usd
    return calls.get("s3:GetObject", 0) * prices.s3_read.usd + writes * prices.s3_write.usd + polls * requests


def faults_of_groups() -> Iterator[Row]:
    """Run each journey of sessions with a sample of its faults."""
    tried, bad, detail = 0, 0, dict[str, Any]()
    for journey in faults.JOURNEYS_OF_GROUPS:
        points = faults.points(journey, SEED)
        tries = sample_of_each(points, max(1, len(points) // POINTS), lambda point: point.fault)
        outcomes = [faults.run(journey, SEED, point)[1] for point in tries]
        failed = sum(not outcome.well for outcome in outcomes)
        detail[journey.name] = f"{len(outcomes)} of {len(points)} faults, {failed} bad"
        tried, bad = tried + len(outcomes), bad + failed
    yield row("fault points of groups tried", tried, "", detail=detail)
    yield judged_faults(bad)


def judged_faults(bad: int) -> Row:
    """Return the row of the faults that did harm."""
    return row(
        "of those, with a participant stranded, something left behind, or a group split or merged",
        bad,
        "",
        bound="ours: no fault does so; `make hunt` tries all of them",
        at_most=0,
    )
