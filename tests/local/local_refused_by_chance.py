"""`python -m local` where any call for a file, process, thread or socket may be refused: `SEED` says which, `CHANCE` how many."""

from __future__ import annotations

import os
import random
import sys
from pathlib import Path

import typer

from local.__main__ import main
from testing.os_faults import ERRORS, OsCall, OsFaultInjector


class ByChance(OsFaultInjector):
    """Refuses calls by chance; one in ten times all that can be refused for this reason, for a moment."""

    dice = random.Random(int(os.environ["SEED"]))
    chance = float(os.environ["CHANCE"])

    def _error(self, call: OsCall) -> int | None:  # type: ignore[override]
        if self.dice.random() > self.chance:
            return None
        return self.dice.choice(ERRORS[call.operation])


if __name__ == "__main__":
    sys.argv[0] = "local"
    with ByChance(Path.cwd()).installed():
        typer.run(main)
