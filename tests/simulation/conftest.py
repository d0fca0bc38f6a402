"""What the tests of this folder share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from testing.quiet_log import quiet


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """Thousands of faults would be logged."""
    with quiet():
        yield
