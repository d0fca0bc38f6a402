"""Whatever comes in whatever order, however often, and whatever fails: the end is the same.

A stateful machine over participants, servers and the sweep. `MACHINE_EXAMPLES=5000` hunts for longer than the tests do.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, Phase, settings

from hippodrome.log import logger
from tests.machine.machine import Machine

EXAMPLES = int(os.environ.get("MACHINE_EXAMPLES", "80"))
STEPS = int(os.environ.get("MACHINE_STEPS", "50"))

PROFILE = settings(
    max_examples=EXAMPLES,
    stateful_step_count=STEPS,
    deadline=None,
    suppress_health_check=list(HealthCheck),
    phases=[Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink],
    print_blob=True,
)


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    level = logger.log_level
    logger.setLevel(logging.CRITICAL)
    yield
    logger.setLevel(level)


TestMachine = Machine.TestCase
TestMachine.settings = PROFILE
TestMachine = pytest.mark.timeout(0 if EXAMPLES > 1000 else 180)(TestMachine)
