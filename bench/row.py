"""Makes the row of a measurement."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

Row = dict[str, Any]


def row(
    name: str,
    value: float,
    unit: str,
    *,
    decides: str,
    yardstick: float | None = None,
    at_most: float | None = None,
    at_least: float | None = None,
    better: Literal["less", "more"] | None = "less",
    detail: Mapping[str, Any] | None = None,
) -> Row:
    """Return the row of one measurement.

    `decides` says who notices the figure, or what one decides by it. The goal is `at_most` or `at_least`: about the
    ratio of the value to the yardstick, or about the value if there is no yardstick. `better` says which of two
    versions is the better one; None: the figure compares none. `detail` is printed below the table.
    """
    judged = value if yardstick is None else value / yardstick
    unit_of_goal = "" if yardstick is None else "x"
    goal, met = None, None
    if at_most is not None:
        goal, met = f"≤ {at_most:g}{unit_of_goal}", judged <= at_most
    elif at_least is not None:
        goal, met = f"≥ {at_least:g}{unit_of_goal}", judged >= at_least
    return {
        "name": name,
        "value": value,
        "unit": unit,
        "yardstick": yardstick,
        "ratio": None if yardstick is None else judged,
        "goal": goal,
        "met": met,
        "better": better,
        "decides": decides,
        "detail": dict(detail or {}),
    }
