"""Formats numbers for people."""

from __future__ import annotations

_MINUTES_FROM = 90  # seconds; shorter durations are shown in seconds


def count(number: int, noun: str) -> str:
    """Return a number with its noun: `1 server`, `1,200 servers`."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def size(number: float) -> str:
    """Return a number of bytes as `812 bytes`, `1.5 KB` or `3.2 GB`; a KB is 1,000 bytes."""
    if number < 1000:
        return count(round(number), "byte")
    for unit in ("KB", "MB"):
        number /= 1000
        if number < 999.95:
            return f"{number:,.1f} {unit}"
    return f"{number / 1000:,.1f} GB"


def duration(seconds: float) -> str:
    """Return a duration as `41 s`, or from 90 seconds on as `12 min`."""
    return f"{seconds:.0f} s" if seconds < _MINUTES_FROM else f"{seconds / 60:.0f} min"
