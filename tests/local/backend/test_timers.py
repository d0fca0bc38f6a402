"""Timers and names of one machine."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from hippodrome.control.ports import DnsRecord
from hippodrome.local.backend.dns import LocalDns
from hippodrome.local.backend.timers import LocalTimers
from testing.waiting import until


def _now() -> datetime:
    return datetime.now(UTC)


@pytest.fixture
def fired() -> list[Any]:
    return []


@pytest.fixture
def timers(fired: list[Any]) -> Iterator[LocalTimers]:
    made = LocalTimers(fired.append)
    yield made
    made.close()


def test_a_timer_fires_when_it_is_due_and_is_deleted(timers: LocalTimers, fired: list[Any]) -> None:
    timers.set("late", _now() + timedelta(hours=1), {"n": 3})
    timers.set("past", _now() - timedelta(seconds=1), {"n": 1})
    timers.set("soon", _now() + timedelta(seconds=2), {"n": 2})
    until(lambda: len(fired) == 2)
    assert fired == [{"n": 1}, {"n": 2}]
    until(lambda: list(timers.list()) == ["late"])


def test_a_replaced_timer_fires_once_and_at_the_new_time(timers: LocalTimers, fired: list[Any]) -> None:
    timers.set("one", _now() + timedelta(seconds=3), {"n": "old"})
    due = (_now() + timedelta(seconds=5)).replace(microsecond=0)  # as AWS has it
    timers.set("one", due, {"n": "new"})
    until(lambda: fired)
    assert fired == [{"n": "new"}]
    assert _now() >= due


def test_a_cancelled_timer_does_not_fire(timers: LocalTimers, fired: list[Any]) -> None:
    timers.set("one", _now() + timedelta(seconds=2), {})
    timers.cancel("one")
    time.sleep(2.5)
    assert fired == []


RECORD = DnsRecord("saaaaaaaaaaaaaaaaaaaa-1.localhost", "127.0.0.1")


def test_a_local_name_is_in_sync_at_once() -> None:
    names = LocalDns()
    assert names.change(add=[RECORD]) == ""
    assert names.in_sync("")
    assert names.has(RECORD.name)
    assert names.browser_host(RECORD) == "127.0.0.1"
