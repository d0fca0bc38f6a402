"""Which package may import which (docs/architecture.md): nothing imports uphill."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MAY: dict[str, set[str]] = {
    "protocol": set(),
    "console": set(),
    "hippodrome": {"protocol"},
    "lambdas": {"hippodrome"},
    "trial": {"protocol"},
    "export": {"console", "hippodrome", "trial"},
    "rehearsal": {"hippodrome", "trial"},
    "local": {"hippodrome", "lambdas", "protocol", "rehearsal", "trial"},
    "deploy": {"console", "export", "hippodrome", "lambdas", "protocol", "rehearsal", "trial"},
    "testing": {"deploy", "hippodrome", "lambdas", "local", "protocol", "trial"},
    "bench": {"console", "deploy", "export", "hippodrome", "lambdas", "local", "protocol", "testing", "trial"},
}
OURS = {*MAY, "tests"}


def imported(package: str) -> dict[str, str]:
    """The packages of ours that this one imports, wherever in a function that may be, each with a file that does."""
    found: dict[str, str] = {}
    for path in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            found |= {first: path.name for name in names if (first := name.partition(".")[0]) in OURS - {package}}
    return found


@pytest.mark.parametrize("package", MAY)
def test_nothing_imports_uphill(package: str) -> None:
    assert {other: file for other, file in imported(package).items() if other not in MAY[package]} == {}
