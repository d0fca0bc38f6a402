"""Measures this tree (`python -m bench`), or compares it with another checkout (`python -m bench --against DIRECTORY`).

Each measure runs in a process of its own, and reaches the product through what others use: `python -m
hippodrome.local`, pages, the handlers of the functions, commands, the simulated account. So one bench measures
different versions of the product.

Rows go to bench/results.json. A missed goal is no error: the exit status is 1 only if something was not measured.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Console

from bench import table
from bench.row import Row

ROOT = Path(__file__).resolve().parents[1]
MEASURES = (  # each is `module.function`
    "calls.of_a_participant",
    "calls.cold_start",
    "local.pages",
    "local.crowd",
    "local.first_picture",
    "chromium.example",
    "chromium.texture",
    "chromium.objects",
    "chromium.two_players",
    "crowds.thousand",
    "crowds.interrupted",
    "crowds.small_account",
    "crowds.pairs",
    "crowds.warm",
    "crowds.addresses",
    "talk.lines",
    "data.download",
    "designs.balance",
    "designs.calls",
    "designs.arrivals",
)
PATIENCE = 600  # seconds of one measure
COMPARED = {  # what `--against` measures unless others are named, and how often: timings are noisy, counts are not
    "calls.of_a_participant": 1,
    "calls.cold_start": 3,
    "local.pages": 1,
    "chromium.example": 5,
    "crowds.thousand": 1,
}
TIMES = 3  # for the measures that are not in `COMPARED`
WORST = 1.25  # the goal of `--against`: no row of this tree is so much worse than the other's
WIDTH = 150  # characters, if the output is no terminal


def measure(name: str, tree: Path = ROOT) -> list[Row]:
    """Run one measure on the product in `tree`; return its rows, or one row with the error."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        Path(folder, "bench").symlink_to(ROOT / "bench")  # this bench, and everything else from the tree
        command = [sys.executable, "-m", "bench.run", name, folder, str(tree.resolve())]
        try:
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=False)
        except subprocess.TimeoutExpired:
            return [table.unmeasured(name, f"it takes more than {PATIENCE} seconds")]
        if done.returncode:
            return [table.unmeasured(name, done.stderr.strip() or f"it ended with {done.returncode}")]
        return [{"measure": name, **row} for row in json.loads(done.stdout.splitlines()[-1])]


def compare(name: str, other: Path) -> list[Row]:
    """Measure both trees by turns; return the rows of this one with the medians, beside those of the other."""
    runs = [(measure(name, other), measure(name)) for _ in range(COMPARED.get(name, TIMES))]
    if failed := [row for pair in runs for rows in pair for row in rows if not table.measured(row)]:
        return failed[:1]
    return [
        table.compared(
            first,
            [pair[0][at]["value"] for pair in runs],
            [pair[1][at]["value"] for pair in runs],
            at_most=WORST,
        )
        for at, first in enumerate(runs[0][1])
        if first["better"] is not None
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and store the rows; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("measures", nargs="*", metavar="MEASURE", help=f"default: all of {', '.join(MEASURES)}")
    parser.add_argument("--against", type=Path, metavar="DIRECTORY", help="the other checkout")
    options = parser.parse_args(arguments)
    names: Iterable[str] = dict.fromkeys(options.measures or (COMPARED if options.against else MEASURES))
    if unknown := [name for name in names if name not in MEASURES]:
        parser.error(f"unknown measure {unknown[0]!r}; expected one of {', '.join(MEASURES)}")
    progress, rows, begun = Console(stderr=True), list[Row](), time.monotonic()
    for name in names:
        with progress.status(f"measuring {name} …"):
            new = compare(name, options.against) if options.against else measure(name)
        rows.extend(new)
        for row in new:
            text = f"{time.monotonic() - begun:5.0f} s  {table.line(row)}"
            progress.print(text, highlight=False, markup=False, soft_wrap=True)
    if not options.against:
        table.store(rows)
    output = Console()
    table.show(rows, output if output.is_terminal else Console(width=WIDTH))
    return 0 if rows and all(table.measured(row) for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
