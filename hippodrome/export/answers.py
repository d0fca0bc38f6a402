"""The tables of answers: `answers` with a row per participant, `answers-long` with a row per text, and for studies with
a design `runs`, with a row per run of a block, and `tries`, with a row per field of each try at a check.

A table sees all records once, to find its columns, before it makes the rows of one record after the other. So memory
does not grow with the study.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

from hippodrome.control.model.design import Assignment, Step
from hippodrome.control.model.place import orders_of
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_data
from hippodrome.export import scrub
from hippodrome.export.keys import ASSIGNED, ENDED
from hippodrome.export.page_fields import FieldKind
from hippodrome.export.records import Record
from hippodrome.export.scrub import clean
from hippodrome.export.table_files import Column, Table, as_columns, fit
from hippodrome.export.values import as_number, as_text, as_truth, as_whole, json_text, when
from hippodrome.protocol.session import is_session_id

MAX_FIELDS = 1_000
"""Columns of answers. Participants can send any number of fields; the rarest ones share the column `other`."""
MAX_LINK = 50
"""Columns of the values in participants' links, and of the headers of their first requests."""
_MAX_COUNTED = 50_000  # different fields that are counted at once


@dataclass
class Field:
    """The answers to one field: their number and their kinds."""

    place: int  # the field's place in the order in which fields were first read
    count: int = 0
    kinds: set[str] = field(default_factory=set)
    page_kind: FieldKind = FieldKind.TEXT  # the kind that the field's page tells

    @property
    def type(self) -> str:
        """The narrowest type of column that holds all answers. In a column of texts, other values become JSON."""
        is_number = self.page_kind is FieldKind.NUMBER
        numbers = {*_SENT_NUMBERS, *_TYPED_NUMBERS} if is_number else {*_SENT_NUMBERS}
        if self.kinds <= {*numbers, _EMPTY} and (self.kinds != {_EMPTY} or is_number):
            return "number" if self.kinds & {"number as text", "number as typed"} else "whole"
        kinds = {"text" if kind in (*_SENT_NUMBERS, *_TYPED_NUMBERS, _EMPTY) else kind for kind in self.kinds}
        if "other" in kinds:
            return "text"
        if "texts" in kinds or (self.page_kind is FieldKind.LIST and kinds == {"text"}):
            return "texts" if kinds <= {"text", "texts"} else "text"
        if kinds == {"whole", "number"}:
            return "number"
        return next(iter(kinds)) if len(kinds) == 1 else "text"


class ChangedPage(NamedTuple):
    """A step with answers from another page than its present one: steps were changed while participants took part."""

    step: str
    page: str  # the present page
    others: Mapping[str, int]  # the number of answers from each other page


