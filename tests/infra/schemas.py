"""CloudFormation's own schemas of the resource types, as its registry has them in each region; by way of cfn-lint."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import cfnlint.data.schemas.providers
import cfnlint.data.schemas.resources

LINTED = "us-east-1"
"""The region that cfn-lint takes, and `test_template.py` lints for."""


def of_region(region: str) -> dict[str, str]:
    """The resource types of a region, each with the hash of its schema there."""
    (folder,) = cfnlint.data.schemas.providers.__path__
    found: dict[str, str] = json.loads(Path(folder, f"{region}.json").read_text())
    return found


@cache
def schema(kind: str) -> dict[str, Any]:
    """The schema of a type."""
    (folder,) = cfnlint.data.schemas.resources.__path__
    found: dict[str, Any] = json.loads(Path(folder, f"{of_region(LINTED)[kind]}.json").read_text())
    return found
