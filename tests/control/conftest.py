"""Fixtures of this folder's tests: a platform in memory, whose study a file can replace, and an account in moto."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hippodrome.control.model.project import Project
from hippodrome.functions import installed
from testing import studies
from testing.fake_platform import FakePlatform
from testing.moto_world import moto_world  # noqa: F401 - a fixture


@pytest.fixture(autouse=True)
def _aws_again() -> Iterator[None]:
    """After each test the functions use AWS again, whatever platform it has set."""
    yield
    installed.use(None)


@pytest.fixture
def project() -> Project:
    """The study of `testing/studies.py`."""
    return studies.study()


@pytest.fixture
def platform(project: Project) -> FakePlatform:
    """A platform in memory with the study; the functions use it."""
    made = studies.installed(project)
    installed.use(made)
    return made
