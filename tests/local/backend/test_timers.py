"""Timers on disk, and names in a file."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from hippodrome.control.ports import DnsRecord
from hippodrome.local.backend.dns import FileDns
from hippodrome.local.backend.timers import FolderTimers
from testing.waiting import until

Make = Callable[..., FolderTimers]


def _now() -> datetime:
    return datetime.now(UTC)


@pytest.fixture
def fired() -> list[Any]:
    return []


@pytest.fixture
def timers(tmp_path: Path, fired: list[Any]) -> Iterator[Make]:
    """A process's timers; the next call is the next process."""
    made: list[FolderTimers] = []

    def make(fire: Callable[[Any], None] = fired.append) -> FolderTimers:
        made.append(FolderTimers(tmp_path, fire, say=lambda text: None))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_a_timer_fires_when_it_is_due_and_is_deleted(timers: Make, fired: list[Any]) -> None:
    here = timers()
    here.start()
    here.set("late", _now() + timedelta(hours=1), {"n": 3})
    here.set("past", _now() - timedelta(seconds=1), {"n": 1})
    here.set("soon", _now() + timedelta(seconds=2), {"n": 2})
    until(lambda: len(fired) == 2)
    assert fired == [{"n": 1}, {"n": 2}]
    until(lambda: list(here.list()) == ["late"])


def test_a_timer_of_an_earlier_process_fires(timers: Make, fired: list[Any]) -> None:
    first = timers()
    first.set("overdue", _now() - timedelta(days=1), {"n": 1})
    first.set("soon", _now() + timedelta(seconds=2), {"n": 2})
    timers().start()
    until(lambda: len(fired) == 2)
    assert fired == [{"n": 1}, {"n": 2}]


def test_a_replaced_timer_fires_once_and_at_the_new_time(timers: Make, fired: list[Any]) -> None:
    here = timers()
    here.start()
    here.set("one", _now() + timedelta(seconds=3), {"n": "old"})
    due = (_now() + timedelta(seconds=5)).replace(microsecond=0)  # as AWS has it
    here.set("one", due, {"n": "new"})
    until(lambda: fired)
    assert fired == [{"n": "new"}]
    assert _now() >= due


def test_a_cancelled_timer_does_not_fire(timers: Make, fired: list[Any]) -> None:
    here = timers()
    here.start()
    here.set("one", _now() + timedelta(seconds=2), {})
    here.cancel("one")
    time.sleep(2.5)
    assert fired == []


def test_a_timer_that_cannot_publish_is_kept(timers: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(message: Any) -> None:
        raise OSError("the disk is full")

    here = timers(fail)
    here.start()
    here.set("one", _now(), {})
    time.sleep(0.5)
    assert list(here.list()) == ["one"]


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "x" * 65, "a b"])
def test_names_that_the_scheduler_of_aws_refuses_are_refused(timers: Make, name: str) -> None:
    with pytest.raises(ValueError):
        timers().set(name, _now(), {})


RECORD = DnsRecord("saaaaaaaaaaaaaaaaaaaa-1.localhost", "127.0.0.1")


def test_a_local_name_is_in_sync_at_once(tmp_path: Path) -> None:
    names = FileDns(tmp_path)
    assert names.change(add=[RECORD]) == ""
    assert names.in_sync("")
    assert list(FileDns(tmp_path).list()) == [RECORD]
    assert names.browser_host(RECORD) == "127.0.0.1"
