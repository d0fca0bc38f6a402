"""What the control plane and the servers share: it leads nowhere else, and both sides use it."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

from protocol import exits

ROOT = Path(__file__).resolve().parents[2]


def imported(folder: str) -> dict[str, set[str]]:
    """The top-level names that each module of a package imports, also inside functions."""
    found: dict[str, set[str]] = {}
    for path in sorted((ROOT / folder).rglob("*.py")):
        names = found.setdefault(path.relative_to(ROOT).as_posix(), set())
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert not node.level
                names.add(str(node.module).partition(".")[0])
    return found


def test_it_imports_the_standard_library_and_itself() -> None:
    allowed = sys.stdlib_module_names | {"protocol"}
    found = imported("protocol")
    assert "protocol/trial.py" in found
    assert {module: names - allowed for module, names in found.items() if names - allowed} == {}


@pytest.mark.parametrize("other", ["hippodrome", "lambdas", "local", "deploy"])
def test_the_trial_imports_nothing_of_the_control_plane(other: str) -> None:
    assert [module for module, names in imported("trial").items() if other in names] == []


def test_both_sides_import_the_check_of_a_section() -> None:
    assert "protocol" in imported("trial")["trial/settings.py"]
    assert "protocol" in imported("hippodrome")["hippodrome/config/validation.py"]


def test_the_exit_codes_are_written_once() -> None:
    assert "protocol" in imported("trial")["trial/server.py"]
    assert "protocol" in imported("hippodrome")["hippodrome/servers/causes.py"]
    codes = {exits.NO_AGENT, exits.LATE_AGENT, exits.NO_PORT}
    assert len(codes) == 3
    assert codes.isdisjoint({0, 1, 2, 137})  # done, could not serve, wrong settings, killed
