"""Where a participant is on their path, and what is to be done next. Pure.

`Standing.place` is the only rule for it: from the study, what the participant has answered, and the time it follows
that an end is reached, that an assignment is needed, that a step is skipped, judged or over, or that a step is asked. A
POST stores an answer and decides nothing; a GET does what `place` says, and asks again, until a page is to be shown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from enum import Enum
from typing import Any, NamedTuple

from hippodrome.control.model import rules
from hippodrome.control.model.design import FAILED, Assignment, End, Step, same_run
from hippodrome.control.model.participant import Progress
from hippodrome.control.model.project import Project

SKIPPED, TIME_OVER = "skipped", "timeOver"
"""`outcome` in the answer to a step that was skipped, or whose `maxSeconds` were over."""


class Next(Enum):
    """What is to be done next."""

    END = "end"
    ASSIGN = "assign"
    SKIP = "skip"
    JUDGE = "judge"
    TIME_OVER = "timeOver"
    ASK = "ask"


class Place(NamedTuple):
    """What is next, and at which step. `end` is the end that is reached.

    `is_over`: the time of a check is over, so that a wrong answer is the last.
    """

    next: Next
    step: Step
    end: End | None = None
    is_over: bool = False


@dataclass
class Standing:
    """A participant's progress on their own path, which is `project` (`Project.own`).

    `read_answers` returns the answers to a run, by its key, and `read_participant` the fields of the participant's link
    and their device. Both are called only if a rule asks about them.
    """

    project: Project
    progress: Progress
    read_answers: Callable[[str], Mapping[str, Any]]
    read_participant: Callable[[], Mapping[str, Any]]
    assignment: Assignment | None = None
    _answers: dict[str, Mapping[str, Any]] = field(default_factory=dict)

    def place(self, now: datetime) -> Place:
        """Return what is next. `now` is compared with the times of the participant's answers.

        Raises `rules.BadRule` if a rule of the study cannot be read.
        """
        last: Step | None = None
        for step in self.project.steps[:-1]:
            if step.key in self.progress.answered:
                last = step
                continue
            return self._place_at(step, last, now)
        final = self.project.final
        if self._draws_for_end(last):
            return Place(Next.ASSIGN, final)
        if (end := self._end(final, last, None)) is not None:
            return Place(Next.END, final, end)
        is_unassigned = self.assignment is None and needs_assignment(self.project, final)
        return Place(Next.ASSIGN if is_unassigned else Next.ASK, final)

    def _place_at(self, step: Step, last: Step | None, now: datetime) -> Place:
        """What is next at the first step that is not answered; `last` is the step answered before it."""
        if self._draws_for_end(last):
            return Place(Next.ASSIGN, step)
        if (end := self._end(step, last, now)) is not None:
            return Place(Next.END, step, end)
        if self.assignment is None and needs_assignment(self.project, step):
            return Place(Next.ASSIGN, step)
        has_no_level = self.assignment is not None and "{" in step.page  # who was matched with nobody
        if has_no_level or (step.when and not rules.holds(step.when, self._facts(step.when, step))):
            return Place(Next.SKIP, step)
        reached = self.progress.reached_at(self.project, step) or self.progress.arrived or now
        is_over = step.max_seconds > 0 and now - reached > timedelta(seconds=step.max_seconds)
        if step.right and step.key in self.progress.tries:
            return Place(Next.JUDGE, step, is_over=is_over)
        return Place(Next.TIME_OVER if is_over else Next.ASK, step)

    def _end(self, step: Step, last: Step | None, now: datetime | None) -> End | None:
        """The end that is reached between the step answered last and this one; None if there is none.

        Who is at a game does not run out of time there: the time of arrival at the game counts. With None for `now`
        nobody runs out of time. The end `failed` is reached after a game that no server could run.
        """
        progress = self.progress
        if now is not None and step.type.on_server:
            now = progress.answered[last.key] if last is not None else None
        for end in self.project.ends:
            timed = end.minutes is not None and now is not None and progress.arrived is not None
            if timed and now - progress.arrived > timedelta(minutes=end.minutes):  # type: ignore[operator,arg-type]
                return end
            due = (rule for rule in end.when if last is not None and self._is_due(rule, last))
            if any(rules.holds(rule, self._facts(rule, self.project.final)) for rule in due):
                return end
            if end.name == FAILED and last is not None and last.type.on_server and self._has_failed(last):
                return end
        return None

    def _draws_for_end(self, last: Step | None) -> bool:
        """Whether an end's rule that is looked at now asks about levels that are not drawn yet.

        With sessions the matching draws, and rules about levels come after the first game.
        """
        if last is None or self.assignment is not None or not self.project.assigns or self.project.has_sessions:
            return False
        return any(_asks_levels(rule) and self._is_due(rule, last) for end in self.project.ends for rule in end.when)

    def _has_failed(self, game: Step) -> bool:
        return self._read(game.key).get("outcome") == FAILED

    def _is_due(self, rule: str, last: Step) -> bool:
        """Whether an end's rule is looked at now: it asks about the last answer, and has all answers that it needs."""
        steps_mentioned = rules.steps_mentioned(rule)
        return last.step_name in steps_mentioned and all(self._answered_runs(name) for name in steps_mentioned)

    def _facts(self, rule: str, step: Step) -> Mapping[str, Any]:
        """What the rule asks about, for a participant at this step."""
        asks = {names[0] for names in rules.mentioned(rule)}
        return {
            "answers": {name: self.answers_to(name, step) for name in rules.steps_mentioned(rule)},
            **values_of(self.project, self.assignment, step),
            "participant": self.read_participant() if "participant" in asks else {},
        }

    def answers_to(self, name: str, step: Step) -> Mapping[str, Any]:
        """Return the answers to a step of the study, as a participant at `step` sees them.

        In a block they are those of the same run; after it they are `Runs`, by level. Empty if there are none.
        """
        runs = self._answered_runs(name)
        if same := same_run(runs, step):
            return self._read(same.key)
        return rules.Runs({"-".join(run.levels.values()): self._read(run.key) for run in runs}) if runs else {}

    def _answered_runs(self, name: str) -> list[Step]:
        return [run for run in self.project.steps if run.step_name == name and run.key in self.progress.answered]

    def _read(self, key: str) -> Mapping[str, Any]:
        if key not in self._answers:
            self._answers[key] = self.read_answers(key)
        return self._answers[key]


