"""Which resources are left over, and why: one table for the sweep, `stop`, `erase` and `destroy`."""

from __future__ import annotations

from datetime import timedelta

import msgspec
import pytest

from hippodrome.control.model import ids, server
from hippodrome.control.model.server import Reason, Server
from hippodrome.control.ports import Address, DnsRecord, RunningTask
from hippodrome.control.servers import leftovers
from hippodrome.control.servers.leftovers import LeftoverReason, Scope, why_left_over, why_slot_left_over
from hippodrome.control.servers.overdue import LOST_AFTER
from hippodrome.control.servers.resources import Resources
from tests.control.model.test_server import LABEL, LATER, NOW, WARM_SERVER, new_record

FIRST, SECOND, THIRD = (ids.server_name(LABEL, attempt) for attempt in (1, 2, 3))
WARM_NAME = ids.server_name(ids.server_label("maze", WARM_SERVER), 1)
IF_REPLACED = {
    "SWEEP": LeftoverReason.REPLACED,
    "EARLY": LeftoverReason.REPLACED,
    "STOP": LeftoverReason.REPLACED,
    "STOP_MAZE": LeftoverReason.REPLACED,
    "ERASE": LeftoverReason.ERASED,
}
OPEN = new_record(attempt=2)
CLOSED = server.close(OPEN, Reason.STOPPED, LATER)
ON_WARM = msgspec.structs.replace(OPEN, warm_server_name=WARM_NAME)
OFF_WARM = server.close(ON_WARM, Reason.STOPPED, LATER)

SWEEP = Scope(closed_by=LATER)
EARLY = Scope(closed_by=LATER - timedelta(seconds=1))
STOP = Scope(without_record=True)
STOP_MAZE = Scope(project_id="maze", without_record=True)
STOP_OTHER = Scope(project_id="other", without_record=True)
ERASE = Scope(labels=frozenset({LABEL}), names=frozenset({WARM_NAME}))

TABLE: list[tuple[str, str, Server | None, bool, dict[str, LeftoverReason | None]]] = [
    ("of an open server", SECOND, OPEN, True, {"ERASE": LeftoverReason.ERASED}),
    (
        "of a closed server",
        SECOND,
        CLOSED,
        False,
        {
            "SWEEP": LeftoverReason.CLOSED,
            "STOP": LeftoverReason.CLOSED,
            "STOP_MAZE": LeftoverReason.CLOSED,
            "ERASE": LeftoverReason.ERASED,
        },
    ),
    ("of the attempt before", FIRST, OPEN, False, IF_REPLACED),
    ("of an attempt to come", THIRD, OPEN, True, {"ERASE": LeftoverReason.ERASED}),
    ("of an attempt after a closed one", THIRD, CLOSED, True, {"ERASE": LeftoverReason.ERASED}),
    ("of the attempt that was given up for a warm server", SECOND, ON_WARM, False, IF_REPLACED),
    ("of an assigned warm server", WARM_NAME, ON_WARM, True, {"ERASE": LeftoverReason.ERASED}),
    (
        "of a warm server whose participant's server is closed",
        WARM_NAME,
        OFF_WARM,
        False,
        {
            "SWEEP": LeftoverReason.CLOSED,
            "STOP": LeftoverReason.CLOSED,
            "STOP_MAZE": LeftoverReason.CLOSED,
            "ERASE": LeftoverReason.ERASED,
        },
    ),
    ("without a record, where another installation's may lie", FIRST, None, False, {"ERASE": LeftoverReason.ERASED}),
    (
        "without a record, where only ours are",
        FIRST,
        None,
        True,
        {"STOP": LeftoverReason.NO_RECORD, "ERASE": LeftoverReason.ERASED},
    ),
    ("of no server's name", "www", None, True, {}),
    ("of no server's name, with a record", "www", CLOSED, True, {}),
]


@pytest.mark.parametrize("scope", ["SWEEP", "EARLY", "STOP", "STOP_MAZE", "STOP_OTHER", "ERASE"])
@pytest.mark.parametrize(("name", "owner", "ours", "whys"), [row[1:] for row in TABLE], ids=[row[0] for row in TABLE])
def test_the_reason_for_which_a_resource_is_left_over(
    name: str, owner: Server | None, ours: bool, whys: dict[str, LeftoverReason | None], scope: str
) -> None:
    assert why_left_over(name, owner, globals()[scope], ours=ours) is whys.get(scope)


def test_without_ours_a_resource_may_be_another_installations() -> None:
    assert why_left_over(FIRST, None, STOP) is None


def test_only_stop_removes_leftovers_of_a_record_without_the_time_of_closing() -> None:
    undated = msgspec.structs.replace(CLOSED, closed=None)
    assert why_left_over(SECOND, undated, SWEEP) is None
    assert why_left_over(SECOND, undated, STOP) is LeftoverReason.CLOSED


@pytest.mark.parametrize(
    ("name", "owner", "after", "why"),
    [
        (SECOND, OPEN, timedelta(days=1), None),
        (SECOND, CLOSED, LOST_AFTER, None),
        (SECOND, CLOSED, LOST_AFTER + timedelta(seconds=1), LeftoverReason.CLOSED),
        (FIRST, OPEN, timedelta(days=1), None),
        (FIRST, CLOSED, LOST_AFTER + timedelta(seconds=1), LeftoverReason.CLOSED),
        (SECOND, None, timedelta(0), LeftoverReason.NO_RECORD),
        ("www", None, timedelta(days=1), None),
    ],
)
def test_the_reason_for_which_a_slot_is_left_over(
    name: str, owner: Server | None, after: timedelta, why: LeftoverReason | None
) -> None:
    assert why_slot_left_over(name, owner, LATER + after) is why


def test_leftovers_of_every_kind_are_found() -> None:
    """Tasks in the installation's cluster and timers can only be its own; names and other clusters may be another installation's."""
    named = server.naming(CLOSED, "task/2", Address("203.0.113.2", 443), NOW)
    closed = server.close(named, Reason.STOPPED, LATER)
    strange = ids.server_name(ids.server_label("maze", "bob"), 1)
    mine, own, theirs = (
        RunningTask("task/2", "hippodrome", SECOND),
        RunningTask("task/3", "hippodrome", strange),
        RunningTask("task/4", strange, strange),
    )
    records = [DnsRecord(f"{name}.example.org", "203.0.113.2") for name in (SECOND, strange)]
    found = Resources(
        [mine, own, theirs], records, [SECOND, ids.delayed_timer(strange), "www"], [SECOND, strange], "hippodrome"
    )
    assert leftovers.leftovers(found, {SECOND: closed}, STOP) == Resources(
        [mine, own], records[:1], [SECOND, ids.delayed_timer(strange)], [SECOND], "hippodrome"
    )
    assert leftovers.leftovers(found, {SECOND: closed}, SWEEP) == Resources(
        [mine], records[:1], [SECOND], [SECOND], "hippodrome"
    )
