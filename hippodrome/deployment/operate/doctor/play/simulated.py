"""How many seconds AWS's stages take in the simulation. A rehearsal shows its own times beside these.

The figures are those of `testing/simulation`, written here again, since no command imports that package.
`tests/deployment/operate/test_play.py` compares the two.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class SimulatedStage(NamedTuple):
    """A measured stage, and its seconds in the simulation: the usual range (from, to), and the most."""

    what: str  # the stage in words
    usual: tuple[float, float]
    most: float


STAGES: Mapping[str, SimulatedStage] = {
    "start": SimulatedStage("from RunTask until the task runs", (11.0, 56.0), 90.0),  # 95 % of a log-normal, median 25
    "told": SimulatedStage("from then until task_changed has heard of it", (0.0, 2.0), 21.0),
    "name": SimulatedStage("from then until its name is known everywhere", (20.0, 60.0), 120.0),
    "certificate": SimulatedStage("from then until its certificate is issued", (4.0, 9.0), 60.0),
    "gone": SimulatedStage("from the end of the container until the task has stopped", (10.0, 35.0), 35.0),
}
