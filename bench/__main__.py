"""Measures everything (`python -m bench`) or single groups (`python -m bench control`).

The rows go to bench/results.json. A missed goal is no error: the exit status is 1 only if something could not be
measured at all.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from collections.abc import Iterator, Sequence

from rich.console import Console

from bench import table
from bench.table import Row

GROUPS = (
    "control",
    "functions",
    "stack",
    "pages",
    "trial",
    "load",
    "scenes",
    "together",
    "scale",
    "sessions",
    "warm",
    "data",
    "gym",
)
WIDTH = 132  # characters, if the output is no terminal


def measure(group: str) -> Iterator[Row]:
    """Yield the rows of one group, each with the group's name; if the group fails, a last row that says why."""
    try:
        for found in importlib.import_module(f"bench.{group}").rows():
            yield {"group": group, **found}
    except Exception as error:  # noqa: BLE001 - the other groups are measured nevertheless
        yield {"group": group, **table.unmeasured(f"the rest of {group}", error)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print the rows; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"what to measure: {', '.join(GROUPS)}; default all")
    chosen = parser.parse_args(arguments).groups or list(GROUPS)
    if unknown := [group for group in chosen if group not in GROUPS]:
        parser.error(f"there is no group {unknown[0]!r}; there are {', '.join(GROUPS)}")
    progress = Console(stderr=True)
    rows: list[Row] = []
    begun = time.monotonic()
    for group in dict.fromkeys(chosen):
        with progress.status(f"measuring {group} …"):
            for found in measure(group):
                rows.append(found)
                text = f"{time.monotonic() - begun:5.0f} s  {table.line(found)}"
                progress.print(text, highlight=False, markup=False, soft_wrap=True)
    table.keep(rows)
    output = Console()
    table.show(rows, output if output.is_terminal else Console(width=WIDTH))
    return 0 if rows and all(table.measured(found) for found in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
