"""What the tests of this folder share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hippodrome.model import ids
from testing.quiet_log import quiet
from tests.stateful.sessions import numbered_id


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """Thousands of faults would be logged."""
    with quiet():
        yield


@pytest.fixture
def numbered_sessions(monkeypatch: pytest.MonkeyPatch) -> None:
    """The ids of sessions are numbers, so that a run that is repeated has the same ones."""
    monkeypatch.setattr(ids, "new_session_id", numbered_id)
