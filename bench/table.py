"""Makes, prints and stores the rows of measurements."""

from __future__ import annotations

import json
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.table import Table

RESULTS = Path(__file__).with_name("results.json")
INFORMATION, COMPARED, BOUND = "information", "compared", "bound"  # the kinds of rows
Row = dict[str, Any]
Measure = Callable[[], Iterator[Row]]


def row(
    name: str,
    value: float,
    unit: str,
    *,
    yardstick: float | None = None,
    at_most: float | None = None,
    at_least: float | None = None,
    judge: Literal["ratio", "value"] = "ratio",
    bound: str = "",
    detail: Mapping[str, Any] | None = None,
) -> Row:
    """Return the row of one measurement.

    The goal is `at_most` or `at_least`. It is about the ratio of the value to the yardstick; without a yardstick, or if
    `judge` is "value", it is about the value.

    Only a goal about a ratio makes a row *compared*. A goal about a value makes it a *bound*, even if there is a
    yardstick; then `bound` must say whose bound it is: a promise of the documentation or a limit of AWS. A row without
    a goal is *information*. `detail` is printed below the table.

    Raises ValueError if the goal cannot be judged: if `bound` is missing, or if the yardstick of the ratio is 0.
    """
    ratio = value / yardstick if yardstick else None
    about_ratio = judge == "ratio" and yardstick is not None
    goal, met = None, None
    if at_most is not None or at_least is not None:
        if about_ratio and ratio is None:
            raise ValueError(f"{name}: the yardstick is 0, and the goal is about the ratio to it")
        if not about_ratio and not bound:
            raise ValueError(f"{name}: the row does not say whose the bound is")
        judged = ratio if about_ratio and ratio is not None else value
        if at_most is not None:
            goal, met = f"≤ {at_most:g}", judged <= at_most
        elif at_least is not None:
            goal, met = f"≥ {at_least:g}", judged >= at_least
    made: Row = {
        "name": name,
        "value": value,
        "unit": unit,
        "yardstick": yardstick,
        "ratio": ratio,
        "goal": f"{goal}x" if goal and about_ratio else goal,
        "met": met,
        "kind": INFORMATION if met is None else COMPARED if about_ratio else BOUND,
    }
    details = {**({"bound": bound} if bound else {}), **(detail or {})}
    return {**made, "detail": details} if details else made


def unmeasured(name: str, error: BaseException) -> Row:
    """Return the row of a measure that has failed, with the error."""
    why = "".join(traceback.format_exception(error)).rstrip()
    empty = dict.fromkeys(("value", "yardstick", "ratio", "goal", "met", "kind"))
    return {"name": name, "unit": "", **empty, "error": why}


def each(measures: Iterable[Measure]) -> Iterator[Row]:
    """Yield the rows of all measures. A measure that fails becomes a row with its error, and the others go on."""
    for measure in measures:
        try:
            yield from measure()
        except Exception as error:  # noqa: BLE001 - whatever the error, the other measures go on
            yield unmeasured(measure.__name__.replace("_", " "), error)


def simulated(rows: Iterable[Row]) -> Iterator[Row]:
    """Yield the rows with names that say that their figures are those of the simulation, not of AWS."""
    for found in rows:
        yield {**found, "name": f"simulated: {found['name']}"}


def measured(found: Mapping[str, Any]) -> bool:
    """Return whether a row holds a figure."""
    return found.get("value") is not None


# Printing


def number(value: Any) -> str:
    """Write a figure for people: three significant digits; no decimals from 1,000 on, and for whole numbers."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        if float(value).is_integer() and abs(value) < 1e9:
            return f"{int(value):,}"
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)


def line(found: Mapping[str, Any]) -> str:
    """Write a row in one line, which is shown while the others are measured."""
    if not measured(found):
        return f"{found.get('name')}: could not be measured"
    return f"{found['name']}: {number(found['value'])} {found['unit']}"


def show(rows: Sequence[Mapping[str, Any]], console: Console) -> None:
    """Print the table, the details of the rows, the goals that are missed, and what could not be measured."""
    table = Table(title="Measured here and now", title_justify="left")
    table.add_column("what", ratio=1)
    for heading in ("value", "yardstick", "ratio", "goal"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("kind", no_wrap=True)
    table.add_column("met")
    group = None
    for found in rows:
        if found.get("group") != group:
            table.add_section()
            group = found.get("group")
        table.add_row(*_cells(found))
    console.print(table)
    for found in rows:
        if found.get("detail"):
            console.print(f"\n[bold]{found['name']}[/bold]")
            for key, value in found["detail"].items():
                console.print(f"  {key}: {_plain(value)}", highlight=False, markup=False, soft_wrap=True)
    judged = [found for found in rows if found.get("met") is not None]
    missed = [found for found in judged if not found["met"]]
    console.print(f"\n[bold]Goals missed: {len(missed)} of {len(judged)}[/bold]")
    for found in missed:
        console.print(f"  {found['name']}", highlight=False, markup=False, soft_wrap=True)
    for found in rows:
        if not measured(found):
            console.print(f"\n[bold red]Not measured: {found.get('name')}[/bold red]")
            console.print(str(found.get("error", "no figure")), highlight=False, markup=False, soft_wrap=True)


def _cells(found: Mapping[str, Any]) -> list[str]:
    unit = str(found.get("unit") or "")
    ratio = found.get("ratio")
    met = found.get("met")
    return [
        str(found.get("name")),
        f"{number(found['value'])} {unit}".rstrip() if measured(found) else "[red]—[/red]",
        f"{number(found.get('yardstick'))} {unit}".rstrip() if found.get("yardstick") is not None else "",
        f"{ratio:.3g}x" if isinstance(ratio, int | float) else "",
        str(found.get("goal") or ""),
        str(found.get("kind") or ""),
        "" if met is None else "[green]yes[/green]" if met else "[yellow]no[/yellow]",
    ]


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_plain(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_plain(item) for item in value)
    return number(value)


# Storing


def keep(rows: Sequence[Row], file: Path = RESULTS) -> None:
    """Write the rows to the file. The rows of groups that were not measured now stay."""
    groups = {found.get("group") for found in rows}
    try:
        stored = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        stored = []
    others = [r for r in stored if isinstance(r, dict) and r.get("group") not in groups]
    ordered = sorted([*others, *rows], key=lambda found: str(found.get("group")))
    file.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
