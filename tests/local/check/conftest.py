"""What the tests of this folder share."""

from __future__ import annotations

import pytest

from testing import preloaded
from trial.server import process_group


@pytest.fixture
def forked(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is tried in this process is tried in a forked one, whose imports are done; `make check` starts it as its users do."""
    monkeypatch.setattr(process_group, "Popen", preloaded.popen)
