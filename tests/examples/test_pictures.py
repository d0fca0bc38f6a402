"""The pictures in the examples' assets/ are those that their make_assets.py draws."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
DRAWN = sorted(path.parent.name for path in EXAMPLES.glob("*/make_assets.py"))
MAX_BYTES = 40_000
"""Bytes of all pictures of an example together."""


@pytest.mark.parametrize("example", DRAWN)
def test_the_script_draws_the_pictures_of_the_example(example: str, tmp_path: Path) -> None:
    shutil.copy(EXAMPLES / example / "make_assets.py", tmp_path)
    subprocess.run([sys.executable, tmp_path / "make_assets.py"], check=True)
    made, there = sorted((tmp_path / "assets").iterdir()), sorted((EXAMPLES / example / "assets").iterdir())
    assert [file.name for file in made] == [file.name for file in there]
    for new, old in zip(made, there, strict=True):
        if new.suffix == ".png":
            assert np.array_equal(*(np.asarray(Image.open(file).convert("RGBA")) for file in (new, old))), new.name
        else:
            assert new.read_text() == old.read_text()


@pytest.mark.parametrize("example", DRAWN)
def test_pictures_are_small(example: str) -> None:
    assert sum(file.stat().st_size for file in (EXAMPLES / example / "assets").iterdir()) < MAX_BYTES
