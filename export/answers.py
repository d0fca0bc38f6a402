"""The tables of answers: a row per participant, or per field.

Everything is read from the state a row at a time, so that memory does not grow with the study.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

from export import scrub
from export.page_fields import FieldKind
from export.recording_columns import when
from export.scrub import clean, texts
from export.state import ExportedParticipant, ExportState
from export.table_files import Column, fit, json_text
from hippodrome.model.project import Project
from protocol.session import is_session_id

MAX_FIELDS = (
    1_000  # columns of answers; of more fields (every participant can send some) the rarest share the column `other`
)
MAX_LINK = 50  # columns of what links carried
_MAX_PAGES = 100  # pages that are counted at one step
_MAX_COUNTED = 50_000  # fields that are counted at once


@dataclass
class Field:
    """What one field's answers are like."""

    place: int  # the order of appearance
    count: int = 0
    kinds: set[str] = field(default_factory=set)
    asked: FieldKind = FieldKind.TEXT  # what the page says that it sends

    @property
    def type(self) -> str:
        """The narrowest type that holds them all; else text, with JSON for what is none."""
        numbers = {*_SENT_NUMBERS, *_TYPED_NUMBERS} if self.asked is FieldKind.NUMBER else {*_SENT_NUMBERS}
        if self.kinds <= {*numbers, _EMPTY} and (self.kinds != {_EMPTY} or self.asked is FieldKind.NUMBER):
            return "number" if self.kinds & {"number as text", "number as typed"} else "whole"
        kinds = {"text" if kind in (*_SENT_NUMBERS, *_TYPED_NUMBERS, _EMPTY) else kind for kind in self.kinds}
        if "other" in kinds:
            return "text"
        if "texts" in kinds or (self.asked is FieldKind.LIST and kinds == {"text"}):
            return "texts" if kinds <= {"text", "texts"} else "text"
        if kinds == {"whole", "number"}:
            return "number"
        return next(iter(kinds)) if len(kinds) == 1 else "text"


class Moved(NamedTuple):
    """A step with answers from another page than it has now: the study's steps were changed while people took part."""

    step: str
    page: str  # the one that it has now
    others: Mapping[str, int]  # of each other page, how many answers came from it


