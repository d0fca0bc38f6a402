"""The contract of `hippodrome.control.ports.Timers`."""

from __future__ import annotations

from datetime import timedelta

import pytest

from hippodrome.control.ports import Platform, Timers
from tests.contract.backends import Backend, name

STOP = {"projectId": "study", "userId": "P1", "attempt": 1, "reason": "deadline"}
HOUR = timedelta(hours=1)


@pytest.fixture
def timers(platform: Platform) -> Timers:
    return platform.timers


def test_timers_are_listed_until_cancelled(timers: Timers, platform: Platform) -> None:
    assert list(timers.list()) == []
    for n in range(1, 4):
        timers.set(name(n), platform.now() + HOUR, STOP)
    timers.cancel(name(2))
    assert sorted(timers.list()) == [name(1), name(3)]


def test_a_timer_may_be_cancelled_twice(timers: Timers, platform: Platform) -> None:
    timers.set(name(), platform.now() + HOUR, STOP)
    timers.cancel(name())
    timers.cancel(name())
    timers.cancel(name(9))
    assert list(timers.list()) == []


def test_a_timer_publishes_its_message_to_the_stop_topic_once(backend: Backend) -> None:
    timers = backend.platform.timers
    timers.set(name(), backend.platform.now() + HOUR, STOP)
    assert backend.arrived("stop") == []
    backend.fire(name())
    assert backend.arrived("stop") == [STOP]
    assert list(timers.list()) == []
    timers.cancel(name())
    assert backend.arrived("start") == []


def test_a_timer_is_replaced_by_a_new_one_of_its_name(backend: Backend) -> None:
    timers = backend.platform.timers
    timers.set(name(), backend.platform.now() + 2 * HOUR, STOP)
    timers.set(name(), backend.platform.now() + HOUR, {**STOP, "reason": "another"})
    assert list(timers.list()) == [name()]
    backend.fire(name())
    assert backend.arrived("stop") == [{**STOP, "reason": "another"}]


def test_a_timer_may_be_set_again_after_it_fired_or_was_cancelled(backend: Backend) -> None:
    timers = backend.platform.timers
    timers.set(name(), backend.platform.now() + HOUR, STOP)
    backend.fire(name())
    timers.set(name(), backend.platform.now() + HOUR, STOP)
    timers.cancel(name())
    timers.set(name(), backend.platform.now() + HOUR, STOP)
    assert list(timers.list()) == [name()]


def test_a_timer_for_a_time_in_the_past_fires(backend: Backend) -> None:
    backend.platform.timers.set(name(), backend.platform.now() - HOUR, STOP)
    backend.fire(name())
    assert backend.arrived("stop") == [STOP]


def test_all_timers_are_listed_if_they_are_more_than_a_page_holds(timers: Timers, platform: Platform) -> None:
    wanted = [name(n, user) for user in ("P1", "P2") for n in range(1, 71)]
    for one in wanted:
        timers.set(one, platform.now() + HOUR, STOP)
    assert sorted(timers.list()) == sorted(wanted)
