"""The tables: answers (a row per participant, or per field), episodes, identities and problems, as CSV and Parquet.

Everything is read from the state a row at a time and written as it comes, so that memory does not grow with the study.
"""

# ruff: noqa: PLC0415 - pyarrow is large, and imported when a table is written

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from export import scrub
from export.recording import MOST_PLAYERS, when
from export.scrub import clean, texts
from export.state import Person, State
from hippodrome.model.project import Project

MAX_FIELDS = (
    1_000  # columns of answers; of more fields (every participant can send some) the rarest share the column `other`
)
MAX_LINK = 50  # columns of what links carried
_MAX_COUNTED = 50_000  # fields that are counted at once
_BATCH = 1_000  # rows
JOIN = "; "  # between the texts of a list, in CSV
_FORMULA = re.compile("[=+\\-@\t\r\n\0\uff1d\uff0b\uff0d\uff20]")
_PLAIN_NUMBER = re.compile(r"[+-]?[0-9]+(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?")


class Column(NamedTuple):
    """A column: its name, and its Arrow type by name (`types`)."""

    name: str
    type: str = "text"


@dataclass
class Style:
    """How tables are written. `spreadsheet`: cells that a spreadsheet would run as formulas get an apostrophe."""

    csv: bool = True
    parquet: bool = True
    spreadsheet: bool = False


# Writing


def types() -> dict[str, Any]:
    """The Arrow types of columns."""
    import pyarrow as pa

    return {
        "text": pa.string(),
        "texts": pa.list_(pa.string()),
        "whole": pa.int64(),
        "number": pa.float64(),
        "truth": pa.bool_(),
        "time": pa.timestamp("us", tz="UTC"),
    }


def write(base: Path, columns: Sequence[Column], rows: Iterable[Sequence[Any]], style: Style) -> list[Path]:
    """Write `base`.csv and `base`.parquet, whole or not at all. Values fit their columns; None is nothing."""
    made = []
    with contextlib.ExitStack() as stack:
        sheet = parquet = None
        if style.csv:
            made.append(base.with_name(f"{base.name}.csv"))
            file = stack.enter_context(_part(made[-1]).open("w", encoding="utf-8", newline=""))
            if style.spreadsheet:
                file.write("\ufeff")  # or Excel takes it for another encoding
            sheet = csv.writer(file)
            sheet.writerow([_cell(column.name, style.spreadsheet) for column in columns])
        if style.parquet:
            import pyarrow as pa
            import pyarrow.parquet as pq

            made.append(base.with_name(f"{base.name}.parquet"))
            schema = pa.schema([(column.name, types()[column.type]) for column in columns])
            parquet = stack.enter_context(pq.ParquetWriter(_part(made[-1]), schema, compression="zstd"))
        for batch in _batches(rows):
            if sheet:
                sheet.writerows([_cell(value, style.spreadsheet) for value in row] for row in batch)
            if parquet:
                arrays = [
                    pa.array([_typed(row[place], column.type) for row in batch], types()[column.type])
                    for place, column in enumerate(columns)
                ]
                parquet.write_table(pa.table(arrays, schema=schema))
    for path in made:
        os.replace(_part(path), path)
    return made


def _part(path: Path) -> Path:
    return path.with_name(f"{path.name}.part")


def _batches(rows: Iterable[Sequence[Any]]) -> Iterator[list[Sequence[Any]]]:
    batch: list[Sequence[Any]] = []
    for row in rows:
        batch.append(row)
        if len(batch) >= _BATCH:
            yield batch
            batch = []
    if batch:
        yield batch


def _cell(value: Any, spreadsheet: bool) -> str:
    """A value in CSV: a list joined, a time as in the records, nothing as an empty cell."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, datetime):
        return value.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    if isinstance(value, list):
        value = JOIN.join(value)
    if isinstance(value, str) and spreadsheet and _FORMULA.match(value) and not _PLAIN_NUMBER.fullmatch(value):
        return f"'{value}"
    return str(value)


def _typed(value: Any, kind: str) -> Any:
    """A value as Parquet's column holds it: in a column of numbers, a text that a form has sent becomes its number."""
    if not isinstance(value, str) or kind not in _FROM_TEXT:
        return value
    return _FROM_TEXT[kind](value) if value else None


_FROM_TEXT: Mapping[str, Callable[[str], Any]] = {"whole": int, "number": float}


# Answers


@dataclass
class Field:
    """What one field's answers are like."""

    place: int  # the order of appearance
    count: int = 0
    kinds: set[str] = field(default_factory=set)

    @property
    def type(self) -> str:
        """The narrowest type that holds them all; else text, with JSON for what is none."""
        if self.kinds <= {*_SENT_NUMBERS, _EMPTY} and self.kinds != {_EMPTY}:
            return "number" if "number as text" in self.kinds else "whole"
        kinds = {"text" if kind in (*_SENT_NUMBERS, _EMPTY) else kind for kind in self.kinds}
        if "other" in kinds:
            return "text"
        if "texts" in kinds:
            return "texts" if kinds <= {"text", "texts"} else "text"
        if kinds == {"whole", "number"}:
            return "number"
        return next(iter(kinds)) if len(kinds) == 1 else "text"


