"""Fixtures for the tests of `make check`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.local.conftest import write_study


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small study without mistakes."""
    return write_study(tmp_path / "study", start=2)
