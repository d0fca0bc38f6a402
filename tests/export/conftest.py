"""A folder that `data` fills, for the tests of this folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.deployment.installation import Installed, installed
from tests.export.place import Place

__all__ = ["installed"]


@pytest.fixture
def place(tmp_path: Path, capsys: Any) -> Place:
    """Return a folder with the data of one machine, and another folder, which `data` fills from it."""
    return Place(tmp_path, capsys)


@pytest.fixture
def world(installed: Installed) -> Installed:
    """Return an installation, with its bucket."""
    return installed
