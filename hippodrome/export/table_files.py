"""Writes tables as CSV and Parquet files, in batches of rows, and converts values to the types of their columns."""

# ruff: noqa: PLC0415 - pyarrow is large, and imported when a table is written

from __future__ import annotations

import contextlib
import csv
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from hippodrome.export.records import Record
from hippodrome.export.scrub import clean
from hippodrome.export.values import json_text
from hippodrome.protocol.times import time_text

BATCH = 1_000  # rows
JOIN = "; "  # between the texts of a list, in CSV
_FORMULA = re.compile("[=+\\-@\t\r\n\0\uff1d\uff0b\uff0d\uff20]")
_PLAIN_NUMBER = re.compile(r"[+-]?[0-9]+(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?")


class Column(NamedTuple):
    """A column: its name, and its Arrow type by name (`_types`)."""

    name: str
    type: str = "text"


def as_columns(names: str) -> tuple[Column, ...]:
    """Return columns with these names; after a colon stands the type of one that has no texts."""
    return tuple(Column(*name.split(":")) for name in names.split())


@dataclass
class Style:
    """The formats of tables. With `spreadsheet`, an apostrophe stands before each cell that a spreadsheet would run as
    a formula."""

    csv: bool = True
    parquet: bool = True
    spreadsheet: bool = False


def _types() -> dict[str, Any]:
    """The Arrow types of columns, by the names of types in `Column`."""
    import pyarrow as pa

    return {
        "text": pa.string(),
        "texts": pa.list_(pa.string()),
        "whole": pa.int64(),
        "number": pa.float64(),
        "truth": pa.bool_(),
        "time": pa.timestamp("us", tz="UTC"),
    }


class Table:
    """A table. It sees all records before it is asked for its columns, and then for the rows of one after the other."""

    name: str
    needed = True  # whether the table is written

    @property
    def columns(self) -> Sequence[Column]:
        """The columns, once all records were seen."""
        raise NotImplementedError

    def see(self, record: Record) -> None:
        """Look at what the columns depend on."""

    def rows(self, record: Record) -> Iterator[Sequence[Any]]:
        """Yield the rows of a participant or session."""
        raise NotImplementedError


class TableFile:
    """`base`.csv and `base`.parquet while they are written. Each appears whole, or not at all after an error."""

    def __init__(self, base: Path, columns: Sequence[Column], style: Style) -> None:
        self.paths: list[Path] = []
        self._columns, self._style = columns, style
        self._rows: list[Sequence[Any]] = []
        self._files = contextlib.ExitStack()
        self._sheet = self._parquet = None
        if style.csv:
            file = self._files.enter_context(self._part(base, "csv").open("w", encoding="utf-8", newline=""))
            if style.spreadsheet:
                file.write("\ufeff")  # without this mark Excel takes another encoding than UTF-8
            self._sheet = csv.writer(file)
            self._sheet.writerow([_cell(column.name, style.spreadsheet) for column in columns])
        if style.parquet:
            import pyarrow as pa
            import pyarrow.parquet as pq

            types = _types()
            self._schema = pa.schema([(column.name, types[column.type]) for column in columns])
            part = self._part(base, "parquet")
            self._parquet = self._files.enter_context(pq.ParquetWriter(part, self._schema, compression="zstd"))

    def _part(self, base: Path, suffix: str) -> Path:
        self.paths.append(base.with_name(f"{base.name}.{suffix}"))
        return _part(self.paths[-1])

    def add(self, rows: Iterable[Sequence[Any]]) -> None:
        """Add rows, whose values have the types of their columns (`fit`); None is an empty cell."""
        for row in rows:
            self._rows.append(row)
            if len(self._rows) >= BATCH:
                self._write()

    def _write(self) -> None:
        if self._sheet:
            self._sheet.writerows([_cell(value, self._style.spreadsheet) for value in row] for row in self._rows)
        if self._parquet:
            import pyarrow as pa

            arrays = [
                pa.array([_typed(row[place], column.type) for row in self._rows], self._schema.types[place])
                for place, column in enumerate(self._columns)
            ]
            self._parquet.write_table(pa.table(arrays, schema=self._schema))
        self._rows = []

    def __enter__(self) -> TableFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with self._files:
            if self._rows and kind is None:
                self._write()
        for path in self.paths if kind is None else ():
            os.replace(_part(path), path)


def _part(path: Path) -> Path:
    return path.with_name(f"{path.name}.part")


def _cell(value: Any, spreadsheet: bool) -> str:
    """A value as text in CSV: a list is joined, a time is written as in documents, and None is an empty cell."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, datetime):
        return time_text(value)
    if isinstance(value, list):
        value = JOIN.join(value)
    if isinstance(value, str) and spreadsheet and _FORMULA.match(value) and not _PLAIN_NUMBER.fullmatch(value):
        return f"'{value}"
    return str(value)


def _typed(value: Any, kind: str) -> Any:
    """A value for a column of Parquet: in a column of numbers, the text of a form becomes a number."""
    if not isinstance(value, str) or kind not in _FROM_TEXT:
        return value
    return _FROM_TEXT[kind](value) if value else None


_FROM_TEXT: Mapping[str, Callable[[str], Any]] = {"whole": int, "number": float}


def fit(value: Any, kind: str) -> Any:
    """Return a value for a column of this type. Texts that are numbers stay texts: CSV has what was sent, and for
    Parquet `_typed` converts them."""
    if kind == "texts":
        return [clean(item) for item in (value if isinstance(value, list) else [value])]
    if kind == "text":
        return clean(value) if isinstance(value, str) else json_text(value)
    return float(value) if kind == "number" and not isinstance(value, str) else value
