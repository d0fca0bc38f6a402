"""Times as they stand in all documents and recordings."""

from __future__ import annotations

from datetime import datetime


def time_text(moment: datetime) -> str:
    """The moment, which must be in UTC, to the microsecond: `2026-11-21T14:46:40.123456Z`."""
    return f"{moment.replace(tzinfo=None).isoformat(timespec='microseconds')}Z"