class Answers:
    """All answers of a study. Made by one pass that finds the columns; the tables are further passes."""

    def __init__(self, state: State, project: Project | None, apart: bool) -> None:
        self._state = state
        self._project = project
        self._apart = apart
        self.scrubbed = 0
        self.finished = 0
        fields: dict[tuple[str, str], Field] = {}
        links: dict[str, int] = {}
        steps: set[str] = set()
        for person, found in self._people():
            for step, answers in found.items():
                steps.add(step)
                for name, value in _fields(answers).items():
                    seen = fields.setdefault((step, name), Field(len(fields)))
                    seen.count += 1
                    seen.kinds.add(_kind(value))
            for name in texts(person.document.get("link")):
                links[name] = links.get(name, 0) + 1
            _only_common(fields)
        self.steps = self._in_order(steps)
        widest = sorted(fields, key=lambda key: (-fields[key].count, fields[key].place))[:MAX_FIELDS]
        self.fields = {
            key: fields[key] for key in sorted(widest, key=lambda key: (self.steps.index(key[0]), fields[key].place))
        }
        self.links = sorted(links, key=lambda name: (-links[name], name))[:MAX_LINK]
        self.crowded = len(fields) > MAX_FIELDS or len(links) > MAX_LINK

    def _people(self) -> Iterator[tuple[Person, dict[str, Mapping[str, Any]]]]:
        """Everybody, with their documents as they may be shown."""
        for person, found in self._state.answers():
            if not self._apart:
                yield person, found
                continue
            hide = scrub.Scrub(scrub.identities(person.user, person.number, person.document))
            yield person, {step: hide.value(answers) for step, answers in found.items()}
            self.scrubbed += hide.found

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
            *([] if self._apart else [Column("completionCode")]),
            *([] if self._apart else [Column(f"link.{clean(name)}") for name in self.links]),
            *(Column(f"{step}.{clean(name)}", found.type) for (step, name), found in self.fields.items()),
            *(Column(f"answered.{step}", "time") for step in shown),
            *([Column("other")] if self.crowded else []),
        )

    def rows(self) -> Iterator[list[Any]]:
        """The wide table: one row per participant."""
        shown = [step for step in self.steps if not (self._project and step == self._project.final.key)]
        self.scrubbed = self.finished = 0
        for person, found in self._people():
            fields = {step: _fields(answers) for step, answers in found.items()}
            link = texts(person.document.get("link"))
            finished = self._finished(found)
            self.finished += bool(finished)
            row: list[Any] = [person.number, _group(person.document), when(person.document.get("arrived")), finished]
            if not self._apart:
                code = person.document.get("completionCode")
                row.append(clean(code) if isinstance(code, str) else None)
                row += [clean(link[name]) if name in link else None for name in self.links]
            row += [
                fit(fields[step][name], column.type) if name in fields.get(step, ()) else None
                for (step, name), column in self.fields.items()
            ]
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
        return clean(_json(rest)) if rest else None

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
        for person, found in self._people():
            for step in sorted(found, key=lambda step: order[step]):
                answers = found[step]
                page = answers.get("page")
                fixed = [
                    person.number,
                    step,
                    clean(page) if isinstance(page, str) else None,
                    _group(answers),
                    when(answers.get("answered")),
                ]
                for name, value in _fields(answers).items():
                    values = value if isinstance(value, list) and _kind(value) == "texts" else [value]
                    for one in values:
                        yield [*fixed, clean(name), fit(one, "text")]


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
_EMPTY = "empty text"
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
    return "text"


def fit(value: Any, kind: str) -> Any:
    """A value as its column holds it; texts that are numbers stay as they were sent (`_typed`)."""
    if kind == "texts":
        return [clean(item) for item in (value if isinstance(value, list) else [value])]
    if kind == "text":
        return clean(value if isinstance(value, str) else _json(value))
    return float(value) if kind == "number" and not isinstance(value, str) else value


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False)


