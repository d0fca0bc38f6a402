"""Fixtures for the tests of `make check`."""

from __future__ import annotations

from pathlib import Path

import pytest

from testing import preloaded
from tests.local.conftest import write_study
from trial.server import process_group


@pytest.fixture
def forked(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is tried in this process is tried in a forked one, whose imports are done; `make check` starts it as its users do."""
    monkeypatch.setattr(process_group, "Popen", preloaded.popen)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small study without mistakes."""
    return write_study(tmp_path / "study", start=2)
