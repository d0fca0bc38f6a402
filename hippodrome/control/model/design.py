"""The design of a study: its steps, the factors that vary within and between people, and its ends. Pure.

A study's steps are a list, in which some steps form a block: they are repeated once for each level of the block's
factors, in an order of the participant's own. `own_steps` makes a participant's path of it: a list of steps again, in
which each run of a block's step is a step with a key of its own, such as `trust-cec`. All other code knows only paths.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import msgspec

from hippodrome.control.model.records import Record
from hippodrome.control.model.step_types import StepType, type_of

LATIN, RANDOM, FIXED = "latin", "random", "fixed"
ORDERS = (LATIN, RANDOM, FIXED)
COMPLETE, FAILED = "complete", "failed"
"""The ends that every study has: the last step was reached, and no server could run a game."""
Levels = Mapping[str, str]
"""The level of each factor, by its name."""


class Section(Record, frozen=True):
    """The keys of `trial` that a game has for itself at some levels: what differs from the project's `trial`."""

    levels: Levels = msgspec.field(default_factory=dict)
    trial: Mapping[str, Any] = msgspec.field(default_factory=dict)


class Step(Record, frozen=True):
    """One step of the study, or a run of it on a participant's path.

    `page` is a step file's name without `.html`, or `game`; it may hold `{factor}`. `variants` is the number of the
    files `{page}-0.html`, `{page}-1.html` …; 0 if the page has no variants. Times are in seconds.
    """

    key: str
    page: str
    variants: int = 0
    when: str = ""  # the rule by which a participant is asked; otherwise the step is skipped
    right: Mapping[str, str] = msgspec.field(default_factory=dict)  # the right answers of a check, by field
    tries: int = 0  # how often a check may be answered; 0: until it is right
    min_seconds: float = 0
    max_seconds: float = 0
    block: int | None = None  # the block's position in `Project.blocks`
    sections: tuple[Section, ...] = ()  # of a game
    name: str = ""  # on a path: the step's key in the study, if the path has another key for this run
    levels: Levels = msgspec.field(default_factory=dict)  # on a path: the levels of the block's factors
    position: int = 0  # on a path: which run of its block this is, from 1

    @property
    def type(self) -> StepType:
        return type_of(self.page)

    @property
    def step_name(self) -> str:
        """The key of the step in the study."""
        return self.name or self.key

    @property
    def is_limited(self) -> bool:
        """Whether the page's form says which try it is, and since when it is shown."""
        return bool(self.right) or self.min_seconds > 0

    @property
    def files(self) -> list[str]:
        """The names of the step files of all groups, without `.html`; none for a game."""
        if not self.type.has_files:
            return []
        return [f"{self.page}-{number}" for number in range(self.variants)] or [self.page]

    def section(self, levels: Levels) -> Mapping[str, Any]:
        """Return the keys of `trial` that this game has for itself at these levels."""
        fitting = (section.trial for section in self.sections if section.levels.items() <= levels.items())
        return next(fitting, {})


class Factor(Record, frozen=True):
    """A factor: its levels by their names, each with the value that `{factor}` stands for in `trial`."""

    name: str
    levels: Mapping[str, Any]


class Block(Record, frozen=True):
    """Steps that are repeated once for each level of some factors: for each combination, if there are several."""

    factors: tuple[Factor, ...]
    order: str = LATIN
    take: int | None = None  # only so many runs of the order

    @property
    def name(self) -> str:
        """The names of its factors, which no other block has."""
        return ",".join(factor.name for factor in self.factors)

    @property
    def runs(self) -> list[tuple[str, ...]]:
        """The levels of all runs: of each factor one, in the order of the file."""
        return list(itertools.product(*(factor.levels for factor in self.factors)))

    @property
    def length(self) -> int:
        """The number of runs that a participant has."""
        return len(self.runs) if self.take is None else min(self.take, len(self.runs))

    def levels(self, run: Sequence[str]) -> Levels:
        """Return the level of each factor in a run."""
        return dict(zip((factor.name for factor in self.factors), run, strict=False))


class End(Record, frozen=True):
    """An end of the study before its last step: for those of whom one of the rules in `when` holds, or whose time is
    over.

    `minutes` count from the participant's arrival. `page` is the name of a step file, "" for Hippodrome's own words.
    """

    name: str
    when: tuple[str, ...] = ()
    minutes: float | None = None
    page: str = ""
    code: str = ""  # "" for a code of the participant's own
    link: str = ""


class Game(Record, frozen=True):
    """A game on a path. The fields are those of `protocol.assignment.Game`, without the key."""

    step: str
    trial: Mapping[str, Any] = msgspec.field(default_factory=dict)
    levels: Levels = msgspec.field(default_factory=dict)
    position: int = 0
    answers: Mapping[str, Sequence[str]] = msgspec.field(default_factory=dict)