def _only_common(fields: dict[tuple[str, str], Field]) -> None:
    """Forget the rarest if there are too many: they come from a participant's requests, and end in `other`."""
    if len(fields) > _MAX_COUNTED:
        rarest = sorted(fields, key=lambda key: fields[key].count)[: _MAX_COUNTED // 2]
        for key in rarest:
            del fields[key]


# The others


EPISODES = (
    Column("participant"),
    Column("step"),
    Column("attempt", "whole"),
    Column("trial"),
    Column("episode", "whole"),
    Column("seed", "whole"),
    Column("frames", "whole"),
    Column("score", "number"),
    Column("why"),
    Column("started", "time"),
    Column("ended", "time"),
    Column("file"),
)


def players(state: State) -> tuple[str, ...]:
    """Everyone who plays in some episode; none if no game has several players."""
    names = (name for _, _, found in state.episodes() for name in (*found.get("players", ()), *found.get("scores", ())))
    return tuple(dict.fromkeys(names))[:MOST_PLAYERS]


def of_episodes(players: Sequence[str]) -> list[Column]:
    """The columns of `episodes`."""
    who = (Column(f"player.{clean(name)}") for name in players)
    return [*EPISODES, *who, *(Column(f"score.{clean(name)}", "number") for name in players)]


def episodes(state: State, players: Sequence[str]) -> Iterator[list[Any]]:
    """One row per episode: its outcome, where its frames are, and of each player who played it and its score."""
    for person, path, found in state.episodes():
        yield [
            person.number,
            found["step"],
            found["attempt"],
            *(clean(value) if isinstance(value := found[name], str) else None for name in ("trial",)),
            found["episode"],
            found["seed"],
            found["frames"],
            found["score"],
            clean(found["why"]) if found["why"] is not None else None,
            when(found["started"]),
            when(found["ended"]),
            path,
            *(None if (who := found.get("players", {}).get(name)) is None else clean(who) for name in players),
            *(found.get("scores", {}).get(name) for name in players),
        ]


CALLBACKS = (
    Column("participant"),
    Column("studyStep"),
    Column("attempt", "whole"),
    Column("trial"),
    Column("episode", "whole"),
    Column("step", "whole"),
    Column("time", "time"),
    Column("callback"),
    Column("name"),
    Column("value"),
    Column("error"),
    Column("skipped", "whole"),
    Column("file"),
)


def callbacks(state: State, folder: Path) -> Iterator[list[Any]]:
    """One row per line that a callback of the agent left. `folder` holds the converted recordings."""
    import pyarrow.parquet as pq

    wanted = ["kind", "trial", "episode", "step", "time", "error", "other"]
    for path, several in groupby(state.episodes(), lambda row: row[1]):
        rows = list(several)
        if not any(found.get("callbacks") for _, _, found in rows):
            continue
        person, _, first = rows[0]
        with pq.ParquetFile(folder / path) as file:
            for batch in file.iter_batches(batch_size=_BATCH, columns=wanted):
                for row in batch.to_pylist():
                    if row["kind"] == "callback":
                        yield [person.number, first["step"], first["attempt"], *_callback(row), path]


def _callback(row: Mapping[str, Any]) -> list[Any]:
    """From `trial` to `skipped`. What the recording's line has beside its common fields is JSON in `other`."""
    try:
        more = json.loads(row["other"] or "{}")
    except ValueError:  # no JSON any more, once an id was taken out
        more = {"value": row["other"]}
    value, skipped = more.get("value"), more.get("skipped")
    return [
        None if row["trial"] is None else clean(row["trial"]),
        row["episode"],
        row["step"],
        row["time"],
        *(clean(more[name]) if isinstance(more.get(name), str) else None for name in ("callback", "name")),
        None if value is None else fit(value, "text"),
        None if row["error"] is None else clean(row["error"]),
        skipped if isinstance(skipped, int) else None,
    ]


def identities(state: State, links: Sequence[str]) -> tuple[list[Column], Iterator[list[Any]]]:
    """The table of identities, which is kept apart."""
    columns = [Column("participant"), Column("userId"), Column("completionCode")]
    columns += [Column(f"link.{clean(name)}") for name in links]

    def rows() -> Iterator[list[Any]]:
        for person in state.people():
            link = texts(person.document.get("link"))
            code = person.document.get("completionCode")
            yield [
                person.number,
                person.user,
                clean(code) if isinstance(code, str) else None,
                *(clean(link[name]) if name in link else None for name in links),
            ]

    return columns, rows()


PROBLEMS = (Column("participant"), Column("file"), Column("problem"))


def problems(state: State, project: str, apart: bool) -> Iterator[list[Any]]:
    """What could not be read as it should be, with the file's key; without ids where they are apart."""
    for person, key, problem in state.problems():
        shown = key.removeprefix(f"{project}/users/")
        if apart:
            shown = _without_ids(shown, person, project)
        yield [person.number if person else None, clean(shown), problem]


def _without_ids(key: str, person: Person | None, project: str) -> str:
    """A key without ids: known parts stay, others are left out."""
    if person is None:
        return "(somewhere in users/)"
    parts = key.split("/")
    match parts[1:]:
        case ["participant.json"]:
            rest = "participant.json"
        case ["answers", name] if re.fullmatch(r"[A-Za-z0-9_-]{1,64}\.json", name) and name != f"{person.user}.json":
            rest = f"answers/{name}"
        case ["trials", _, name] if re.fullmatch(r"[A-Za-z0-9_-]{1,64}-(?:trial|episode)[0-9-]*\.jsonl\.gz", name):
            rest = f"trials/(server)/{name}"
        case _:
            rest = "(another file)"
    hide = scrub.Scrub(scrub.identities(person.user, person.number, person.document))
    return f"{person.number}/{hide.text(rest)}"
