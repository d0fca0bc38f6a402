"""Makes the tables of studies with a design: a row for each run of a block, and a row for each field of a try."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hippodrome.control.model.design import Assignment, Step
from hippodrome.control.model.project import Project
from hippodrome.export import table_files
from hippodrome.export.answers import Field, StudyAnswers
from hippodrome.export.design_columns import Documents, assignment_in
from hippodrome.export.recording_columns import when
from hippodrome.export.scrub import clean
from hippodrome.export.table_files import Column, fit


@dataclass
class RunsTable:
    """A row for each run of a block and each participant who began it; the table of one block."""

    answers: StudyAnswers
    project: Project
    number: int
    fields: dict[tuple[str, str], Field] = field(default_factory=dict)

    def __post_init__(self) -> None:
        runs = {step.key: step for step in self.project.all_runs}
        for (key, name), known in self.answers.fields.items():
            run = runs.get(key)
            if run is None or run.block != self.number:
                continue
            found = self.fields.setdefault((run.step_name, name), type(known)(known.place, page_kind=known.page_kind))
            found.count += known.count
            found.kinds |= known.kinds

    @property
    def columns(self) -> list[Column]:
        """The participant, the factors between and within people, the position, and the fields of the block's steps."""
        within = self.project.blocks[self.number].factors
        return [
            Column("participant"),
            *(Column(factor.name) for factor in (*self.project.conditions, *within)),
            Column("position", "whole"),
            *(Column(f"{step}.{clean(name)}", found.type) for (step, name), found in self.fields.items()),
        ]

    def rows(self) -> Iterator[list[Any]]:
        """Yield the rows, in the order of the participants and of their paths."""
        for participant, documents in self.answers.all_documents():
            assignment = assignment_in(documents)
            if assignment is None:
                continue
            path = [step for step in self.project.own(assignment).steps if step.block == self.number]
            for position in dict.fromkeys(step.position for step in path):
                steps = [step for step in path if step.position == position]
                if any(step.key in documents for step in steps):
                    yield [participant.number, *self._values(assignment, steps, documents)]

    def _values(self, assignment: Assignment, steps: Sequence[Step], documents: Documents) -> Iterator[Any]:
        levels = steps[0].levels
        yield from (assignment.condition.get(factor.name) for factor in self.project.conditions)
        yield from levels.values()
        yield steps[0].position
        keys = {step.step_name: step.key for step in steps}
        for (step, name), column in self.fields.items():
            given = documents.get(keys.get(step, ""), {}).get("answers")
            value = given.get(name) if isinstance(given, dict) else None
            yield None if value is None else fit(value, column.type)


def write(folder: Path, answers: StudyAnswers, project: Project | None, style: table_files.Style) -> list[Path]:
    """Write the tables of the study's blocks and tries, and return their paths.

    The first block's table is `runs`, that of a further one `runs-{factors}`.
    """
    written: list[Path] = []
    for number, block in enumerate(project.blocks) if project else ():
        assert project is not None
        table = RunsTable(answers, project, number)
        name = "runs" if number == 0 else f"runs-{block.name.replace(',', '-')}"
        written += table_files.write(folder / name, table.columns, table.rows(), style)
    if answers.has_tries:
        written += table_files.write(folder / "tries", TRIES, tries(answers), style)
    return written


TRIES = (
    Column("participant"),
    Column("step"),
    Column("try", "whole"),
    Column("answered", "time"),
    Column("field"),
    Column("value"),
)


def tries(answers: StudyAnswers) -> Iterator[list[Any]]:
    """Yield a row for each field of each try at a check."""
    for participant, documents in answers.all_documents():
        for key in sorted(key for key in documents if "." in key):
            step, _, number = key.partition(".")
            given, document = documents[key].get("answers"), documents[key]
            for name, value in given.items() if isinstance(given, dict) else ():
                when_ = when(document.get("answered"))
                yield [participant.number, step, int(number), when_, clean(str(name)), fit(value, "text")]
