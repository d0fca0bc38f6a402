"""Which package may import which (docs/architecture.md): nothing imports uphill, and the picture there shows what is."""

from __future__ import annotations

import ast
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MAY: dict[str, set[str]] = {
    "protocol": set(),
    "console": set(),
    "hippodrome": {"protocol"},
    "lambdas": {"hippodrome"},
    "trial": {"protocol"},
    "export": {"console", "hippodrome"},
    "bots": {"hippodrome", "trial"},
    "local": {"hippodrome", "lambdas", "protocol", "bots", "trial"},
    "deploy": {"console", "export", "hippodrome", "lambdas", "protocol", "bots", "trial"},
    "testing": {"deploy", "hippodrome", "lambdas", "local", "protocol", "trial"},
    "bench": {"console", "deploy", "export", "hippodrome", "lambdas", "local", "protocol", "testing", "trial"},
}
PRODUCT = set(MAY) - {"testing", "bench"}
ROOMS = (
    "ports",
    "model",
    "log",
    "storage",
    "certificates",
    "limits",
    "http",
    "servers",
    "participants",
    "config",
    "aws",
)
"""Rooms and modules of hippodrome: each imports only from those before it."""


def modules(node: ast.AST) -> Iterator[str]:
    """What an import statement may lead to: `from a import b` to `a` and `a.b`."""
    if isinstance(node, ast.ImportFrom) and node.module:
        yield node.module
        yield from (f"{node.module}.{alias.name}" for alias in node.names)
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)


def imported(folder: Path) -> dict[str, str]:
    """What the files of a folder import, wherever in a function that may be, each with a file that does."""
    paths = [folder] if folder.is_file() else folder.rglob("*.py")
    return {
        name: path.name for path in paths for node in ast.walk(ast.parse(path.read_text())) for name in modules(node)
    }


def packages(package: str) -> dict[str, str]:
    """The packages of ours that this one imports, each with a file that does."""
    found = {name.partition(".")[0]: file for name, file in imported(ROOT / package).items()}
    return {name: file for name, file in found.items() if name in {*MAY, "tests"} - {package}}


@pytest.mark.parametrize("package", MAY)
def test_nothing_imports_uphill(package: str) -> None:
    assert {other: file for other, file in packages(package).items() if other not in MAY[package]} == {}


def test_only_what_tests_the_bench_imports_it() -> None:
    importing = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tests").rglob("*.py")
        if any(name.partition(".")[0] == "bench" for name in imported(path))
    }
    assert importing == {
        "tests/bench/test_bench.py",
        "tests/browser/test_bench_browser.py",
        "tests/infra/test_functions.py",
    }


@pytest.mark.parametrize("room", ROOMS)
def test_no_room_of_the_control_plane_imports_a_later_one(room: str) -> None:
    folder = ROOT / "hippodrome"
    found = imported(folder / room if (folder / room).is_dir() else folder / f"{room}.py")
    rooms = {name.split(".")[1]: file for name, file in found.items() if name.startswith("hippodrome.")}
    later = ROOMS[ROOMS.index(room) + 1 :]
    assert {other: file for other, file in rooms.items() if other in later} == {}


def test_the_picture_shows_the_packages_and_what_they_import() -> None:
    picture = ET.parse(ROOT / "docs" / "packages.svg").getroot()
    shown = {element.get("data-room", "") for element in picture.iter() if element.get("data-room")}
    inner = {
        f"{one}/{path.parent.name}" for one in ("hippodrome", "deploy") for path in (ROOT / one).glob("*/__init__.py")
    }
    assert shown == PRODUCT | inner
    arrows = {
        (element.get("data-from"), element.get("data-to")) for element in picture.iter() if element.get("data-from")
    }
    leads = {package: set(packages(package)) for package in PRODUCT}
    further = {
        a: {c for b in leads[a] for c in leads[b]} | {d for b in leads[a] for c in leads[b] for d in leads[c]}
        for a in leads
    }
    assert arrows == {(a, b) for a in leads for b in leads[a] - further[a]}, (
        "arrows that follow from others are left out"
    )
