"""How evenly the cells of `conditions` fill among those who finish, and what assigning costs."""

from __future__ import annotations

import types
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from random import Random
from typing import Any
from unittest.mock import patch
from urllib.parse import urlencode

from bench.row import Row, row

STUDIES = 200
LEAVES = 0.2  # the share of participants who close the page somewhere on their way
TAKES = timedelta(minutes=25)
EVERY = timedelta(minutes=1)  # between two arrivals, on average
START = datetime(2026, 11, 2, 9, tzinfo=UTC)


def balance() -> Iterator[Row]:
    """Fill studies of several sizes; a lot for each participant, as by a coin, is the yardstick."""
    detail: dict[str, Any] = {"largest less smallest cell": "median and 95 % of studies; by lot in brackets"}
    worst: tuple[float, float] = (0, 1)
    for cells in (2, 4, 6):
        for people in (60, 200, 1000):
            balanced, by_lot = (
                sorted(_spread(Random(seed), cells, people, lot) for seed in range(STUDIES)) for lot in (False, True)
            )
            detail[f"{cells} cells, {people} people"] = f"{_two(balanced)} ({_two(by_lot)})"
            worst = max(worst, (balanced[int(STUDIES * 0.95)], by_lot[int(STUDIES * 0.95)]))
    yield row(
        f"{LEAVES:.0%} leave: largest less smallest cell among those who finish, 95 % of studies, the worst size",
        worst[0],
        "people",
        yardstick=worst[1],
        at_most=0.5,
        decides="how many more people a study must pay for until each cell has enough",
        detail=detail,
    )


def _two(values: list[int]) -> str:
    return f"{values[len(values) // 2]}, {values[int(len(values) * 0.95)]}"


def _spread(random: Random, cells: int, people: int, by_lot: bool) -> int:
    """Let people come to a study, of whom some leave; return how many more finish in the largest cell."""
    from hippodrome.control.model.balance import Cells, outcome_of
    from hippodrome.control.model.design import Factor

    levels = [str(level) for level in range(cells)]
    project: Any = types.SimpleNamespace(conditions=(Factor("cell", {level: level for level in levels}),), blocks=())
    document, now = Cells(), START
    ends: dict[str, tuple[datetime, bool]] = {}  # when somebody has answered for the last time, and whether all
    finished = Counter[str](dict.fromkeys(levels, 0))
    for number in range(people):
        now += EVERY * random.expovariate(1)
        for user in document.unsettled(now):
            last, finishes = ends[user]
            outcome, at = outcome_of(["page", "end"][: 2 - finishes], {"page": last}, False, now)
            document = document.settled(user, outcome, at)
        name, finishes = str(number), random.random() >= LEAVES
        ends[name] = now + TAKES * (1 if finishes else random.random()), finishes
        if by_lot:
            cell = random.choice(levels)
        else:
            document, draw = document.draw(project, name, now, random)
            cell = draw.cell
        finished[cell] += finishes
    return max(finished.values()) - min(finished.values())


# Calls


def calls() -> Iterator[Row]:
    """Count the AWS calls of single requests in studies of pages, with factors and without."""
    counted = {name: _calls_of_requests(conditions) for name, conditions in (("with", True), ("without", False))}
    with_factors, without = counted["with"], counted["without"]
    detail = {
        f"{name} factors": {kind: dict(found) for kind, found in kinds.items()} for name, kinds in counted.items()
    }
    drawn = sum(with_factors["draws"].values()) - sum(without["draws"].values())
    figures = (
        ("AWS calls of a POST that answers a page", sum(with_factors["answers"].values()), 1),
        ("AWS calls of a revisit, in a study with factors", sum(with_factors["asks"].values()), 3),
        ("AWS calls of a revisit, in a study without", sum(without["asks"].values()), 2),
        ("AWS calls that assigning adds to a request", drawn, 4),
    )
    for name, value, most in figures:
        yield row(name, value, "calls", at_most=most, decides="how long a page takes, and the bill", detail=detail)
        detail = {}