class Assignment(Record, frozen=True):
    """`assignment.json`: the levels and orders that a participant, or a session, got. Written once.

    `orders` are the runs of each block, by its name. `games` are the games on the path by their keys, in their order,
    for the server that runs them (`protocol/assignment.py`).
    """

    version: str = ""  # of the registration
    condition: Levels = msgspec.field(default_factory=dict)
    orders: Mapping[str, Sequence[Sequence[str]]] = msgspec.field(default_factory=dict)
    games: Mapping[str, Game] = msgspec.field(default_factory=dict)


def cells(factors: Sequence[Factor]) -> list[Levels]:
    """Return all combinations of the levels of these factors; one without levels if there are no factors."""
    names = [factor.name for factor in factors]
    return [dict(zip(names, cell, strict=True)) for cell in itertools.product(*(factor.levels for factor in factors))]


def cell_name(levels: Levels) -> str:
    """Return a name for a combination of levels."""
    return ",".join(levels.values())


def run_key(step: str, levels: Levels) -> str:
    """Return the key of a step's run at these levels, such as `trust-cec`. A dot becomes an underscore."""
    return "-".join((step, *levels.values())).replace(".", "_")


def latin_rows(length: int) -> list[list[int]]:
    """Return the rows of a Williams square: orders in which each run follows each other run equally often.

    There are `length` rows, or twice as many if the length is odd (E. J. Williams, 1949, Australian Journal of
    Scientific Research A 2, 149-168).
    """
    first = [(place + 1) // 2 if place % 2 else (length - place // 2) % length for place in range(length)]
    rows = [[(run + row) % length for run in first] for row in range(length)]
    return rows if length % 2 == 0 else [*rows, *(row[::-1] for row in rows)]


def own_steps(steps: Sequence[Step], blocks: Sequence[Block], assignment: Assignment | None) -> list[Step]:
    """Return the path of a participant: each block's steps once for each run, in the participant's order.

    Without an assignment the runs are in the order of the file. Runs whose levels the study does not have any more are
    left out.
    """
    path: list[Step] = []
    for number, group in itertools.groupby(steps, key=lambda step: step.block):
        members = list(group)
        if number is None:
            path += members if assignment is None else [_at(step, assignment.condition) for step in members]
            continue
        block = blocks[number]
        runs_of_block = set(block.runs)
        order = assignment.orders.get(block.name) if assignment else None
        runs = block.runs if order is None else [run for run in map(tuple, order) if run in runs_of_block]
        for position, run in enumerate(runs[: block.length], 1):
            path += _runs(members, block.levels(run), position, assignment)
    return path


def _runs(steps: Sequence[Step], levels: Levels, position: int, assignment: Assignment | None) -> Iterator[Step]:
    """The steps of a block for one run."""
    condition = assignment.condition if assignment else {}
    for step in steps:
        run = msgspec.structs.replace(
            step, key=run_key(step.key, levels), name=step.key, levels=levels, position=position
        )
        yield _at(run, {**condition, **levels})


def _at(step: Step, levels: Levels) -> Step:
    """The step with the page of these levels."""
    return msgspec.structs.replace(step, page=fill(step.page, levels)) if "{" in step.page else step


def fill(text: str, levels: Mapping[str, Any]) -> str:
    """Return the text with the level of each `{factor}` in the place of its name; other braces stay."""
    for name, level in levels.items():
        text = text.replace(f"{{{name}}}", str(level))
    return text


def pages_of(step: Step, conditions: Sequence[Factor]) -> list[Step]:
    """Return the step with the page of each level of the factors between people that its page names."""
    factors = [factor for factor in conditions if f"{{{factor.name}}}" in step.page]
    return [_at(step, levels) for levels in cells(factors)]


def same_run(runs: Iterable[Step], step: Step) -> Step | None:
    """Return the one of a step's runs whose answers count at `step` as the answers to that step.

    In a block it is the run of the same levels; None after the block, where the answers of all runs are seen by level.
    """
    return next((run for run in runs if not run.name or run.levels == step.levels), None)


def games_on(path: Sequence[Step], condition: Levels, trial: Mapping[str, Any]) -> dict[str, Game]:
    """Return the games of a path by their keys, in their order, each with what it has for itself.

    `trial` is the section of the study, whose keys a game has unless it has them for itself.
    """
    games = {}
    for at, step in enumerate(path):
        if step.type.on_server:
            section = step.section({**condition, **step.levels})
            read = answers_read(path[:at], step, section.get("answers", trial.get("answers", ())))
            games[step.key] = Game(step.step_name, section, step.levels, step.position, read)
    return games


def answers_read(before: Sequence[Step], game: Step, names: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Return the keys of the answers that a game's agent reads, with the names under which it finds each.

    `before` are the steps before the game on the path, and `names` the steps of the study that the game names.
    """
    read: dict[str, tuple[str, ...]] = {}
    for name in names:
        runs = [run for run in before if run.step_name == name]
        same = same_run(runs, game)
        read |= {same.key: (name,)} if same else {run.key: (name, "-".join(run.levels.values())) for run in runs}
    return read
