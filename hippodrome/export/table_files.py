"""Writes tables as CSV and Parquet files, in batches of rows, and converts values to the types of their columns."""

# ruff: noqa: PLC0415 - pyarrow is large, and imported when a table is written

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from hippodrome.export.scrub import clean
from hippodrome.protocol.times import time_text

BATCH = 1_000  # rows
JOIN = "; "  # between the texts of a list, in CSV
_FORMULA = re.compile("[=+\\-@\t\r\n\0\uff1d\uff0b\uff0d\uff20]")
_PLAIN_NUMBER = re.compile(r"[+-]?[0-9]+(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?")


class Column(NamedTuple):
    """A column: its name, and its Arrow type by name (`types`)."""

    name: str
    type: str = "text"


@dataclass
class Style:
    """The formats of tables. With `spreadsheet`, an apostrophe stands before each cell that a spreadsheet would run as
    a formula."""

    csv: bool = True
    parquet: bool = True
    spreadsheet: bool = False


def types() -> dict[str, Any]:
    """Return the Arrow types of columns, by the names of types in `Column`."""
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
    """Write `base`.csv and `base`.parquet, each whole or not at all, and return their paths.

    Values must have the types of their columns (`fit`); None is an empty cell.
    """
    paths = []
    with contextlib.ExitStack() as stack:
        sheet = parquet = None
        if style.csv:
            paths.append(base.with_name(f"{base.name}.csv"))
            file = stack.enter_context(_part(paths[-1]).open("w", encoding="utf-8", newline=""))
            if style.spreadsheet:
                file.write("\ufeff")  # without this mark Excel takes another encoding than UTF-8
            sheet = csv.writer(file)
            sheet.writerow([_cell(column.name, style.spreadsheet) for column in columns])
        if style.parquet:
            import pyarrow as pa
            import pyarrow.parquet as pq

            paths.append(base.with_name(f"{base.name}.parquet"))
            schema = pa.schema([(column.name, types()[column.type]) for column in columns])
            parquet = stack.enter_context(pq.ParquetWriter(_part(paths[-1]), schema, compression="zstd"))
        for batch in _batches(rows):
            if sheet:
                sheet.writerows([_cell(value, style.spreadsheet) for value in row] for row in batch)
            if parquet:
                arrays = [
                    pa.array([_typed(row[place], column.type) for row in batch], types()[column.type])
                    for place, column in enumerate(columns)
                ]
                parquet.write_table(pa.table(arrays, schema=schema))
    for path in paths:
        os.replace(_part(path), path)
    return paths


def _part(path: Path) -> Path:
    return path.with_name(f"{path.name}.part")


def _batches(rows: Iterable[Sequence[Any]]) -> Iterator[list[Sequence[Any]]]:
    batch: list[Sequence[Any]] = []
    for row in rows:
        batch.append(row)
        if len(batch) >= BATCH:
            yield batch
            batch = []
    if batch:
        yield batch


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
        return clean(value if isinstance(value, str) else json_text(value))
    return float(value) if kind == "number" and not isinstance(value, str) else value


def json_text(value: Any) -> str:
    """Return a value as compact JSON, with all characters unescaped."""
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False)
