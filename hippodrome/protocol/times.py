"""Writes times as all documents and recordings have them."""

from __future__ import annotations

from datetime import datetime


def time_text(moment: datetime) -> str:
    """Return a moment in UTC as text, to the microsecond: `2026-11-21T14:46:40.123456Z`."""
    return f"{moment.replace(tzinfo=None).isoformat(timespec='microseconds')}Z"
