"""`hippodrome/protocol/` imports no other package, and both the control plane and the servers import it."""

from __future__ import annotations

import sys
from pathlib import Path

from hippodrome.protocol import exits
from testing.imports import imported

ROOT = Path(__file__).resolve().parents[2]


def imports(folder: str) -> dict[str, set[str]]:
    """Return what each module of a package imports: of our own packages the name below `hippodrome`."""
    return {
        path.relative_to(ROOT).as_posix(): {_short(name) for name in imported(path)}
        for path in sorted((ROOT / "hippodrome" / folder).rglob("*.py"))
    }


def _short(name: str) -> str:
    return ".".join(name.split(".")[: 2 if name.startswith("hippodrome.") else 1])


def test_protocol_imports_only_the_standard_library_and_itself() -> None:
    allowed = sys.stdlib_module_names | {"hippodrome", "hippodrome.protocol"}
    found = imports("protocol")
    assert "hippodrome/protocol/trial.py" in found
    assert {module: names - allowed for module, names in found.items() if names - allowed} == {}


def test_the_trial_imports_nothing_of_the_control_plane() -> None:
    ours = {name for names in imports("trial").values() for name in names if name.startswith("hippodrome.")}
    assert ours == {"hippodrome.trial", "hippodrome.protocol"}


def test_both_sides_import_the_check_of_a_section() -> None:
    assert "hippodrome.protocol" in imports("trial")["hippodrome/trial/settings.py"]
    assert "hippodrome.protocol" in imports("control")["hippodrome/control/config/each_value.py"]


def test_the_exit_codes_are_written_once() -> None:
    assert "hippodrome.protocol" in imports("trial")["hippodrome/trial/server/server.py"]
    assert "hippodrome.protocol" in imports("control")["hippodrome/control/servers/causes.py"]
    codes = {exits.NO_AGENT, exits.LATE_AGENT, exits.NO_PORT}
    assert len(codes) == 3
    assert codes.isdisjoint({0, 1, 2, 137})  # done, could not serve, wrong settings, killed
