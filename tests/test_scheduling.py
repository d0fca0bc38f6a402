"""Which tests a worker gets at a time."""

from __future__ import annotations

import os
from collections import Counter
from itertools import groupby
from types import SimpleNamespace
from typing import Any

import pytest

from tests.conftest import ONE_AFTER_ANOTHER, TESTS, WAITING, _group
from tests.scheduling import MOST, TURNS, InUnits, units

WORKERS = 3
FILES = [f"tests/test_{number}.py" for number in range(30)]
SHARED = FILES[0]
WAIT = FILES[1:6]
NAMES = [f"{file}::test_it[{number}]" for file in FILES for number in range(100)]


def group(name: str) -> int | None:
    return 0 if name.startswith(SHARED) else None


def computes(name: str) -> bool:
    return name.split("::", maxsplit=1)[0] not in WAIT


FOUND = units(NAMES, group, computes, WORKERS)


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


def test_a_test_that_waits_is_a_unit() -> None:
    sizes = Counter(FOUND.values())
    assert {sizes[FOUND[name]] for name in NAMES if not computes(name)} == {1}


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
    places = [place for places in ONE_AFTER_ANOTHER for place in places]
    assert [place for place in places if not (TESTS.parent / place).exists()] == []
    assert [place for place in WAITING if not list(TESTS.parent.glob(f"{place}*"))] == []


def scheduled(number: int = WORKERS) -> tuple[InUnits, list[Worker], Any]:
    config: Any = SimpleNamespace(getvalue=lambda _: [f"{number}*popen"], option=SimpleNamespace(loadscopereorder=True))
    scheduler = InUnits(config, None, group, computes)
    workers = [Worker(NAMES) for _ in range(number)]
    for worker in workers:
        scheduler.add_node(worker)
        scheduler.add_node_collection(worker, NAMES)
    scheduler.schedule()
    return scheduler, workers, config


def work(scheduler: InUnits, worker: Worker) -> None:
    """Do one test."""
    place = worker.left.pop(0)
    worker.done.append(NAMES[place])
    for _ in range(2):  # with subtests a test reports more than once
        scheduler.mark_test_complete(worker, place)


def test_all_tests_are_done_once_and_what_is_done_is_forgotten() -> None:
    scheduler, workers, config = scheduled()
    while any(worker.left for worker in workers):
        for worker in workers:
            assert len(worker.left) > 1 or not scheduler.workqueue, "a worker runs a test once it knows the next"
            if worker.left:
                work(scheduler, worker)
            assert len(scheduler.assigned_work[worker]) <= 4  # of each a test is left
    assert sorted(name for worker in workers for name in worker.done) == sorted(NAMES)
    assert all(worker.shutting_down for worker in workers)
    assert not scheduler.has_pending
    assert not config.option.loadscopereorder
    (alone,) = (worker for worker in workers if NAMES[0] in worker.done)
    assert alone.done[:100] == NAMES[:100]


@pytest.mark.parametrize(("processors", "compute"), [(2, 2), (64, 3), (None, 1)])
def test_as_many_workers_compute_as_there_are_processors_but_at_most_half_while_the_others_wait(
    processors: int | None, compute: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: processors)
    scheduler, workers, _ = scheduled(6)
    for worker in workers:
        while not all(name.startswith(tuple(FILES[1:])) for name in [NAMES[place] for place in worker.left]):
            work(scheduler, worker)
    for _ in range(50):
        for worker in workers:
            work(scheduler, worker)
        assert sum(computes(NAMES[worker.left[-1]]) for worker in workers) == compute
    while any(worker.left for worker in workers):
        for worker in workers:
            if worker.left:
                work(scheduler, worker)
    assert sum(len(worker.done) for worker in workers) == len(NAMES)
