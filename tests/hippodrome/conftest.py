"""Fixtures of this folder's tests: a platform in memory, which a file can replace by its own, and an account in moto."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from lambdas import installed
from testing import studies
from testing.fake_platform import FakePlatform
from testing.moto_world import moto_world  # noqa: F401 - a fixture


@pytest.fixture
def platform() -> Iterator[FakePlatform]:
    """A platform in memory with the study of `testing/studies.py`; the functions use it."""
    made = studies.installed()
    installed.use(made)
    yield made
    installed.use(None)
