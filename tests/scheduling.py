"""Which tests a worker of pytest-xdist gets at a time, and in which order.

pytest-xdist's own `loadgroup` gives a worker one test, begins with the groups of the most tests, and counts all that a
worker has ever had before it gives the next test. For 10,000 tests all that takes 9 seconds of processor time more than `units`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from typing import Any

from xdist.scheduler import LoadGroupScheduling
from xdist.workermanage import WorkerController

MOST = 8
"""So many tests of a file are one unit while many are left, however long they take."""

TURNS = 100
"""Of what is left, each worker gets at least this many units, so that none has much to do when the others have finished."""


def units(
    names: Sequence[str], group: Callable[[str], int | None], computes: Callable[[str], bool], workers: int
) -> dict[str, str]:
    """The unit of each test.

    Those of a group are one. Of those that compute, a few of a file are one, in their order, and fewer at the end. Those that
    wait are one each: they take from a moment to half a minute.
    """
    found: dict[str, str] = {}
    unit, file, room = "", "", 0
    for place, name in enumerate(names):
        number = group(name)
        if number is not None:
            found[name] = f"group {number}"
            continue
        if not room or name.split("::")[0] != file:
            unit, file = name, name.split("::")[0]
            room = _size(len(names) - place, workers) if computes(name) else 1
        found[name] = unit
        room -= 1
    return found


def _size(left: int, workers: int) -> int:
    return max(1, min(MOST, left // (TURNS * workers)))


class InUnits(LoadGroupScheduling):
    """Gives workers these units, and forgets what they have done.

    As many workers as the machine has processors, but at most half of them, do tests that compute, as long as there are any; the
    others do tests that wait for processes. So the machine has always something to do.
    """

    def __init__(
        self,
        config: Any,
        log: Any,
        group: Callable[[str], int | None],
        computes: Callable[[str], bool],
    ) -> None:
        super().__init__(config, log)
        self._group = group
        self._computes = computes
        self._units: Mapping[str, str] = {}
        self._places: Mapping[str, int] = {}
        self._computing: Set[str] = frozenset()
        self._left: Mapping[bool, Iterator[str]] = {}  # units in their order, those that compute and the others

    def schedule(self) -> None:
        """Begin, or go on with a worker more or fewer."""
        self.config.option.loadscopereorder = False  # what takes long comes first, not what has many tests
        if not self._units:
            names = next(iter(self.registered_collections.values()))
            self._units = units(names, self._group, self._computes, len(self.nodes))
            self._places = {name: place for place, name in enumerate(names)}
            self._computing = {unit for name, unit in self._units.items() if self._computes(name)}
            order = dict.fromkeys(self._units.values())
            self._left = {
                kind: iter([unit for unit in order if (unit in self._computing) is kind]) for kind in (True, False)
            }
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

    def _assign_work_unit(self, node: WorkerController) -> None:
        unit = self._next_unit(node)
        tests = self.assigned_work[node][unit] = self.workqueue.pop(unit)
        node.send_runtest_some([self._places[name] for name, done in tests.items() if not done])

    def _next_unit(self, node: WorkerController) -> str:
        """The next group; if there is none, a unit that computes if too few workers have one, or else one that waits."""
        first = next(iter(self.workqueue))
        if self._group(next(iter(self.workqueue[first]))) is not None:
            return first
        last = [next(reversed(work)) for other, work in self.assigned_work.items() if work and other is not node]
        most = min(os.cpu_count() or 1, len(self.assigned_work) // 2)
        wanted = sum(unit in self._computing for unit in last) < most
        return next((unit for unit in self._left[wanted] if unit in self.workqueue), first)

    def _split_scope(self, nodeid: str) -> str:
        return self._units[nodeid]
