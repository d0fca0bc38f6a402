"""A fixture for the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from testing.quiet_log import quiet


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """Log nothing: the tests cause thousands of faults."""
    with quiet():
        yield
