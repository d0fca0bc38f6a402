"""A platform in memory for the tests of this folder. Files whose tests need another one have a fixture of the same name."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from lambdas import installed
from testing import studies
from testing.fake_platform import FakePlatform


@pytest.fixture
def platform() -> Iterator[FakePlatform]:
    """A platform in memory with the study of `testing/studies.py`; the functions use it."""
    made = studies.installed()
    installed.use(made)
    yield made
    installed.use(None)
