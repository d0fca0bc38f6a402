"""`protocol/` imports no other package, and both the control plane and the servers import it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from protocol import exits
from testing.imports import imported

ROOT = Path(__file__).resolve().parents[2]


def top_level_imports(folder: str) -> dict[str, set[str]]:
    """Return the top-level names that each module of a package imports."""
    return {
        path.relative_to(ROOT).as_posix(): {name.partition(".")[0] for name in imported(path)}
        for path in sorted((ROOT / folder).rglob("*.py"))
    }


def test_protocol_imports_only_the_standard_library_and_itself() -> None:
    allowed = sys.stdlib_module_names | {"protocol"}
    found = top_level_imports("protocol")
    assert "protocol/trial.py" in found
    assert {module: names - allowed for module, names in found.items() if names - allowed} == {}


@pytest.mark.parametrize("other", ["hippodrome", "lambdas", "local", "deploy"])
def test_the_trial_imports_nothing_of_the_control_plane(other: str) -> None:
    assert [module for module, names in top_level_imports("trial").items() if other in names] == []


def test_both_sides_import_the_check_of_a_section() -> None:
    assert "protocol" in top_level_imports("trial")["trial/settings.py"]
    assert "protocol" in top_level_imports("hippodrome")["hippodrome/config/each_value.py"]


def test_the_exit_codes_are_written_once() -> None:
    assert "protocol" in top_level_imports("trial")["trial/server/server.py"]
    assert "protocol" in top_level_imports("hippodrome")["hippodrome/servers/causes.py"]
    codes = {exits.NO_AGENT, exits.LATE_AGENT, exits.NO_PORT}
    assert len(codes) == 3
    assert codes.isdisjoint({0, 1, 2, 137})  # done, could not serve, wrong settings, killed
