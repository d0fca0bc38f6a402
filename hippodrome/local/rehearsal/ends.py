"""Sends bots through a study; with `try --ends` to each cell of `conditions` and each end, and says where nobody came.

The bots choose their answers by the rules of the ends (`bots/steering.py`). Whoever has not come where they were sent
is followed by another bot, at most ROUNDS times.
"""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hippodrome.bots.bot import Bot
from hippodrome.bots.crowd import walk
from hippodrome.bots.links import with_fields
from hippodrome.bots.report import BotReport
from hippodrome.bots.steering import Design, Steering
from hippodrome.bots.verification import document
from hippodrome.control.config import Config
from hippodrome.control.config.folder import ConfigSource
from hippodrome.control.model import rules
from hippodrome.control.model.design import COMPLETE, FAILED, LATIN, RANDOM, End, cell_name, cells
from hippodrome.local.own_cells import FIELD
from hippodrome.protocol.keys import participant_folder
from hippodrome.protocol.session import ASSIGNMENT

ROUNDS = 3
BY_CHANCE = 8
"""Bots for an end that depends on chance: on a game, or on the cell that is drawn for people who play together."""
Watch = Callable[[Sequence[BotReport]], None]


@dataclass(frozen=True)
class Crowd:
    """How bots walk through the study. `at_once` is how many walk at one time; times are in seconds."""

    at_once: int
    ramp: float
    play: float
    patience: float
    right: Mapping[str, Mapping[str, str]]  # the right answers of checks, by step

    async def rehearse(self, link: str, number: int, watch: Watch) -> list[BotReport]:
        """Send so many bots through the study, and return their reports. If this is cancelled, all bots end."""
        run, width = secrets.token_hex(3), len(str(number))
        bots = [
            self.bot(link, f"bot-{run}-{n:0{width}}", Random(f"{run}{n}"))  # noqa: S311 - bots
            for n in range(1, number + 1)
        ]
        return await self.walk(bots, watch)

    async def walk(self, bots: Sequence[Bot], watch: Watch) -> list[BotReport]:
        return await walk(bots, at_once=self.at_once, ramp=self.ramp, watch=watch)

    def bot(self, link: str, user_id: str, random: Random, steering: Steering | None = None) -> Bot:
        return Bot(link, user_id, random, play=self.play, patience=self.patience, right=self.right, steering=steering)


@dataclass(frozen=True)
class Goal:
    """Where a bot is sent: to an end, or to the last page, in a cell; "" if it gets any."""

    end: End | None = None
    cell: str = ""


@dataclass(frozen=True)
class Walk:
    """Where a bot was sent, what it reported, and the cell and orders that it got."""

    goal: Goal
    report: BotReport
    cell: str | None
    orders: dict[str, list[list[str]]]


