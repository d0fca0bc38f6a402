"""Finds what a Python file imports, for the tests that say which packages and modules may import which."""

from __future__ import annotations

import ast
import functools
from pathlib import Path


@functools.cache
def imported(path: Path) -> frozenset[str]:
    """Return the names that a file imports, also inside functions; `from a import b` gives `a` and `a.b`.

    Raises AssertionError for a relative import: this project has none.
    """
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: a relative import"
            found |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return frozenset(found)
