"""`make check` has nothing to say about the examples."""

from __future__ import annotations

import os
import subprocess
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from local.rehearsal.study_process import ROOT
from testing import preloaded

EXAMPLES = sorted(path.parent.name for path in (ROOT / "examples").glob("*/config.yml"))


def needs_packages(example: str) -> None:
    """Skip the test where the example's packages are not installed: `make test` installs them."""
    file = ROOT / "examples" / example / "requirements.txt"
    for line in file.read_text().splitlines() if file.is_file() else ():
        if line and not line.startswith("#"):
            try:
                metadata.version(Requirement(line).name)
            except metadata.PackageNotFoundError:
                pytest.skip(f"pip install -r {file.relative_to(ROOT)}")


@pytest.mark.parametrize("example", EXAMPLES)
def test_make_check_finds_neither_mistakes_nor_remarks(example: str, tmp_path: Path) -> None:
    needs_packages(example)
    process = preloaded.start(
        "local.check",
        [str(ROOT / "examples" / example)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    said, _ = process.communicate(timeout=150)
    assert process.returncode == 0, said
    assert said.splitlines()[-1].startswith("No mistakes: "), said
