"""Which tests a worker of pytest-xdist gets at a time, and in which order.

pytest-xdist's own `loadgroup` gives a worker one test, begins with the groups of the most tests, and counts all that a
worker has ever had before it gives the next test. For 10,000 tests all that takes 9 seconds of processor time more than `units`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from xdist.scheduler import LoadGroupScheduling
from xdist.workermanage import WorkerController

MOST = 8
"""So many tests of a file are one unit while many are left, however long they take."""

TURNS = 100
"""Of what is left, each worker gets at least this many units, so that none has much to do when the others have finished."""


def units(names: Sequence[str], group: Callable[[str], int | None], workers: int) -> dict[str, str]:
    """The unit of each test: those of a group are one; the others are a few of a file, in their order, and one each at the end."""
    found: dict[str, str] = {}
    unit, file, room = "", "", 0
    for place, name in enumerate(names):
        number = group(name)
        if number is not None:
            found[name] = f"group {number}"
            continue
        if not room or name.split("::")[0] != file:
            unit, file, room = name, name.split("::")[0], _size(len(names) - place, workers)
        found[name] = unit
        room -= 1
    return found


def _size(left: int, workers: int) -> int:
    return max(1, min(MOST, left // (TURNS * workers)))


def interleaved(files: Mapping[str, int], kind: Callable[[str], object]) -> dict[str, float]:
    """The place of each file, from 0 to 1, when files of all kinds take turns: the share of the work of its kind that comes before it.

    `files` says how much work each file is.
    """
    of_kind, before = Counter[object](), Counter[object]()
    for file, work in files.items():
        of_kind[kind(file)] += work
    found = {}
    for file, work in files.items():
        found[file] = before[kind(file)] / of_kind[kind(file)]
        before[kind(file)] += work
    return found


class InUnits(LoadGroupScheduling):
    """Gives workers these units, and forgets what they have done."""

    def __init__(self, config: Any, log: Any, group: Callable[[str], int | None]) -> None:
        super().__init__(config, log)
        self._group = group
        self._units: Mapping[str, str] = {}

    def schedule(self) -> None:
        """Begin, or go on with a worker more or fewer."""
        self.config.option.loadscopereorder = False  # what takes long comes first, not what has many tests
        if not self._units:
            self._units = units(next(iter(self.registered_collections.values())), self._group, len(self.nodes))
        super().schedule()

    def mark_test_complete(self, node: WorkerController, item_index: int, duration: float = 0) -> None:
        """Note that a worker has done this test of its list, and give it more if it has little left."""
        name = self.registered_collections[node][item_index]
        unit, assigned = self._units[name], self.assigned_work[node]
        if unit in assigned:  # a test may report several times
            assigned[unit][name] = True
            if all(assigned[unit].values()):
                del assigned[unit]
        self._reschedule(node)

    def _split_scope(self, nodeid: str) -> str:
        return self._units[nodeid]
