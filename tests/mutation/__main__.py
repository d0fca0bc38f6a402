"""`make mutants`: counts how many small changes of the pure core the quick tests notice.

It tries a random sample of all mutants (SAMPLE=150; 0 takes all). The same SEED takes the same sample. MODULES= names
files, separated by spaces. The exit status is 1 if the tests kill less than GOAL percent.
"""

from __future__ import annotations

import os
import random
import sys
import time
import tomllib
from collections import Counter
from pathlib import Path

from tests.mutation.modules import TESTED_BY, concerned
from tests.mutation.mutants import Mutant, Mutants
from tests.mutation.running import Fails, Runner

ROOT = Path(__file__).parents[2]
GOAL = 90


def equivalent() -> set[tuple[str, str, str]]:
    """Read the changes that change no behaviour, which `equivalent.toml` lists."""
    listed = tomllib.loads((Path(__file__).parent / "equivalent.toml").read_text()).get("mutant", [])
    return {(entry["module"], entry["was"], entry["becomes"]) for entry in listed}


def sample(modules: list[str], size: int, seed: int) -> list[Mutant]:
    """Choose `size` mutants of these modules at random (0: all), and return them without those of `equivalent`."""
    lists = [Mutants(module, (ROOT / module).read_text()) for module in modules]
    every = [(mutants, index) for mutants in lists for index in range(len(mutants))]
    print(f"{len(every)} mutants in {len(modules)} modules; SAMPLE={size or len(every)} SEED={seed}", flush=True)
    chosen = random.Random(seed).sample(every, min(size or len(every), len(every)))
    known = equivalent()
    return [mutant for mutants, index in chosen if (mutant := mutants[index]).key not in known]


def main() -> int:
    modules = os.environ.get("MODULES", "").split() or list(TESTED_BY)
    seed = int(os.environ.get("SEED") or random.randrange(10_000))
    mutants = sample(modules, int(os.environ.get("SAMPLE") or 150), seed)
    tests = {module: concerned(module) for module in modules}
    runner, began = Runner(ROOT, at_once=int(os.environ.get("JOBS") or 2)), time.monotonic()
    killed, survived = Counter[str](), list[Mutant]()
    try:
        runner.warm(sorted({file for files in tests.values() for file in files}))
        for mutant, dead in runner.judge(mutants, tests):
            killed[mutant.module] += dead
            if not dead:
                survived.append(mutant)
    except Fails as trouble:
        sys.exit(str(trouble))
    for mutant in sorted(survived, key=lambda mutant: (mutant.module, mutant.line)):
        print(f"\n{mutant.module}:{mutant.line}\n  - " + mutant.was.replace("\n", "\n  - "))
        print("  + " + mutant.becomes.replace("\n", "\n  + "))
    tried = Counter(mutant.module for mutant in mutants)
    print(f"\n{'module':28}{'killed':>8}{'of':>6}")
    for module in sorted(tried):
        print(f"{module:28}{killed[module]:8}{tried[module]:6}")
    score = 100 * killed.total() / max(1, len(mutants))
    print(
        f"{'all':28}{killed.total():8}{len(mutants):6}   {score:.1f} % (goal: {GOAL} %) in {time.monotonic() - began:.0f} s"
    )
    return 0 if score >= GOAL else 1


if __name__ == "__main__":
    sys.exit(main())
