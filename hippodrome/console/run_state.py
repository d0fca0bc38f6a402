"""Where `hippodrome run` keeps its state, and how its servers are found: `run`, `try` and `erase` agree on this."""

from __future__ import annotations

from pathlib import Path

STATE = ".hippodrome"
"""The folder beside data folders in which `hippodrome run` keeps unfinished recordings, tasks and logs."""
EARLIER = "earlier"
"""The folder in `STATE` to which `hippodrome run --fresh` moves data and their state."""


def state_of(data: Path) -> Path:
    """Return the folder where `run` keeps the state of this data folder. `--fresh` moves both side by side."""
    root = data.resolve()
    moved = root.parent.parent.name == EARLIER and root.parent.parent.parent.name == STATE
    return root.parent / "state" if moved else root.parent / STATE / root.name


def mark_of(state: Path, name: str) -> str:
    """Return the mark by which a server's process is found: it stands in its command line.

    Without a name, it is what the marks of all servers of this state folder begin with.
    """
    return f"hippodrome={state.resolve()}/tasks/{name}"
