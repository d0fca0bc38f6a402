"""Values as columns take them: each function returns a value that fits, or None for any other. Pure."""

from __future__ import annotations

import json
from datetime import datetime
from typing import Any

from hippodrome.export.scrub import clean


def as_whole(value: Any) -> int | None:
    """Return a whole number that fits into 64 bits."""
    fits = isinstance(value, int) and not isinstance(value, bool) and -(2**63) <= value < 2**63
    return value if fits else None


def as_number(value: Any) -> float | None:
    """Return a number as a float."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def as_truth(value: Any) -> bool | None:
    """Return a truth value."""
    return value if isinstance(value, bool) else None


def as_text(value: Any) -> str | None:
    """Return a text, as UTF-8 can hold it."""
    return clean(value) if isinstance(value, str) else None


def when(value: Any) -> datetime | None:
    """Return the time in a text such as `2026-11-21T14:46:40.123456Z`."""
    try:
        time = datetime.fromisoformat(value)
    except (TypeError, ValueError):
        return None
    return time if time.tzinfo is not None else None


def json_text(value: Any) -> str:
    """Return any value as compact JSON, with all characters unescaped, as UTF-8 can hold them."""
    return clean(json.dumps(value, separators=(",", ":"), ensure_ascii=False))
