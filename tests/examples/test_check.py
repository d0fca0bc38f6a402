"""`make check` on each example."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from testing import processes
from testing.processes import ROOT

EXAMPLES = sorted(path.parent.name for path in (ROOT / "examples").glob("*/config.yml"))


@pytest.mark.parametrize("example", EXAMPLES)
def test_make_check_finds_neither_mistakes_nor_remarks(example: str, tmp_path: Path) -> None:
    process = processes.start(
        "hippodrome",
        ["check", str(ROOT / "examples" / example)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    said, _ = process.communicate(timeout=150)
    assert process.returncode == 0, said
    assert said.splitlines()[-1].startswith("No mistakes: "), said
