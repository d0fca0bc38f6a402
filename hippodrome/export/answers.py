"""Makes the tables of answers: with a row per participant, or a row per field.

All rows are read from the state one at a time, so that memory does not grow with the study.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

from hippodrome.control.model.project import Project
from hippodrome.export import scrub
from hippodrome.export.design_columns import Design, assignment_in, is_answer
from hippodrome.export.keys import ASSIGNED, ENDED
from hippodrome.export.page_fields import FieldKind
from hippodrome.export.recording_columns import as_number, as_whole, when
from hippodrome.export.scrub import clean
from hippodrome.export.state import ExportedParticipant, ExportState
from hippodrome.export.table_files import Column, fit, json_text
from hippodrome.protocol.session import is_session_id

MAX_FIELDS = 1_000
"""Columns of answers. Participants can send any number of fields; the rarest ones share the column `other`."""
MAX_LINK = 50
"""Columns of the values in participants' links, and of the headers of their first requests."""
_MAX_PAGES = 100  # different pages that are counted at one step
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


class StudyAnswers:
    """All answers of a study. The constructor reads them once to find the columns; each table reads them again."""

    def __init__(
        self,
        state: ExportState,
        project: Project | None,
        apart: bool,
        page_kinds: Mapping[tuple[str, str], FieldKind] = MappingProxyType({}),
    ) -> None:
        """`page_kinds` has the kinds of the fields in the study's pages, by step and name (`page_fields`)."""
        self._state = state
        self._project = project
        self._apart = apart
        self._runs = {step.key: step for step in project.all_runs} if project else {}
        self._present_pages = {key: step.page for key, step in self._runs.items() if "{" not in step.page}
        self.design = Design.of(project)
        self.scrubbed = 0
        self.finished = 0
        self.in_sessions = False
        self.has_tries = False
        fields: dict[tuple[str, str], Field] = {}
        links: dict[str, int] = {}
        steps: set[str] = set()
        pages: dict[str, Counter[str]] = {}
        versioned = {key for key, step in self._runs.items() if step.variants}
        for participant, documents in self.all_documents():
            found = {step: document for step, document in documents.items() if is_answer(step)}
            self.has_tries = self.has_tries or any("." in step for step in documents)
            self.in_sessions = self.in_sessions or bool(participant.membership)
            for step, answers in found.items():
                steps.add(step)
                versioned |= {step} if _has_version(answers) else set()
                self._count_page(pages.setdefault(step, Counter()), step, answers)
                for name, value in _fields(answers).items():
                    new = Field(len(fields), page_kind=page_kinds.get((step, name), FieldKind.TEXT))
                    known = fields.setdefault((step, name), new)
                    known.count += 1
                    known.kinds.add(_kind(value))
            for name in scrub.columns(participant.document):
                links[name] = links.get(name, 0) + 1
            _only_common(fields)
        self.steps = self._in_order(steps)
        final = project.final.key if project else ""
        self._answerable = [step for step in self.steps if step != final or any(key[0] == final for key in fields)]
        self.versioned = [step for step in self._answerable if step in versioned]
        self.moved = [
            ChangedPage(step, page, others)
            for step, page in self._present_pages.items()
            if (others := {name: count for name, count in pages.get(step, Counter()).items() if name != page})
        ]
        commonest = sorted(fields, key=lambda key: (-fields[key].count, fields[key].place))[:MAX_FIELDS]
        order = {key: place for place, key in enumerate(page_kinds)}
        self.fields = {
            key: fields[key]
            for key in sorted(
                commonest, key=lambda key: (self.steps.index(key[0]), order.get(key, len(order)), fields[key].place)
            )
        }
        self.links = sorted(links, key=lambda name: (-links[name], name))[:MAX_LINK]
        self.crowded = len(fields) > MAX_FIELDS or len(links) > MAX_LINK

    def _participants(self) -> Iterator[tuple[ExportedParticipant, dict[str, Mapping[str, Any]]]]:
        """The participants with the documents of their answers; with `apart`, without identities."""
        for participant, documents in self.all_documents():
            yield participant, {step: found for step, found in documents.items() if is_answer(step)}

    def all_documents(self) -> Iterator[tuple[ExportedParticipant, dict[str, Mapping[str, Any]]]]:
        """Yield the participants with the documents of their answers, tries, assignment and end, by step.

        With `apart` they are without identities.
        """
        for participant, found in self._state.answers():
            if not self._apart:
                yield participant, found
                continue
            hide = scrub.Scrub(scrub.identities(participant))
            yield (
                participant,
                # An assignment and an end hold words of the study alone.
                {
                    step: document if step in (ASSIGNED, ENDED) else hide.value(document)
                    for step, document in found.items()
                },
            )
            self.scrubbed += hide.found

    def _count_page(self, counts: Counter[str], step: str, answers: Mapping[str, Any]) -> None:
        page = self._page(step, answers)
        if page is not None and (page in counts or len(counts) < _MAX_PAGES):
            counts[page] += 1

    def _page(self, step: str, answers: Mapping[str, Any]) -> str | None:
        """The page that a step's answer came from. All versions of the present page count as one."""
        page = answers.get("page")
        if not isinstance(page, str):
            return None
        present = self._present_pages.get(step, "")
        return present if present and present in (page, _VERSION.sub("", page)) else clean(page)

    def _in_order(self, steps: set[str]) -> list[str]:
        """All steps in the study's order; steps that the study does not have any more come last."""
        known = list(self._runs)
        rest = sorted(steps - set(known), key=lambda step: (not step.isdigit(), step.zfill(64)))
        return [*known, *rest]

    def _finished(self, found: Mapping[str, Any]) -> bool | None:
        """Whether every step before the last has an answer; None if the study's steps are not known."""
        if self._project is None:
            return None
        own = self._project.own(assignment_in(found))
        return ENDED not in found and all(step.key in found for step in own.steps[:-1])

    def label(self, step: str) -> str:
        """Return the name of a step in columns: `trust.cec` for the run `trust-cec`."""
        run = self._runs.get(step)
        return ".".join((run.name, *run.levels.values())) if run and run.name else step

    @property
    def columns(self) -> list[Column]:
        """The columns of the wide table."""
        return _distinct(
            Column("participant"),
            Column("group", "whole"),
            Column("arrived", "time"),
            Column("finished", "truth"),
            *self.design.columns,
            *(_MEMBERSHIP if self.in_sessions else ()),
            *([] if self._apart else [Column("completionCode")]),
            *([] if self._apart else [Column(clean(name)) for name in self.links]),
            *(Column(f"{self.label(step)}.{clean(name)}", found.type) for (step, name), found in self.fields.items()),
            *(Column(f"page.{moved.step}") for moved in self.moved),
            *(Column(f"group.{step}", "whole") for step in self.versioned),
            *(Column(f"answered.{self.label(step)}", "time") for step in self._answerable),
            *([Column("other")] if self.crowded else []),
        )

    def rows(self) -> Iterator[list[Any]]:
        """Yield the rows of the wide table: one per participant."""
        self.scrubbed = self.finished = 0
        for participant, documents in self.all_documents():
            found = {step: document for step, document in documents.items() if is_answer(step)}
            fields = {step: _fields(answers) for step, answers in found.items()}
            link = scrub.columns(participant.document)
            finished = self._finished(documents)
            self.finished += bool(finished)
            row: list[Any] = [
                participant.number,
                as_whole(participant.document.get("group")),
                when(participant.document.get("arrived")),
                finished,
                *self.design.values(documents, finished),
            ]
            row += _membership(participant) if self.in_sessions else ()
            if not self._apart:
                row.append(scrub.completion_code(participant))
                row += [clean(link[name]) if name in link else None for name in self.links]
            row += [
                fit(fields[step][name], column.type) if name in fields.get(step, ()) else None
                for (step, name), column in self.fields.items()
            ]
            row += [self._page(step, found[step]) if step in found else None for step, _, _ in self.moved]
            row += [as_whole(found[step].get("group")) if step in found else None for step in self.versioned]
            row += [when(found[step].get("answered")) if step in found else None for step in self._answerable]
            if self.crowded:
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
        return clean(json_text(rest)) if rest else None

    LONG = (
        Column("participant"),
        Column("step"),
        Column("page"),
        Column("group", "whole"),
        Column("answered", "time"),
        Column("field"),
        Column("value"),
    )

    def long_rows(self) -> Iterator[list[Any]]:
        """Yield the rows of the long table: one per value that was sent, and one for each text of a list."""
        order = {step: place for place, step in enumerate(self.steps)}
        for participant, found in self._participants():
            for step in sorted(found, key=lambda step: order[step]):
                answers = found[step]
                page = answers.get("page")
                fixed = [
                    participant.number,
                    step,
                    clean(page) if isinstance(page, str) else None,
                    as_whole(answers.get("group")),
                    when(answers.get("answered")),
                ]
                for name, value in _fields(answers).items():
                    values = value if isinstance(value, list) and _kind(value) == "texts" else [value]
                    for one in values:
                        yield [*fixed, clean(name), fit(one, "text")]


_MEMBERSHIP = (Column("session"), Column("seat", "whole"), Column("unmatched", "truth"), Column("waited", "number"))


def _membership(participant: ExportedParticipant) -> list[Any]:
    """The participant's session and seat, whether they were unmatched, and the seconds for which they waited."""
    about = participant.membership
    session = about.get("session") if is_session_id(about.get("session")) else None
    seat, waited, unmatched = as_whole(about.get("seat")), as_number(about.get("waited")), about.get("unmatched")
    return [
        session,
        seat if session is not None and seat is not None and seat >= 0 else None,
        unmatched if isinstance(unmatched, bool) else None,
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


def _only_common(fields: dict[tuple[str, str], Field]) -> None:
    """Drop the rarest fields if there are too many: participants can send any fields. They go into `other`."""
    if len(fields) > _MAX_COUNTED:
        rarest = sorted(fields, key=lambda key: fields[key].count)[: _MAX_COUNTED // 2]
        for key in rarest:
            del fields[key]
