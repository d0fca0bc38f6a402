"""How far the tests explore: `make test` a sample that is always the same, `make hunt` everything, and other examples.

`make test` runs each exploration on a sample and each property on the same few examples, so that the same commit gets the
same verdict within minutes. `make hunt` (the environment variable HUNT) runs only

* tests marked `hunt`, which `make test` leaves out,
* tests marked `explores`, which then take all their cases instead of a sample (`sample`),
* hypothesis tests, with other examples each time (`--hypothesis-seed` repeats them) and `HUNT` times as many.
"""

from __future__ import annotations

import os
import random
from collections.abc import Iterable
from typing import TypeVar

from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers

T = TypeVar("T")

TIMES = int(os.environ.get("HUNT") or 0)
"""By how much the hunt multiplies the examples of a property; 0 in `make test`."""


SECONDS = float(os.environ.get("HUNT_SECONDS") or "inf")
"""How long the hunt may begin new tests; what it has not reached by then is told as skipped."""

PAGE = 1000 if TIMES else 40
"""Keys in a page of S3's listings while a test has the fixture `pages`; on AWS, and in the hunt, 1,000."""


def examples(number: int) -> int:
    """How many examples of a property to play; `number` is what `make test` plays."""
    return number * max(1, TIMES)


def sample(cases: Iterable[T], share: int, seed: int = 0) -> list[T]:
    """All cases in the hunt; else one of each `share` of them, in their order, chosen by `seed` and always the same."""
    everything = list(cases)
    if TIMES:
        return everything
    chance = random.Random(seed)
    groups = [everything[start : start + share] for start in range(0, len(everything), share)]
    return [chance.choice(group) for group in groups]


def load_profile() -> None:
    """Make the one profile of hypothesis that all tests share the default.

    In `make test` examples hold no constants from our modules: hypothesis 6.170 takes them from those that the process has
    loaded, and what a worker has run before would decide what it plays.

    No deadline: a busy machine is no mistake. No database: an example that failed once belongs into a test. Health
    checks measure time, too, and function-scoped fixtures here hold nothing that an example leaves changed.
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
    if not TIMES:
        providers._get_local_constants = lambda: providers._local_constants  # nothing adds to these
