"""How much the tests explore: `make test` always takes the same sample, `make hunt` all cases and new examples.

`make test` runs each exploration on a sample, and each property on the same few examples, so that the same commit gets
the same verdict within minutes. `make hunt` sets the environment variable HUNT, and runs only

* tests with the mark `hunt`, which `make test` leaves out,
* tests with the mark `explores`, which then take all their cases instead of a sample (`sample`), or the Chromium that
  people have instead of the one without windows,
* hypothesis tests, with 2 * HUNT times as many examples, different ones each time, unless `--hypothesis-seed` repeats them.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Hashable, Iterable
from typing import TypeVar

from hypothesis import HealthCheck, settings

T = TypeVar("T")

TIMES = int(os.environ.get("HUNT") or 0)
"""The factor by which `make hunt` multiplies the examples of a property; 0 in `make test`."""

SECONDS = float(os.environ.get("HUNT_SECONDS") or "inf")
"""The seconds after which `make hunt` begins no new test, and reports the remaining tests as skipped."""

PAGE = 1000 if TIMES else 40
"""The number of keys in a page of S3's listings while a test has the fixture `pages`; on AWS, and in the hunt,
1,000."""


def examples(number: int) -> int:
    """Return how many examples of a property to run: half of `number` in `make test`, `TIMES * number` in `make hunt`."""
    return number * TIMES or number // 2


def sample(cases: Iterable[T], share: int, seed: int = 0) -> list[T]:
    """Return all cases in `make hunt`, else one of each `share` cases, in order.

    The same `seed` chooses the same ones.
    """
    all_cases = list(cases)
    if TIMES:
        return all_cases
    chance = random.Random(seed)
    groups = [all_cases[start : start + share] for start in range(0, len(all_cases), share)]
    return [chance.choice(group) for group in groups]


def sample_of_each(cases: Iterable[T], share: int, kind: Callable[[T], Hashable], seed: int = 0) -> list[T]:
    """Return all cases in `make hunt`, else a `sample` of the cases of each kind, so at least one of each."""
    kinds: dict[Hashable, list[T]] = {}
    for case in cases:
        kinds.setdefault(kind(case), []).append(case)
    return [case for number, found in enumerate(kinds.values()) for case in sample(found, share, seed + number)]


def load_profile() -> None:
    """Make one profile of hypothesis the default of all tests.

    It has no deadline, because a slow machine is no fault of the code; no database, because an example that failed once
    belongs in a test; and no health checks, because they measure time, too, and because no example changes anything that
    a function-scoped fixture here holds.
    """
    settings.register_profile(
        "hippodrome",
        deadline=None,
        database=None,
        derandomize=not TIMES,
        max_examples=examples(100),
        print_blob=True,
        suppress_health_check=list(HealthCheck),
    )
    settings.load_profile("hippodrome")
