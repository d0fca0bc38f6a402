"""Balances the cells and orders of a study: who gets which. Pure.

`_cells/{projectId}.json` has the number of people that count in each cell: everybody who was assigned to it, without
those who ended early or have left. A new participant gets one of the cells with the fewest people, and of its orders
one that was used least. Those assigned lately are listed, so that a repeated request gets the same, and so that those
who leave can be taken out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timedelta
from enum import Enum
from random import Random
from typing import TypeVar

import msgspec

from hippodrome.control.model.design import LATIN, RANDOM, Assignment, Block, cell_name, cells, games_on, latin_rows
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import Record

T = TypeVar("T")
LEFT_AFTER = timedelta(minutes=60)
"""Who does nothing for so long has left, and their place in the cell is free: see `left_after`."""
SETTLED_AT_ONCE = 5
"""The most participants who are looked up in one assignment; each costs a listing."""


def cells_key(project_id: str) -> str:
    """Return the key of the document with a study's cells."""
    return f"_cells/{project_id}.json"


def left_after(project: Project) -> timedelta:
    """Return for how long somebody may do nothing before they count as having left: longer if a page keeps them."""
    return LEFT_AFTER + timedelta(seconds=max(step.min_seconds for step in project.steps))


class Outcome(Enum):
    """What became of a participant, or of a session: what became of the member who came furthest."""

    COMPLETE = "complete"
    ACTIVE = "active"
    LEFT = "left"


class Draw(Record, frozen=True):
    """What a participant got: a cell, and of each block with Latin orders a row. `at`: when, or their last answer."""

    cell: str
    at: datetime
    rows: Mapping[str, int] = msgspec.field(default_factory=dict)


class Cells(Record, frozen=True):
    """`_cells/{projectId}.json`. `people` and `rows` count those in `drawn`, too.

    `rows` are the numbers of uses of each row, by block and cell: `"{block}/{cell}"`.
    """

    people: Mapping[str, int] = msgspec.field(default_factory=dict)
    rows: Mapping[str, Sequence[int]] = msgspec.field(default_factory=dict)
    drawn: Mapping[str, Draw] = msgspec.field(default_factory=dict)

    def unsettled(self, now: datetime, most: timedelta = LEFT_AFTER) -> list[str]:
        """Return the participants to look up: the oldest of those who have done nothing for longer than `most`."""
        old = [user for user, draw in self.drawn.items() if now - draw.at > most]
        return sorted(old, key=lambda user: self.drawn[user].at)[:SETTLED_AT_ONCE]

    def settled(self, user_id: str, outcome: Outcome, last: datetime) -> Cells:
        """Return the cells after a look at a participant, whose last answer was at this time."""
        draw = self.drawn.get(user_id)
        if draw is None:
            return self
        others = {user: other for user, other in self.drawn.items() if user != user_id}
        if outcome is Outcome.ACTIVE:
            return msgspec.structs.replace(self, drawn={**others, user_id: msgspec.structs.replace(draw, at=last)})
        rest = msgspec.structs.replace(self, drawn=others)
        return rest if outcome is Outcome.COMPLETE else rest._counting(draw, -1)

    def draw(
        self, project: Project, user_id: str, now: datetime, random: Random, cell: str | None = None
    ) -> tuple[Cells, Draw]:
        """Return the cells after this participant was assigned, and what they got. A second time it is the same.

        With a `cell`, the participant gets this one.
        """
        if user_id in self.drawn:
            return self, self.drawn[user_id]
        names = [cell_name(levels) for levels in cells(project.conditions)]
        cell = cell or random.choice(_least({name: self.people.get(name, 0) for name in names}))
        latin = {block.name: len(latin_rows(len(block.runs))) for block in project.blocks if block.order == LATIN}
        uses = {name: dict(enumerate(self._uses(name, cell, number))) for name, number in latin.items()}
        rows = {name: random.choice(_least(of_rows)) for name, of_rows in uses.items()}
        draw = Draw(cell, now, rows)
        after = msgspec.structs.replace(self, drawn={**self.drawn, user_id: draw})
        return after._counting(draw, 1), draw

    def without(self, user_id: str) -> Cells:
        """Return the cells without this participant's entry. The numbers stay."""
        return msgspec.structs.replace(self, drawn={user: draw for user, draw in self.drawn.items() if user != user_id})

    def _uses(self, block: str, cell: str, number: int = 0) -> list[int]:
        """How often each row of a block was used in a cell. There are at least `number` rows."""
        uses = list(self.rows.get(f"{block}/{cell}", ()))
        return uses + [0] * (number - len(uses))

    def _counting(self, draw: Draw, by: int) -> Cells:
        people = {**self.people, draw.cell: max(0, self.people.get(draw.cell, 0) + by)}
        rows = dict(self.rows)
        for block, row in draw.rows.items():
            uses = self._uses(block, draw.cell, row + 1)
            uses[row] = max(0, uses[row] + by)
            rows[f"{block}/{draw.cell}"] = uses
        return msgspec.structs.replace(self, people=people, rows=rows)


def assignment_of(project: Project, user_id: str, draw: Draw) -> Assignment:
    """Return the assignment of a participant, or of a session, who drew this."""
    by_name = {cell_name(levels): levels for levels in cells(project.conditions)}
    condition = by_name.get(draw.cell, {})
    orders = {block.name: _order(project, block, user_id, draw) for block in project.blocks}
    path = project.own(Assignment(condition=condition, orders=orders)).steps
    return Assignment(project.version, condition, orders, games_on(path, condition, project.trial))


def _order(project: Project, block: Block, user_id: str, draw: Draw) -> list[tuple[str, ...]]:
    """The runs of a block in a participant's order. A random order follows from the id, so that it can be repeated."""
    runs = block.runs
    if block.order == LATIN and block.name in draw.rows:
        rows = latin_rows(len(runs))
        runs = [runs[place] for place in rows[draw.rows[block.name] % len(rows)]]
    elif block.order == RANDOM:
        Random(f"{project.salt}/{user_id}/{block.name}").shuffle(runs)  # noqa: S311 - an order is no secret
    return runs[: block.length]


def _least(uses: Mapping[T, int]) -> list[T]:
    fewest = min(uses.values())
    return [name for name, number in uses.items() if number == fewest]


def outcome_of(
    steps: Iterable[str],
    answered: Mapping[str, datetime],
    has_ended: bool,
    now: datetime,
    most: timedelta = LEFT_AFTER,
) -> tuple[Outcome, datetime]:
    """Return what became of a participant who has answered these steps, and the time of the last answer.

    `steps` are the keys of their path without the last step. Who has done nothing for longer than `most` has left.
    """
    last = max(answered.values(), default=now - 2 * most)
    if all(step in answered for step in steps):
        return Outcome.COMPLETE, last
    is_active = not has_ended and now - last <= most
    return Outcome.ACTIVE if is_active else Outcome.LEFT, last


def most_active(outcomes: Sequence[tuple[Outcome, datetime]], now: datetime) -> tuple[Outcome, datetime]:
    """Return what became of a session, from what became of its members; it has left if there are none any more."""
    ranks = list(Outcome)
    return min(outcomes, key=lambda outcome: ranks.index(outcome[0]), default=(Outcome.LEFT, now))
