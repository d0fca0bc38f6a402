"""The contract of `hippodrome.control.ports.Dns`."""

from __future__ import annotations

import time

import pytest

from hippodrome.control.ports import Dns, DnsRecord, Platform
from tests.contract.backends import name

RECORDS = [DnsRecord(f"{name(n)}.servers.example.org", f"203.0.113.{n}") for n in range(1, 5)]


@pytest.fixture
def names(platform: Platform) -> Dns:
    return platform.dns


def test_added_names_are_listed(names: Dns) -> None:
    change = names.change(add=RECORDS)
    _wait(names, change)
    assert sorted(names.list()) == sorted(RECORDS)


def test_removed_names_are_not_listed(names: Dns) -> None:
    names.change(add=RECORDS)
    _wait(names, names.change(remove=RECORDS[:3]))
    assert list(names.list()) == RECORDS[3:]


def test_names_may_be_removed_twice(names: Dns) -> None:
    names.change(add=RECORDS)
    names.change(remove=RECORDS[:2])
    _wait(names, names.change(remove=RECORDS[:3]))
    assert list(names.list()) == RECORDS[3:]
    _wait(names, names.change(remove=RECORDS))
    _wait(names, names.change(remove=RECORDS))
    assert list(names.list()) == []


def test_one_change_may_add_names_and_remove_missing_ones(names: Dns) -> None:
    _wait(names, names.change(add=RECORDS[:1], remove=RECORDS[1:]))
    assert list(names.list()) == RECORDS[:1]


def test_one_change_may_name_a_removal_twice(names: Dns) -> None:
    names.change(add=RECORDS)
    names.change(remove=[RECORDS[0], RECORDS[0]])
    assert sorted(names.list()) == sorted(RECORDS[1:])


def test_a_name_that_has_another_address_now_is_not_removed(names: Dns) -> None:
    names.change(add=RECORDS[:1])
    names.change(remove=[DnsRecord(RECORDS[0].name, "203.0.113.99")])
    assert list(names.list()) == RECORDS[:1]


def test_a_name_that_is_added_again_gets_the_new_address(names: Dns) -> None:
    names.change(add=RECORDS[:1])
    names.change(add=RECORDS[:1])
    assert list(names.list()) == RECORDS[:1]
    elsewhere = DnsRecord(RECORDS[0].name, "203.0.113.99")
    names.change(add=[elsewhere])
    assert list(names.list()) == [elsewhere]


def test_an_empty_change_is_in_sync(names: Dns) -> None:
    assert names.in_sync(names.change())
    assert names.in_sync(names.change(remove=RECORDS))


def test_a_browser_connects_to_the_name_or_the_address(names: Dns) -> None:
    assert names.browser_host(RECORDS[0]) in RECORDS[0]


def _wait(names: Dns, change: str) -> None:
    for _ in range(50):
        if names.in_sync(change):
            return
        time.sleep(0.1)
    raise AssertionError("the change never reached every name server")
