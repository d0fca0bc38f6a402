"""CloudFormation's own schemas of the resource types, as its registry has them in each region; by way of cfn-lint."""

from __future__ import annotations

import json
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

LINTED = "us-east-1"
"""The region that cfn-lint takes, and `test_template.py` lints for."""


def _folder(kind: str) -> Path:
    """Return a folder of cfn-lint's schemas. cfn-lint itself is not imported: that takes a second."""
    package = find_spec("cfnlint")
    assert package
    assert package.origin
    return Path(package.origin).parent / "data" / "schemas" / kind


def of_region(region: str) -> dict[str, str]:
    """Return the resource types of a region, each with the hash of its schema there."""
    found: dict[str, str] = json.loads((_folder("providers") / f"{region}.json").read_text())
    return found


@cache
def schema(kind: str) -> dict[str, Any]:
    """The schema of a type."""
    found: dict[str, Any] = json.loads((_folder("resources") / f"{of_region(LINTED)[kind]}.json").read_text())
    return found
