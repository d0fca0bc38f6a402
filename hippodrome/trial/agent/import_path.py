"""Where Python looks for the researcher's modules."""

from __future__ import annotations

import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

import hippodrome

_OURS = str(Path(hippodrome.__path__[0]).resolve().parent)


def add(*folders: Path) -> None:
    """Let imports find modules in these folders: after Python's own, and before those of installed packages."""
    sys.path[:] = with_folders(sys.path, [str(folder) for folder in folders])


def with_folders(path: Sequence[str], folders: Sequence[str]) -> list[str]:
    """Return the path with these folders behind the standard library, wherever they were before.

    A clone of Hippodrome that is in PYTHONPATH comes behind them: its `testing/` would hide a researcher's testing.py.
    """
    library = sysconfig.get_path("stdlib")
    standard = {library, f"{library}/lib-dynload"}
    others = [entry for entry in path if entry not in folders]
    end = max((place for place, entry in enumerate(others, 1) if entry in standard), default=0)
    first = [entry for entry in others[:end] if entry != _OURS]
    ours = [entry for entry in others[:end] if entry == _OURS]
    return [*first, *dict.fromkeys(folders), *ours, *others[end:]]
