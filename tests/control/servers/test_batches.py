"""Items of a batch are processed independently: one failure does not affect the rest, and it is in the log."""

from __future__ import annotations

import pytest

from hippodrome.control.servers.batches import for_each
from testing.fake_platform import FakePlatform


def _halve(number: int) -> int | None:
    if number == 3:
        raise ValueError("what a participant sent")
    return None if number == 0 else number // 2


def test_a_failed_item_is_logged_and_the_others_go_on(caplog: pytest.LogCaptureFixture) -> None:
    made, failed = for_each(FakePlatform(), [0, 2, 3, 4], _halve, "not halved yet", lambda number: f"s{number}-1")
    assert made == [(2, 1), (4, 2)]
    assert failed == [3]
    (record,) = caplog.records
    assert record.getMessage() == "not halved yet"
    assert (record.server, record.error) == ("s3-1", ["ValueError"])  # type: ignore[attr-defined]
    assert "what a participant sent" not in str(vars(record))