def arrivals() -> Iterator[Row]:
    """Send 200 participants within a minute, and 200 more two hours later, when those who left are looked up."""
    from hippodrome.control.model.balance import cells_key
    from hippodrome.control.participants.assigning import Assigning
    from testing.quiet_log import quiet
    from testing.simulation.designs import Designed, Ways

    world = _simulated(conditions=True)
    times: list[tuple[float, float]] = []
    assign = Assigning.assign

    def timed(*given: Any) -> Any:
        begun = world.clock.seconds
        assignment = assign(*given)
        times.append((begun, world.clock.seconds - begun))
        return assignment

    people = [Designed(world, number, ways=Ways(leaves="" if number % 5 else "survey")) for number in range(400)]
    for number, person in enumerate(people):
        world.clock.spawn(person.walk, delay=world.clock.random.uniform(0, 60) + 7200 * (number >= 200))
    with quiet(), patch.object(Assigning, "assign", timed):
        world.run(3600)
        first = world.cloud.conflicts[cells_key(world.project.id)]
        world.run(4 * 3600)
    both = world.cloud.conflicts[cells_key(world.project.id)]
    for name, retries, since in (("200 within a minute", first, 0), ("200 more, two hours later", both - first, 3600)):
        seconds = sorted(took for begun, took in times if since <= begun < since + 7200)
        yield row(
            f"simulated: {name}: time to assign, p95",
            seconds[int(len(seconds) * 0.95)],
            "s",
            at_most=1,
            decides="whether a lab session or a batch of recruits waits for a page",
            detail={
                "participants assigned": len(seconds),
                "writes tried again": retries,
                "p50, max": [seconds[len(seconds) // 2], seconds[-1]],
            },
        )


def _simulated(*, conditions: bool) -> Any:
    """A simulated installation with a study of pages, with two factors or without."""
    import msgspec

    from hippodrome.control.model.design import Step
    from hippodrome.control.model.project import Events
    from testing.simulation.designs import CONDITIONS, PAGES
    from testing.simulation.world import PROJECT, SimulatedWorld

    steps = [Step(name, name) for name in ("consent", "impression", "survey", "debrief")]
    changes: dict[str, Any] = {"steps": steps, "events": Events()}
    if conditions:
        steps[1] = Step("impression", "impression-{partner}")
        changes["conditions"] = CONDITIONS
    return SimulatedWorld(1, None, msgspec.structs.replace(PROJECT, **changes), pages=PAGES if conditions else {})


def _calls_of_requests(conditions: bool) -> dict[str, Counter[str]]:
    """Count the calls of some requests of a participant, in a function that has the project and the pages in its cache.

    `answers` is a POST; `draws` the GET after it, which assigns if there are factors; `asks` the same GET again.
    """
    from testing import aws_events
    from testing.visitors import body_of, hidden

    world = _simulated(conditions=conditions)
    counted: dict[str, Counter[str]] = {}

    def ask(user: str, method: str, body: str | None = None) -> str:
        query = f"projectId={world.project.id}&userId={user}"
        headers = {"accept": "text/html", **({"content-type": aws_events.FORM} if body else {})}
        before = Counter(world.cloud.calls)
        answer = world.next_step.invoke(aws_events.http_event(method, query, body, headers=headers))
        counted[method if method == "POST" else user] = Counter(world.cloud.calls) - before
        return body_of(answer).decode()

    def walk() -> None:
        for user in ("first", "second"):
            page = ask(user, "GET")
            ask(user, "POST", urlencode({**hidden(page), "answer": "yes"}))
            ask(user, "GET")
            counted["draws"] = counted[user]
            ask(user, "GET")
            counted["asks"] = counted[user]

    world.clock.spawn(walk)
    world.run(60)
    return {"answers": counted["POST"], "draws": counted["draws"], "asks": counted["asks"]}
