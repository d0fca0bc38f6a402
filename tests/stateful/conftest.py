"""Fixtures for the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hippodrome.control.model import ids
from testing.quiet_log import quiet
from tests.stateful.sessions import numbered_id


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """Log nothing: the tests cause thousands of faults."""
    with quiet():
        yield


@pytest.fixture
def numbered_sessions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Number the ids of sessions, so that a repeated run has the same ids."""
    monkeypatch.setattr(ids, "new_session_id", numbered_id)
