"""The packages that the examples require are those that their tests run with."""

from __future__ import annotations

from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted(path.parent.name for path in (ROOT / "examples").glob("*/requirements.txt"))


def requirements(file: Path) -> dict[str, Requirement]:
    lines = (line.partition("#")[0].strip() for line in file.read_text().splitlines())
    found = [Requirement(line) for line in lines if line and not line.startswith("-")]
    return {each.name: each for each in found}


@pytest.mark.parametrize("example", EXAMPLES)
def test_an_examples_requirements_allow_the_versions_that_the_tests_run_with(example: str) -> None:
    tested = requirements(ROOT / "requirements" / "dev.txt")
    wanted = requirements(ROOT / "examples" / example / "requirements.txt")
    assert wanted
    for name, requirement in wanted.items():
        (pin,) = tested[name].specifier
        assert requirement.specifier.contains(pin.version), name
