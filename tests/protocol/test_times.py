"""Times in documents and recordings."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from hippodrome.protocol.times import time_text


@pytest.mark.parametrize(
    ("microseconds", "written"),
    [(0, "2026-11-21T14:46:40.000000Z"), (7, "2026-11-21T14:46:40.000007Z"), (123456, "2026-11-21T14:46:40.123456Z")],
)
def test_a_time_has_six_digits_of_a_second_and_says_that_it_is_utc(microseconds: int, written: str) -> None:
    """So times sort as text."""
    assert time_text(datetime(2026, 11, 21, 14, 46, 40, microseconds, tzinfo=UTC)) == written
