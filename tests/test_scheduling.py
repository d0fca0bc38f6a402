"""Which tests a worker gets at a time."""

from __future__ import annotations

from collections import Counter
from itertools import groupby
from types import SimpleNamespace
from typing import Any

from tests.conftest import ONE_AFTER_ANOTHER, TESTS, WEIGHTS, _group
from tests.scheduling import MOST, TURNS, InUnits, interleaved, units

WORKERS = 3
FILES = [f"tests/test_{number}.py" for number in range(30)]
SHARED = FILES[0]
NAMES = [f"{file}::test_it[{number}]" for file in FILES for number in range(100)]


def group(name: str) -> int | None:
    return 0 if name.startswith(SHARED) else None


FOUND = units(NAMES, group, WORKERS)


def test_each_unit_is_a_group_or_a_few_tests_of_one_file_that_follow_each_other() -> None:
    assert list(FOUND) == NAMES
    runs = [(unit, list(names)) for unit, names in groupby(NAMES, FOUND.__getitem__)]
    assert len(runs) == len(set(FOUND.values()))
    assert runs[0][1] == [name for name in NAMES if group(name) is not None]
    assert all(len({name.split("::")[0] for name in names}) == 1 for _, names in runs[1:])


def test_units_are_smaller_the_less_is_left() -> None:
    sizes = Counter(FOUND.values())
    assert max(size for unit, size in sizes.items() if unit != FOUND[NAMES[0]]) == MOST
    for place, name in enumerate(NAMES):
        left = len(NAMES) - place
        assert group(name) is not None or sizes[FOUND[name]] <= max(1, (left + MOST) // (TURNS * WORKERS))
    assert {sizes[FOUND[name]] for name in NAMES[-TURNS * WORKERS :]} == {1}


class Gateway:
    id = "gw"


class Worker:
    """A worker that does what it is given."""

    shutting_down = False
    gateway = Gateway()

    def __init__(self, names: list[str]) -> None:
        self.names, self.left, self.done = names, list[int](), list[str]()

    def send_runtest_some(self, places: list[int]) -> None:
        self.left += places

    def shutdown(self) -> None:
        self.shutting_down = True


def test_the_longer_of_two_matching_places_decides_the_worker() -> None:
    assert _group("tests/browser/test_pages_browser.py::test_it") != _group("tests/browser/test_examples.py::test_it")
    assert _group("tests/trial/gym/test_gym_ids.py::test_it") is not None
    assert _group("tests/trial/test_match.py::test_it") is None


def test_every_place_that_the_order_names_exists() -> None:
    places = [*WEIGHTS, *(place for places in ONE_AFTER_ANOTHER for place in places)]
    assert [place for place in places if not (TESTS.parent / place).exists()] == []


def test_all_tests_are_done_once_and_what_is_done_is_forgotten() -> None:
    config: Any = SimpleNamespace(getvalue=lambda _: ["3*popen"], option=SimpleNamespace(loadscopereorder=True))
    scheduler, workers = InUnits(config, None, group), [Worker(NAMES) for _ in range(WORKERS)]
    for worker in workers:
        scheduler.add_node(worker)
        scheduler.add_node_collection(worker, NAMES)
    scheduler.schedule()
    while any(worker.left for worker in workers):
        for worker in workers:
            assert len(worker.left) > 1 or not scheduler.workqueue, "a worker runs a test once it knows the next"
            if worker.left:
                place = worker.left.pop(0)
                worker.done.append(NAMES[place])
                for _ in range(2):  # with subtests a test reports more than once
                    scheduler.mark_test_complete(worker, place)
            assert len(scheduler.assigned_work[worker]) <= 3  # of each a test is left
    assert sorted(name for worker in workers for name in worker.done) == sorted(NAMES)
    assert all(worker.shutting_down for worker in workers)
    assert not scheduler.has_pending
    assert not config.option.loadscopereorder
    (alone,) = (worker for worker in workers if NAMES[0] in worker.done)
    assert alone.done[:100] == NAMES[:100]


def test_files_of_two_kinds_take_turns_by_their_work() -> None:
    files = {"a/1": 10, "a/2": 30, "b/1": 1, "b/2": 2, "b/3": 1}
    found = interleaved(files, lambda file: file[0])
    assert found == {"a/1": 0, "a/2": 0.25, "b/1": 0, "b/2": 0.25, "b/3": 0.75}