class Answers(Table):
    """A row per participant."""

    name = "answers"

    def __init__(
        self,
        project: Project | None,
        apart: bool,
        page_kinds: Mapping[tuple[str, str], FieldKind] = MappingProxyType({}),
    ) -> None:
        """`page_kinds` has the kinds of the fields in the study's pages, by step and name (`page_fields`)."""
        self._project = project
        self._apart = apart
        self._page_kinds = page_kinds
        self._runs = {step.key: step for step in project.all_runs} if project else {}
        self._present_pages = {key: step.page for key, step in self._runs.items() if "{" not in step.page}
        self._in_sessions = False
        self._fields: dict[tuple[str, str], Field] = {}
        self._links: Counter[str] = Counter()
        self._pages: dict[str, Counter[str]] = {}
        """The number of answers from each page, by step."""
        self._with_versions = {key for key, step in self._runs.items() if step.variants}

    def see(self, record: Record) -> None:
        self._in_sessions = self._in_sessions or bool(record.membership)
        for step, document in record.answers.items():
            self._with_versions |= {step} if _has_version(document) else set()
            pages = self._pages.setdefault(step, Counter())
            if (page := self._page(step, document)) is not None:
                pages[page] += 1
            for name, value in _fields(document).items():
                new = Field(len(self._fields), page_kind=self._page_kinds.get((step, name), FieldKind.TEXT))
                known = self._fields.setdefault((step, name), new)
                known.count += 1
                known.kinds.add(_kind(value))
        self._links.update(scrub.columns(record.document).keys())
        if len(self._fields) > _MAX_COUNTED:  # participants can send any fields; the rarest go into `other`
            rarest = sorted(self._fields, key=lambda key: self._fields[key].count)
            for key in rarest[: _MAX_COUNTED // 2]:
                del self._fields[key]

    @cached_property
    def steps(self) -> list[str]:
        """All steps in the study's order; steps that the study does not have any more come last."""
        rest = sorted(self._pages.keys() - self._runs, key=lambda step: (not step.isdigit(), step.zfill(64)))
        return [*self._runs, *rest]

    @cached_property
    def fields(self) -> dict[tuple[str, str], Field]:
        """The fields that have columns, by step and name, in the order of the study and its pages."""
        commonest = sorted(self._fields, key=lambda key: (-self._fields[key].count, self._fields[key].place))
        steps = {step: place for place, step in enumerate(self.steps)}
        order = {key: place for place, key in enumerate(self._page_kinds)}
        ordered = sorted(
            commonest[:MAX_FIELDS],
            key=lambda key: (steps[key[0]], order.get(key, len(order)), self._fields[key].place),
        )
        return {key: self._fields[key] for key in ordered}

    @cached_property
    def links(self) -> list[str]:
        """The commonest values of links, and headers, by the names of their columns."""
        return sorted(self._links, key=lambda name: (-self._links[name], name))[:MAX_LINK]

    @cached_property
    def moved(self) -> list[ChangedPage]:
        """The steps with answers from another page than their present one."""
        pages = ((step, page, self._pages.get(step, Counter())) for step, page in self._present_pages.items())
        return [
            ChangedPage(step, page, others)
            for step, page, counts in pages
            if (others := {name: count for name, count in counts.items() if name != page})
        ]

    @cached_property
    def _answerable(self) -> list[str]:
        final = self._project.final.key if self._project else ""
        return [step for step in self.steps if step != final or any(key[0] == final for key in self._fields)]

    @cached_property
    def _versioned(self) -> list[str]:
        return [step for step in self._answerable if step in self._with_versions]

    @property
    def _crowded(self) -> bool:
        return len(self._fields) > MAX_FIELDS or len(self._links) > MAX_LINK

    def _page(self, step: str, answer: Mapping[str, Any]) -> str | None:
        """The page that a step's answer came from. All versions of the present page count as one."""
        page = answer.get("page")
        if not isinstance(page, str):
            return None
        present = self._present_pages.get(step, "")
        return present if present and present in (page, _VERSION.sub("", page)) else clean(page)

    def finished(self, record: Record) -> bool | None:
        """Return whether every step before the last has an answer; None if the study's steps are not known."""
        if self._project is None:
            return None
        own = self._project.own(assignment_in(record.documents))
        return ENDED not in record.documents and all(step.key in record.documents for step in own.steps[:-1])

    def _label(self, step: str) -> str:
        """The name of a step in columns: `trust.cec` for the run `trust-cec`."""
        run = self._runs.get(step)
        return ".".join((run.name, *run.levels.values())) if run and run.name else step

    @property
    def columns(self) -> list[Column]:
        return _distinct(
            *as_columns("participant group:whole arrived:time finished:truth"),
            *self._design_columns(),
            *(_MEMBERSHIP if self._in_sessions else ()),
            *([] if self._apart else [Column("completionCode")]),
            *([] if self._apart else [Column(clean(name)) for name in self.links]),
            *(Column(f"{self._label(step)}.{clean(name)}", found.type) for (step, name), found in self.fields.items()),
            *(Column(f"page.{moved.step}") for moved in self.moved),
            *(Column(f"group.{step}", "whole") for step in self._versioned),
            *(Column(f"answered.{self._label(step)}", "time") for step in self._answerable),
            *([Column("other")] if self._crowded else []),
        )

    def rows(self, record: Record) -> Iterator[list[Any]]:
        if not record.is_participant:
            return
        answers = record.answers
        fields = {step: _fields(answer) for step, answer in answers.items()}
        link = scrub.columns(record.document)
        finished = self.finished(record)
        row: list[Any] = [
            record.number,
            as_whole(record.document.get("group")),
            when(record.document.get("arrived")),
            finished,
            *self._design_values(record.documents, finished),
        ]
        row += _membership(record) if self._in_sessions else ()
        if not self._apart:
            row.append(record.completion_code)
            row += [clean(link[name]) if name in link else None for name in self.links]
        row += [
            fit(fields[step][name], column.type) if name in fields.get(step, ()) else None
            for (step, name), column in self.fields.items()
        ]
        row += [self._page(step, answers[step]) if step in answers else None for step, _, _ in self.moved]
        row += [as_whole(answers[step].get("group")) if step in answers else None for step in self._versioned]
        row += [when(answers[step].get("answered")) if step in answers else None for step in self._answerable]
        if self._crowded:
            row.append(self._rest(fields, {} if self._apart else link))
        yield row

    def _rest(self, fields: Mapping[str, Mapping[str, Any]], link: Mapping[str, str]) -> str | None:
        """The fields and the link's values that have no column, as JSON; None if there are none."""
        rest = {
            f"{step}.{name}": value
            for step, named in fields.items()
            for name, value in named.items()
            if (step, name) not in self.fields
        }
        rest |= {name: value for name, value in link.items() if name not in self.links}
        return json_text(rest) if rest else None

    def _design_columns(self) -> Iterator[Column]:
        """The end, a column for each factor between people, and the order of each factor within people."""
        if self._project is None:
            return
        if self._project.ends:
            yield from (Column("end"), Column("ended", "time"))
        yield from (Column(factor.name) for factor in self._project.conditions)
        yield from (Column(f"order.{factor.name}") for block in self._project.blocks for factor in block.factors)

    def _design_values(self, documents: Documents, finished: bool | None) -> Iterator[Any]:
        if self._project is None:
            return
        assignment, end = assignment_in(documents), documents.get(ENDED, {})
        if self._project.ends:
            yield as_text(end.get("end")) or ("complete" if finished else None)
            yield when(end.get("ended"))
        yield from (
            (assignment.condition if assignment else {}).get(factor.name) for factor in self._project.conditions
        )
        orders = dict(orders_of(self._project.own(assignment))) if assignment else {}
        for factor in (factor for block in self._project.blocks for factor in block.factors):
            yield " ".join(orders[factor.name]) if factor.name in orders else None


class LongAnswers(Table):
    """A row per value that was sent, and one for each text of a list."""

    name = "answers-long"
    columns = as_columns("participant step page group:whole answered:time field value")

    def __init__(self, answers: Answers) -> None:
        self._answers = answers

    def rows(self, record: Record) -> Iterator[list[Any]]:
        for step in sorted(record.answers, key=self._answers.steps.index):
            answer = record.answers[step]
            fixed = [
                record.number,
                step,
                as_text(answer.get("page")),
                as_whole(answer.get("group")),
                when(answer.get("answered")),
            ]
            for name, value in _fields(answer).items():
                for text in value if isinstance(value, list) and _kind(value) == "texts" else [value]:
                    yield [*fixed, clean(name), fit(text, "text")]


class Runs(Table):
    """A row for each run of one block and each participant who began it."""

    def __init__(self, answers: Answers, project: Project, number: int) -> None:
        """`number` is the block's. The first block's table is `runs`, that of a further one `runs-{factors}`."""
        self._answers, self._project, self._number = answers, project, number
        self.name = "runs" if number == 0 else f"runs-{project.blocks[number].name.replace(',', '-')}"

    @cached_property
    def _fields(self) -> dict[tuple[str, str], Field]:
        """The fields of the block's steps, each with the answers of all runs."""
        runs = {step.key: step for step in self._project.all_runs}
        fields: dict[tuple[str, str], Field] = {}
        for (key, name), known in self._answers.fields.items():
            run = runs.get(key)
            if run is not None and run.block == self._number:
                new = Field(known.place, page_kind=known.page_kind)
                fields.setdefault((run.step_name, name), new).kinds.update(known.kinds)
        return fields

    @property
    def columns(self) -> list[Column]:
        factors = (*self._project.conditions, *self._project.blocks[self._number].factors)
        return [
            Column("participant"),
            *(Column(factor.name) for factor in factors),
            Column("position", "whole"),
            *(Column(f"{step}.{clean(name)}", column.type) for (step, name), column in self._fields.items()),
        ]

    def rows(self, record: Record) -> Iterator[list[Any]]:
        """Yield the rows in the order of the participant's path."""
        assignment = assignment_in(record.documents)
        if assignment is None:
            return
        path = [step for step in self._project.own(assignment).steps if step.block == self._number]
        for position in dict.fromkeys(step.position for step in path):
            steps = [step for step in path if step.position == position]
            if any(step.key in record.documents for step in steps):
                yield [record.number, *self._values(assignment, steps, record.documents)]

    def _values(self, assignment: Assignment, steps: Sequence[Step], documents: Documents) -> Iterator[Any]:
        yield from (assignment.condition.get(factor.name) for factor in self._project.conditions)
        yield from steps[0].levels.values()
        yield steps[0].position
        keys = {step.step_name: step.key for step in steps}
        for (step, name), column in self._fields.items():
            given = documents.get(keys.get(step, ""), {}).get("answers")
            value = given.get(name) if isinstance(given, dict) else None
            yield None if value is None else fit(value, column.type)


class Tries(Table):
    """A row for each field of each try at a check."""

    name = "tries"
    columns = as_columns("participant step try:whole answered:time field value")

    def __init__(self) -> None:
        self.needed = False

    def see(self, record: Record) -> None:
        self.needed = self.needed or any("." in key for key in record.documents)

    def rows(self, record: Record) -> Iterator[list[Any]]:
        for key in sorted(key for key in record.documents if "." in key):
            step, _, number = key.partition(".")
            document = record.documents[key]
            given = document.get("answers")
            for name, value in given.items() if isinstance(given, dict) else ():
                answered = when(document.get("answered"))
                yield [record.number, step, int(number), answered, clean(str(name)), fit(value, "text")]


Documents = Mapping[str, Mapping[str, Any]]


def assignment_in(documents: Documents) -> Assignment | None:
    """Return a participant's assignment; None if there is none, or if it cannot be read."""
    try:
        return from_data(documents[ASSIGNED], Assignment) if ASSIGNED in documents else None
    except ValueError:
        return None


_MEMBERSHIP = as_columns("session seat:whole unmatched:truth waited:number")


def _membership(record: Record) -> list[Any]:
    """The participant's session and seat, whether they were unmatched, and the seconds for which they waited."""
    about = record.membership
    session = about.get("session") if is_session_id(about.get("session")) else None
    seat, waited = as_whole(about.get("seat")), as_number(about.get("waited"))
    return [
        session,
        seat if session is not None and seat is not None and seat >= 0 else None,
        as_truth(about.get("unmatched")),
        waited if waited is not None and waited >= 0 else None,
    ]


def _distinct(*columns: Column) -> list[Column]:
    """The columns. A name that an earlier column has gets a number: `clean` may make two fields' names equal."""
    names: set[str] = set()
    made = []
    for column in columns:
        name, count = column.name, 1
        while name in names:
            count += 1
            name = f"{column.name}~{count}"
        names.add(name)
        made.append(column._replace(name=name))
    return made


def _has_version(answers: Mapping[str, Any]) -> bool:
    """Whether the page that a step's answer came from is the version of a group."""
    page, group = answers.get("page"), answers.get("group")
    return isinstance(page, str) and group is not None and page.endswith(f"-{group}")


def _fields(answers: Mapping[str, Any]) -> Mapping[str, Any]:
    """The fields of an answer's document that have a value; those of the map `talk` of a game as `talk.lines` …"""
    found = answers.get("answers")
    if not isinstance(found, dict):
        return {}
    if isinstance(talk := found.get(_TALK), dict):
        found = {name: value for name, value in found.items() if name != _TALK} | dict(_flat(talk, _TALK))
    return {str(n): value for n, value in found.items() if value is not None}


def _flat(values: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}.{name}")
        else:
            yield f"{prefix}.{name}", value


_TALK = "talk"
_SENT_NUMBERS = ("whole as text", "number as text")
_TYPED_NUMBERS = ("whole as typed", "number as typed")
"""Texts such as 07 and 2.50: from a field for numbers they are numbers, and from another field they may be codes."""
_EMPTY = "empty text"
_TYPED_WHOLE = re.compile(r"-?[0-9]{1,15}", re.ASCII)
_TYPED = re.compile(r"-?(?:[0-9]{1,15}(?:\.[0-9]{1,17})?|\.[0-9]{1,17})(?:[eE][+-]?[0-9]{1,3})?", re.ASCII)
"""HTML's "valid floating-point number", which a field for numbers sends. Numbers with more digits stay texts."""
_VERSION = re.compile(r"-[0-9]+\Z", re.ASCII)  # the number of a group after a page's name
_WHOLE = re.compile(r"-?[1-9][0-9]{0,15}|0", re.ASCII)
_DECIMAL = re.compile(r"-?[0-9]{1,16}\.[0-9]{1,17}", re.ASCII)


def _kind(value: Any) -> str:
    """The kind of a value that was sent: the type of its column, "other", or a kind of text (`_kind_of_text`)."""
    if isinstance(value, str):
        return _kind_of_text(value)
    if isinstance(value, bool):
        return "truth"
    if isinstance(value, int):
        return "whole" if -(2**53) <= value <= 2**53 else "other"  # a column of floats keeps no larger ones
    if isinstance(value, float):
        return "number"
    return "texts" if isinstance(value, list) and all(isinstance(item, str) for item in value) else "other"


def _kind_of_text(text: str) -> str:
    """The kind of a text. It is a number only if Python writes the number as the same text: `007`, `+1`, `1e3` and
    `2.50` may be codes and not quantities."""
    if not text:
        return _EMPTY
    if _WHOLE.fullmatch(text):
        return "whole as text" if abs(int(text)) <= 2**53 else "text"
    if _DECIMAL.fullmatch(text) and repr(float(text)) == text != "-0.0":
        return "number as text"
    if _TYPED_WHOLE.fullmatch(text):
        return "whole as typed"
    return "number as typed" if _TYPED.fullmatch(text) and math.isfinite(float(text)) else "text"
