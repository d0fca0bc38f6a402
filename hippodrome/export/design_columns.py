"""The factors, orders and ends of a study, as columns of a row per participant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hippodrome.control.model.design import Assignment
from hippodrome.control.model.place import orders_of
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_data
from hippodrome.export.keys import ASSIGNED, ENDED
from hippodrome.export.recording_columns import when
from hippodrome.export.scrub import clean
from hippodrome.export.table_files import Column

Documents = Mapping[str, Mapping[str, Any]]


def is_answer(step: str) -> bool:
    """Return whether a document is an answer: neither a try, nor an assignment or an end."""
    return "." not in step and step not in (ASSIGNED, ENDED)


def assignment_in(documents: Documents) -> Assignment | None:
    """Return a participant's assignment; None if there is none, or if it cannot be read."""
    try:
        return from_data(documents[ASSIGNED], Assignment) if ASSIGNED in documents else None
    except ValueError:
        return None


@dataclass(frozen=True)
class Design:
    """The factors and ends of a study, as columns of a row per participant."""

    project: Project | None = None
    between: tuple[str, ...] = ()
    within: tuple[str, ...] = ()
    has_ends: bool = False

    @classmethod
    def of(cls, project: Project | None) -> Design:
        """Return the design of a project; of None it is empty."""
        if project is None:
            return cls()
        within = (factor.name for block in project.blocks for factor in block.factors)
        between = (factor.name for factor in project.conditions)
        return cls(project, tuple(between), tuple(within), bool(project.ends))

    @property
    def columns(self) -> list[Column]:
        """The end, a column for each factor between people, and the order of each factor within people."""
        end = [Column("end"), Column("ended", "time")] if self.has_ends else []
        return [*end, *map(Column, self.between), *(Column(f"order.{name}") for name in self.within)]

    def values(self, documents: Documents, finished: bool | None) -> list[Any]:
        """Return the values of `columns` for one participant."""
        assignment, end = assignment_in(documents), documents.get(ENDED, {})
        condition = assignment.condition if assignment else {}
        orders = dict(orders_of(self.project.own(assignment))) if self.project and assignment else {}
        found: list[Any] = []
        if self.has_ends:
            name = end.get("end")
            found += [
                clean(name) if isinstance(name, str) else "complete" if finished else None,
                when(end.get("ended")),
            ]
        found += [condition.get(name) for name in self.between]
        return [*found, *(" ".join(orders[name]) if name in orders else None for name in self.within)]
