"""Prints and stores the rows of measurements."""

from __future__ import annotations

import json
import os
import platform
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from bench.row import Row

RESULTS = Path(__file__).with_name("results.json")


def unmeasured(name: str, error: str) -> Row:
    """Return the row of a measure that has failed, with the error."""
    return {"measure": name, "name": name, "value": None, "error": error}


def compared(row: Row, other: Sequence[float], this: Sequence[float], *, at_most: float) -> Row:
    """Return the row with the medians of both versions. `ratio` says by how much this one is worse than the other."""
    value, yardstick = statistics.median(this), statistics.median(other)
    worse, better = (value, yardstick) if row["better"] == "less" else (yardstick, value)
    ratio = worse / better if better else float("inf")
    return {
        **row,
        "value": value,
        "yardstick": yardstick,
        "ratio": ratio,
        "goal": f"≤ {at_most:g}x",
        "met": ratio <= at_most,
        "detail": {"this": list(this), "the other": list(other)},
    }


def measured(row: Mapping[str, Any]) -> bool:
    """Return whether a row holds a figure."""
    return row["value"] is not None


# Printing


def number(value: Any) -> str:
    """Write a figure for people: three significant digits; no decimals from 1,000 on, and for whole numbers."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {number(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(number(item) for item in value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    if float(value).is_integer() and abs(value) < 1e9:
        return f"{int(value):,}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def line(row: Mapping[str, Any]) -> str:
    """Write a row in one line, which is shown while others are measured."""
    return f"{row['name']}: {number(row['value'])} {row['unit']}" if measured(row) else f"{row['name']}: not measured"


def show(rows: Sequence[Row], console: Console) -> None:
    """Print the table, the details of the rows, the goals that are missed, and what could not be measured."""
    title = f"Measured with Python {platform.python_version()} on {os.cpu_count()} processors"
    table = Table(title=title, title_justify="left", show_lines=True)
    table.add_column("what", ratio=3)
    table.add_column("decides", ratio=2)
    for heading in ("value", "yardstick", "ratio", "goal"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("met")
    for row in filter(measured, rows):
        table.add_row(*_cells(row))
    console.print(table)
    for row in rows:
        if row.get("detail"):
            console.print(f"\n[bold]{row['name']}[/bold]")
            for key, value in row["detail"].items():
                console.print(f"  {key}: {number(value)}", highlight=False, markup=False, soft_wrap=True)
    judged = [row for row in rows if row.get("met") is not None]
    missed = [row for row in judged if not row["met"]]
    console.print(f"\n[bold]Goals missed: {len(missed)} of {len(judged)}[/bold]")
    for row in missed:
        console.print(f"  {row['name']}", highlight=False, markup=False, soft_wrap=True)
    for row in rows:
        if not measured(row):
            console.print(f"\n[bold red]Not measured: {row['name']}[/bold red]")
            console.print(row["error"], highlight=False, markup=False, soft_wrap=True)


def _cells(row: Row) -> list[str]:
    met = row["met"]
    return [
        row["name"],
        row["decides"],
        f"{number(row['value'])} {row['unit']}",
        "" if row["yardstick"] is None else f"{number(row['yardstick'])} {row['unit']}",
        "" if row["ratio"] is None else f"{row['ratio']:.3g}x",
        row["goal"] or "",
        "" if met is None else "[green]yes[/green]" if met else "[yellow]no[/yellow]",
    ]


# Storing


def store(rows: Sequence[Row], file: Path = RESULTS) -> None:
    """Write the rows to the file. The rows of measures that did not run now stay."""
    names = {row["measure"] for row in rows}
    try:
        stored = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        stored = []
    others = [row for row in stored if row.get("measure") not in names]
    ordered = sorted([*others, *rows], key=lambda row: str(row["measure"]))
    file.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
