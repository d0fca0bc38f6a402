"""Numbers as people read them."""

from __future__ import annotations

import pytest

from hippodrome.console import formatting


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (0, "0 bytes"),
        (1, "1 byte"),
        (999, "999 bytes"),
        (1_000, "1.0 KB"),
        (1_499, "1.5 KB"),
        (999_949, "999.9 KB"),
        (999_950, "1.0 MB"),
        (1_550_000, "1.6 MB"),
        (2_340_000_000, "2.3 GB"),
        (5_000_000_000_000, "5,000.0 GB"),
    ],
)
def test_sizes_are_formatted(number: int, said: str) -> None:
    assert formatting.size(number) == said


def test_counts_and_durations_are_formatted() -> None:
    assert [formatting.count(n, "server") for n in (0, 1, 1_200)] == ["0 servers", "1 server", "1,200 servers"]
    assert [formatting.duration(s) for s in (0.4, 89.4, 90, 900)] == ["0 s", "89 s", "2 min", "15 min"]
