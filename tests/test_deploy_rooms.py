"""The rooms of deploy/ lie one above the other: a module imports from its own room and from those below."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

DEPLOY = Path(__file__).resolve().parent.parent / "deploy"
ROOMS = ("aws", "core", "code", "cost", "stack", "study", "operate", "lifecycle")  # from the lowest to the highest


def imported(path: Path) -> Iterator[str]:
    """The rooms that a module imports from, wherever in a function that may be."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom):
            names = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        yield from (parts[1] for parts in (name.split(".") for name in names) if parts[0] == "deploy" and parts[1:])


def test_every_folder_is_a_room() -> None:
    assert {path.parent.name for path in DEPLOY.glob("*/__init__.py")} == set(ROOMS)


@pytest.mark.parametrize("room", ROOMS)
def test_nothing_imports_from_a_room_above(room: str) -> None:
    may = {*ROOMS[: ROOMS.index(room) + 1]}
    wrong = {
        f"{path.relative_to(DEPLOY)} imports deploy.{other}"
        for path in (DEPLOY / room).rglob("*.py")
        for other in imported(path)
        if other not in may
    }
    assert wrong == set()