def needs_assignment(project: Project, step: Step) -> bool:
    """Return whether a participant cannot come to this step before their levels and orders are drawn."""
    if not project.assigns:
        return False
    return bool(step.name or step.type.on_server or "{" in step.page or (step.when and _asks_levels(step.when)))


def _asks_levels(rule: str) -> bool:
    return any(names[0] in ("condition", "order") for names in rules.mentioned(rule))


def values_of(project: Project, assignment: Assignment | None, step: Step) -> dict[str, Any]:
    """Return `condition`, `order` and `run` as rules and pages see them at a step of a participant's path."""
    condition = {**(assignment.condition if assignment else {}), **step.levels}
    return {"condition": condition, "order": dict(orders_of(project)), "run": {"position": step.position or ""}}


def orders_of(project: Project) -> Iterator[tuple[str, list[str]]]:
    """Yield each factor within people, with its levels in the order of the participant's path, which `project` has."""
    runs = {tuple(step.levels.items()): step.levels for step in project.steps if step.levels}
    for name in dict.fromkeys(name for levels in runs.values() for name in levels):
        yield name, [levels[name] for levels in runs.values() if name in levels]


def wrong_fields(step: Step, answers: Mapping[str, Any]) -> list[str]:
    """Return the fields of a check that are not right. Case, and space at the ends, do not count."""
    return [name for name, right in step.right.items() if _plain(answers.get(name)) != _plain(right)]


def _plain(value: Any) -> str:
    return str("" if value is None else value).strip().casefold()
