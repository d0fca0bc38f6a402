"""`hippodrome run` where any call for a file, process, thread or socket may be refused: `SEED` says which, `CHANCE` how many.

One of the first calls is refused in any case, so that each run has a refusal. Each refusal is a line `refused: …` on stderr.
"""

from __future__ import annotations

import os
import random
import sys
from pathlib import Path

import typer

from hippodrome.local.run import command
from testing.os_faults import ERRORS, OsCall, OsFaultInjector


class ByChance(OsFaultInjector):
    """Refuses calls by chance."""

    dice = random.Random(int(os.environ["SEED"]))
    chance = float(os.environ["CHANCE"])
    until_sure = dice.randrange(300)  # calls until one is refused in any case; a start makes more than that

    def _error(self, call: OsCall) -> int | None:  # type: ignore[override]
        self.until_sure -= 1
        if self.until_sure != 0 and self.dice.random() > self.chance:
            return None
        os.write(2, f"refused: {call.operation}\n".encode())
        return self.dice.choice(ERRORS[call.operation])


if __name__ == "__main__":
    sys.argv[0] = "local"
    with ByChance(Path.cwd()).installed():
        typer.run(command)