class Ends:
    """The cells and ends of a study, and which of them bots have reached."""

    def __init__(self, config: Config, data: Path) -> None:
        design = config.design
        self._config, self._data = config, data
        self.design = Design(
            [step.step for step in config.steps if step.step], design.blocks, design.conditions, design.ends
        )
        self._levels = {cell_name(levels): levels for levels in cells(design.conditions)}
        self.walks: list[Walk] = []

    @property
    def cells(self) -> list[str]:
        """The names of all cells; one without a name if there are no conditions."""
        return list(self._levels)

    @property
    def tried(self) -> list[End]:
        """The ends that bots can be sent to."""
        return [end for end in self.design.ends if end.when]

    def came_through(self, cell: str) -> int:
        """Return how many bots came to the last page in this cell."""
        return sum(walk.report.finished and walk.cell in (cell, None) for walk in self.walks)

    def reached(self, end: str) -> int:
        return sum(walk.report.end == end for walk in self.walks)

    def goals(self) -> list[Goal]:
        """Return where bots are to be sent: to every cell and end that nobody has reached yet."""
        size = self._config.project.players
        goals = [Goal(cell="" if size > 1 else cell) for cell in self.cells if not self.came_through(cell)]
        for end in self.tried:
            if not self.reached(end.name):
                goals += self._goals_of(end)
        return [goal for goal in goals for _ in range(size)]

    def _goals_of(self, end: End) -> list[Goal]:
        """The bots for an end: one in each cell if a rule asks about it, and several if it depends on chance."""
        asks_cell = _asks(end, "condition")
        if asks_cell and self._config.project.players == 1:
            goals = [Goal(end, cell) for cell in self.cells]
        else:
            goals = [Goal(end)] * (min(len(self.cells), BY_CHANCE) if asks_cell else 1)
        return goals * max(1, BY_CHANCE // len(goals)) if self.games_asked(end) else goals

    def games_asked(self, end: End) -> list[str]:
        """The games about whose answers a rule of the end asks. Bots play them by chance."""
        steps = {names[1] for rule in end.when for names in rules.mentioned(rule) if names[0] == "answers"}
        return sorted(step.key for step in self.design.steps if step.type.on_server and step.key in steps)

    async def rehearse(self, link: str, crowd: Crowd, watch: Watch) -> list[BotReport]:
        """Send bots until nothing is left to reach, at most ROUNDS times. Return their reports."""
        for _ in range(ROUNDS):
            goals = self.goals()
            if not goals:
                break
            run, before = secrets.token_hex(3), [walk.report for walk in self.walks]
            bots = [self._bot(link, f"bot-{run}-{number:03}", goal, crowd) for number, goal in enumerate(goals, 1)]

            def watch_all(reports: Sequence[BotReport], before: Sequence[BotReport] = before) -> None:
                watch([*before, *reports])

            reports = await crowd.walk(bots, watch_all)
            self.walks += [self._walk(goal, report) for goal, report in zip(goals, reports, strict=True)]
        return [walk.report for walk in self.walks]

    def _bot(self, link: str, user_id: str, goal: Goal, crowd: Crowd) -> Bot:
        random = Random(user_id)  # noqa: S311 - bots
        steering = Steering(self.design, goal.end, random, self._levels[goal.cell] if goal.cell else None)
        steering.set_out()
        fields = {name: value for name, value in steering.participant.items() if name != "device"}
        if goal.cell:
            fields[FIELD] = goal.cell
        return crowd.bot(with_fields(link, fields), user_id, random, steering)

    def _walk(self, goal: Goal, report: BotReport) -> Walk:
        path = self._data / participant_folder(self._config.project.id, report.user_id) / ASSIGNMENT
        assignment = document(path)
        has_cell = bool(self.design.conditions)
        cell = cell_name(assignment.get("condition", {})) if has_cell else None
        return Walk(goal, report, cell, assignment.get("orders", {}))


def _asks(end: End, root: str) -> bool:
    """Whether a rule of the end asks about this: "condition", for instance."""
    return any(names[0] == root for rule in end.when for names in rules.mentioned(rule))


# The report


def report(console: Console, ends: Ends, source: ConfigSource) -> bool:
    """Print how many bots came through each cell, end and order; return whether each cell and end was reached."""
    table = Table("", "bots", "", title="Cells and ends", title_justify="left")
    for row in _rows(ends):
        table.add_row(*map(escape, row))
    console.print(table)
    missing = [*_empty_cells(ends, source), *_unreached(ends, source)]
    for line in missing:
        console.print(f"  {escape(line)}", style="red", soft_wrap=True)
    return not missing


def _rows(ends: Ends) -> Iterator[tuple[str, str, str]]:
    if ends.design.conditions:
        for cell in ends.cells:
            yield f"cell {cell}", str(ends.came_through(cell)), "came to the last page"
    yield f"end {COMPLETE}", str(sum(walk.report.finished for walk in ends.walks)), "the last page"
    for end in ends.design.ends:
        if end.when:
            yield f"end {end.name}", str(ends.reached(end.name)), " or ".join(end.when)
        elif end.minutes is not None:
            yield f"end {end.name}", "not tried", f"after {end.minutes:g} minutes: bots do not wait so long"
        elif end.name == FAILED:
            yield f"end {end.name}", "not tried", "no server can run a game: here servers do run"
    for block in ends.design.blocks:
        if block.order not in (LATIN, RANDOM):
            continue
        first = Counter(
            ", ".join(order[0])
            for walk in ends.walks
            if walk.report.finished and (order := walk.orders.get(block.name))
        )
        for run in block.runs[: max(len(first), 12)]:
            yield f"{block.name}: {', '.join(run)} first", str(first[", ".join(run)]), f"{block.order} order"


def _empty_cells(ends: Ends, source: ConfigSource) -> Iterator[str]:
    """A sentence for each cell through which nobody came; without conditions, if nobody came to the last page."""
    where = ("project", "conditions") if ends.design.conditions else ("project", "steps")
    for cell in ends.cells:
        if not ends.came_through(cell):
            what = f"cell {cell} stayed empty" if ends.design.conditions else "no bot came to the last page"
            sent = [walk.report for walk in ends.walks if walk.goal.end is None and walk.goal.cell in (cell, "")]
            yield str(source.diagnostic(where, f"{what}. {_where(sent)}"))


def _unreached(ends: Ends, source: ConfigSource) -> Iterator[str]:
    for end in ends.tried:
        if not ends.reached(end.name):
            message = f"no bot could reach this end. Its rule is {' or '.join(end.when)}. {_why(ends, end)}"
            yield str(source.diagnostic(("project", "ends", end.name), message))


def _why(ends: Ends, end: End) -> str:
    """What the bots did about the rules of an end, and what they cannot do."""
    sent = [walk.report for walk in ends.walks if walk.goal.end == end]
    if chance := ends.games_asked(end):
        return f"It asks about {' and '.join(chance)}, which bots play by chance: play it yourself. {_where(sent)}"
    if _asks(end, "order") or _asks(end, "run"):
        return f"It asks about an order, which is drawn: try again. {_where(sent)}"
    names = [other.name for other in ends.design.ends]
    before = names[: names.index(end.name)]
    earlier = [name for name in before if any(report.end == name for report in sent)]
    if earlier and all(report.end in before for report in sent):  # some may come there by the cell that is drawn
        return f"{_where(sent)} {' and '.join(earlier)} stands before it in the file, and counts first."
    return f"{_where(sent)} No value that their pages offer makes it true."


def _where(sent: Sequence[BotReport]) -> str:
    """Where these bots came to."""
    became = Counter(
        f"end {report.end}"
        if report.end
        else "the last page"
        if report.finished
        else "an error"
        if report.errors
        else f"step {report.ended}, where no button can be pressed"
        for report in sent
    )
    return f"The bots sent there came to: {', '.join(f'{place} ({count})' for place, count in became.most_common())}."
