"""The contract of `hippodrome.control.ports.Tasks`."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from hippodrome.control.ports import Platform, Tasks
from tests.contract.backends import Backend, concurrent, name

CLUSTER = "hippodrome"


@pytest.fixture
def tasks(platform: Platform) -> Tasks:
    return platform.tasks


def test_a_task_is_found_and_listed_by_its_name(backend: Backend, tasks: Tasks) -> None:
    first, second = tasks.run(backend.request(name(1))), tasks.run(backend.request(name(2)))
    assert first != second
    assert tasks.find(name(1), CLUSTER) == first
    assert tasks.find(name(3), CLUSTER) is None
    assert whose(tasks) == {(first, CLUSTER, name(1)), (second, CLUSTER, name(2))}


def whose(tasks: Tasks) -> set[tuple[str, str, str]]:
    return {(task.task, task.cluster, task.name) for task in tasks.list()}


def test_a_listed_task_that_runs_has_its_network_interface(backend: Backend, tasks: Tasks) -> None:
    interface = backend.interface(tasks.run(backend.request(name())))
    (listed,) = tasks.list()
    assert (listed.interface, listed.runs) == (interface, True)
    assert set(tasks.addresses([interface])) == {interface}


def test_a_repeated_run_starts_one_task(backend: Backend, tasks: Tasks) -> None:
    request = backend.request(name())
    assert tasks.run(request) == tasks.run(request)
    assert len(list(tasks.list())) == 1


@concurrent
def test_many_runs_at_once_start_one_task(backend: Backend, tasks: Tasks) -> None:
    request = backend.request(name())
    with ThreadPoolExecutor(4) as threads:
        assert len(set(threads.map(lambda _: tasks.run(request), range(4)))) == 1
    assert len(list(tasks.list())) == 1


def test_a_repetition_with_another_environment_is_still_the_same_task(backend: Backend, tasks: Tasks) -> None:
    request = backend.request(name())
    other = backend.request(name(), environment={**request.environment, "STEP": "3"})
    assert tasks.run(request) == tasks.run(other)


def test_a_task_may_be_stopped_twice(backend: Backend, tasks: Tasks) -> None:
    task = tasks.run(backend.request(name()))
    tasks.stop(task, CLUSTER, "hippodrome: the stop step")
    tasks.stop(task, CLUSTER, "hippodrome: the stop step")
    assert tasks.find(name(), CLUSTER) is None
    assert list(tasks.list()) == []


def test_stopping_a_task_that_never_ran_changes_nothing(backend: Backend, tasks: Tasks) -> None:
    task = tasks.run(backend.request(name()))
    other = task[:-5] + "fedcb"
    tasks.stop(other, CLUSTER, "hippodrome: never was")
    tasks.stop(other, name(9), "hippodrome: in a cluster that is not there")
    assert tasks.find(name(), CLUSTER) == task


def test_running_tasks_have_different_addresses_and_no_tasks_none(backend: Backend, tasks: Tasks) -> None:
    running = [backend.interface(tasks.run(backend.request(name(n)))) for n in (1, 2)]
    found = tasks.addresses(running)
    assert sorted(found) == sorted(running)
    assert len(set(found.values())) == 2
    assert all(host.count(".") == 3 and (port is None or 0 < port < 65536) for host, port in found.values())
    assert tasks.addresses([]) == {}


def test_interfaces_without_an_address_are_left_out(backend: Backend, tasks: Tasks) -> None:
    running = backend.interface(tasks.run(backend.request(name())))
    assert list(tasks.addresses([running, "eni-0000000000000bare", running])) == [running]


def test_a_participants_own_cluster_exists_as_long_as_its_task(backend: Backend, tasks: Tasks) -> None:
    tasks.create_cluster(name())
    tasks.create_cluster(name())
    assert list(tasks.clusters()) == [name()]
    task = tasks.run(backend.request(name(), cluster=name()))
    assert tasks.find(name(), name()) == task
    assert whose(tasks) == {(task, name(), name())}
    with pytest.raises(Exception):  # noqa: B017 - what the backend raises; the caller's queue tries again
        tasks.delete_cluster(name())
    assert list(tasks.clusters()) == [name()]
    tasks.stop(task, name(), "hippodrome: the stop step")
    tasks.delete_cluster(name())
    tasks.delete_cluster(name())
    assert list(tasks.clusters()) == []
    assert tasks.find(name(), name()) is None


def test_a_missing_cluster_may_be_deleted(tasks: Tasks) -> None:
    tasks.delete_cluster(name(7))
    assert list(tasks.clusters()) == []
