"""Measures how long `apply` takes on the emulator: the first time, and again when there is nothing to change.

Real AWS takes minutes for the first `apply`. Here the times are those of our own code and of the emulator.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from bench.table import Row, each, row
from testing.ministack.world import DOMAIN, MinistackWorld, find_venv

RUNS = 3


def rows() -> Iterator[Row]:
    """Measure one installation; about half a minute."""
    yield from each([applies])


def applies() -> Iterator[Row]:
    """Measure the seconds of the whole command, with the start of Python."""
    venv = find_venv()
    if venv is None:
        raise RuntimeError("the emulator is not installed: `make bench` makes .venv-ministack")
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, MinistackWorld(venv, Path(folder)) as world:
        first = _apply(world, "--domain", DOMAIN, "--anyway")  # the emulator has no name servers
        again = [_apply(world) for _ in range(RUNS)]
        yield row("apply, the first time (emulator, wheels in the cache)", first, "s")
        yield row(
            "apply with nothing to change (emulator), whole command, against the first time",
            min(again),
            "s",
            yardstick=first,
            detail={"runs": again, "within the command": f"{_within(world):.2f} s"},
        )


def _apply(world: MinistackWorld, *options: str) -> float:
    begun = time.monotonic()
    ran = world.deploy("apply", *options, "--yes")
    if ran.code:
        raise RuntimeError(f"apply ended with {ran.code}: {ran.err[-500:]}")
    return time.monotonic() - begun


def _within(world: MinistackWorld) -> float:
    """Return the seconds that the command itself reports of a run without changes."""
    return float(json.loads(world.deploy("apply", "--json").out)["seconds"])