class StudyAnswers:
    """All answers of a study. Made by one pass that finds the columns; the tables are further passes."""

    def __init__(
        self,
        state: ExportState,
        project: Project | None,
        apart: bool,
        asked: Mapping[tuple[str, str], FieldKind] = MappingProxyType({}),
    ) -> None:
        """`asked` is what the study's pages say of their fields (`page_fields`), by step and name."""
        self._state = state
        self._project = project
        self._apart = apart
        self._now = {step.key: step.page for step in project.steps} if project else {}
        self.scrubbed = 0
        self.finished = 0
        self.in_sessions = False
        fields: dict[tuple[str, str], Field] = {}
        links: dict[str, int] = {}
        steps: set[str] = set()
        pages: dict[str, Counter[str]] = {}
        for participant, found in self._participants():
            self.in_sessions = self.in_sessions or bool(participant.membership)
            for step, answers in found.items():
                steps.add(step)
                self._count_page(pages.setdefault(step, Counter()), step, answers)
                for name, value in _fields(answers).items():
                    new = Field(len(fields), asked=asked.get((step, name), FieldKind.TEXT))
                    seen = fields.setdefault((step, name), new)
                    seen.count += 1
                    seen.kinds.add(_kind(value))
            for name in texts(participant.document.get("link")):
                links[name] = links.get(name, 0) + 1
            _only_common(fields)
        self.steps = self._in_order(steps)
        self.moved = [
            Moved(step, page, others)
            for step, page in self._now.items()
            if (others := {name: count for name, count in pages.get(step, Counter()).items() if name != page})
        ]
        widest = sorted(fields, key=lambda key: (-fields[key].count, fields[key].place))[:MAX_FIELDS]
        order = {key: place for place, key in enumerate(asked)}
        self.fields = {
            key: fields[key]
            for key in sorted(
                widest, key=lambda key: (self.steps.index(key[0]), order.get(key, len(order)), fields[key].place)
            )
        }
        self.links = sorted(links, key=lambda name: (-links[name], name))[:MAX_LINK]
        self.crowded = len(fields) > MAX_FIELDS or len(links) > MAX_LINK

    def _participants(self) -> Iterator[tuple[ExportedParticipant, dict[str, Mapping[str, Any]]]]:
        """Everybody, with their documents as they may be shown."""
        for participant, found in self._state.answers():
            if not self._apart:
                yield participant, found
                continue
            hide = scrub.Scrub(scrub.identities(participant))
            yield participant, {step: hide.value(answers) for step, answers in found.items()}
            self.scrubbed += hide.found

    def _count_page(self, seen: Counter[str], step: str, answers: Mapping[str, Any]) -> None:
        page = self._page(step, answers)
        if page is not None and (page in seen or len(seen) < _MAX_PAGES):
            seen[page] += 1

    def _page(self, step: str, answers: Mapping[str, Any]) -> str | None:
        """The page that a step's answer came from; the versions for groups of the page that it has now count as one."""
        page = answers.get("page")
        if not isinstance(page, str):
            return None
        now = self._now.get(step, "")
        return now if now and now in (page, _VERSION.sub("", page)) else clean(page)

    def _in_order(self, steps: set[str]) -> list[str]:
        """In the study's order; steps that it does not have (any more) come last."""
        known = [step.key for step in self._project.steps] if self._project else []
        rest = sorted(steps - set(known), key=lambda step: (not step.isdigit(), step.zfill(64)))
        return [*known, *rest]

    def _finished(self, found: Mapping[str, Any]) -> bool | None:
        """Whether every step before the last has an answer; not known without the study."""
        return all(step.key in found for step in self._project.steps[:-1]) if self._project else None

    @property
    def columns(self) -> list[Column]:
        """The columns of the wide table."""
        shown = [step for step in self.steps if not (self._project and step == self._project.final.key)]
        return _distinct(
            Column("participant"),
            Column("group", "whole"),
            Column("arrived", "time"),
            Column("finished", "truth"),
            *(_MEMBERSHIP if self.in_sessions else ()),
            *([] if self._apart else [Column("completionCode")]),
            *([] if self._apart else [Column(f"link.{clean(name)}") for name in self.links]),
            *(Column(f"{step}.{clean(name)}", found.type) for (step, name), found in self.fields.items()),
            *(Column(f"page.{moved.step}") for moved in self.moved),
            *(Column(f"answered.{step}", "time") for step in shown),
            *([Column("other")] if self.crowded else []),
        )

    def rows(self) -> Iterator[list[Any]]:
        """The wide table: one row per participant."""
        shown = [step for step in self.steps if not (self._project and step == self._project.final.key)]
        self.scrubbed = self.finished = 0
        for participant, found in self._participants():
            fields = {step: _fields(answers) for step, answers in found.items()}
            link = texts(participant.document.get("link"))
            finished = self._finished(found)
            self.finished += bool(finished)
            row: list[Any] = [
                participant.number,
                _group(participant.document),
                when(participant.document.get("arrived")),
                finished,
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
            row += [when(found[step].get("answered")) if step in found else None for step in shown]
            if self.crowded:
                row.append(self._rest(fields, {} if self._apart else link))
            yield row

    def _rest(self, fields: Mapping[str, Mapping[str, Any]], link: Mapping[str, str]) -> str | None:
        """What has no column, as JSON."""
        rest = {
            f"{step}.{name}": value
            for step, named in fields.items()
            for name, value in named.items()
            if (step, name) not in self.fields
        }
        rest |= {f"link.{name}": value for name, value in link.items() if name not in self.links}
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
        """The long table: one row per text that was sent; of a list one for each."""
        order = {step: place for place, step in enumerate(self.steps)}
        for participant, found in self._participants():
            for step in sorted(found, key=lambda step: order[step]):
                answers = found[step]
                page = answers.get("page")
                fixed = [
                    participant.number,
                    step,
                    clean(page) if isinstance(page, str) else None,
                    _group(answers),
                    when(answers.get("answered")),
                ]
                for name, value in _fields(answers).items():
                    values = value if isinstance(value, list) and _kind(value) == "texts" else [value]
                    for one in values:
                        yield [*fixed, clean(name), fit(one, "text")]


_MEMBERSHIP = (Column("session"), Column("seat", "whole"), Column("unmatched", "truth"), Column("waited", "number"))


def _membership(participant: ExportedParticipant) -> list[Any]:
    """In which session a participant plays and at which seat, or that in none; seconds that they waited for others."""
    about = participant.membership
    session, seat, unmatched = about.get("session"), about.get("seat"), about.get("unmatched")
    fits = isinstance(seat, int) and not isinstance(seat, bool) and seat >= 0 and is_session_id(session)
    truth = unmatched if isinstance(unmatched, bool) else None
    waited = about.get("waited")
    number = waited if isinstance(waited, int | float) and not isinstance(waited, bool) and waited >= 0 else None
    return [session if is_session_id(session) else None, seat if fits else None, truth, number]


def _distinct(*columns: Column) -> list[Column]:
    """No two columns by one name: hostile names may become the same when they are made fit for UTF-8."""
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


def _fields(answers: Mapping[str, Any]) -> Mapping[str, Any]:
    """The fields of an answer's document; those without a value are not there."""
    found = answers.get("answers")
    return {str(n): value for n, value in found.items() if value is not None} if isinstance(found, dict) else {}


def _group(document: Mapping[str, Any]) -> int | None:
    group = document.get("group")
    fits = isinstance(group, int) and not isinstance(group, bool) and abs(group) < 2**63
    return group if fits else None


_SENT_NUMBERS = ("whole as text", "number as text")
_TYPED_NUMBERS = ("whole as typed", "number as typed")
"""Such as 07 and 2.50: numbers if a field for numbers has sent them, and perhaps codes if another has."""
_EMPTY = "empty text"
_TYPED_WHOLE = re.compile(r"-?[0-9]{1,15}", re.ASCII)
_TYPED = re.compile(r"-?(?:[0-9]{1,15}(?:\.[0-9]{1,17})?|\.[0-9]{1,17})(?:[eE][+-]?[0-9]{1,3})?", re.ASCII)
"""HTML's "valid floating-point number", which a field for numbers sends; those with more digits stay texts."""
_VERSION = re.compile(r"-[0-9]+\Z", re.ASCII)  # of a page for a group
_WHOLE = re.compile(r"-?[1-9][0-9]{0,15}|0", re.ASCII)
_DECIMAL = re.compile(r"-?[0-9]{1,16}\.[0-9]{1,17}", re.ASCII)


def _kind(value: Any) -> str:
    if isinstance(value, str):
        return _kind_of_text(value)
    if isinstance(value, bool):
        return "truth"
    if isinstance(value, int):
        return "whole" if -(2**53) <= value <= 2**53 else "other"  # a column may become one of floats
    if isinstance(value, float):
        return "number"
    return "texts" if isinstance(value, list) and all(isinstance(item, str) for item in value) else "other"


def _kind_of_text(text: str) -> str:
    """Forms send texts. A text is a number only if the number, written by Python, is that very text again: `007`,
    `+1`, `1e3` and `2.50` stay texts, because they may be codes and not quantities."""
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
    """Forget the rarest if there are too many: they come from a participant's requests, and end in `other`."""
    if len(fields) > _MAX_COUNTED:
        rarest = sorted(fields, key=lambda key: fields[key].count)[: _MAX_COUNTED // 2]
        for key in rarest:
            del fields[key]
