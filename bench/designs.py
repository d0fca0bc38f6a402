"""How evenly the cells of `conditions` fill, among those who finish."""

from __future__ import annotations

import types
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from random import Random
from typing import Any

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
