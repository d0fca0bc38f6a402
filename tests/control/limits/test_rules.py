"""The rules of slots, one by one, without a platform."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime, timedelta

import msgspec
import pytest

from hippodrome.control.limits import rules as limits
from hippodrome.control.limits.rules import ParticipantSlots, ServerSlot, ServerSlots
from hippodrome.control.model import ids, server
from hippodrome.control.model.server import Reason, Server
from testing.fake_platform import FakePlatform
from testing.studies import study

NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)
SETTINGS = FakePlatform().settings
WARM_SERVER = ids.warm_id("maze", NOW, 0)


def claimed(user: str = "alice", attempt: int = 1) -> Server:
    """Return a server that reserves 1800 seconds; a warm server, 3600."""
    record = server.new_attempt(study(), user, attempt, nonce="t", settings=SETTINGS, now=NOW)
    lasts = timedelta(hours=1) if record.is_warm_server else timedelta(minutes=30)
    return msgspec.structs.replace(record, deadline=NOW + lasts)


ALICE, BOB = claimed().label, claimed("bob").label


def test_the_keys_of_the_documents_of_slots() -> None:
    assert limits.participant_slots_folder("maze") == "maze/slots/"
    assert limits.participant_slots_key("maze", 3) == "maze/slots/3.json"
    assert limits.server_slots_key("maze") == "_slots/maze.json"


# Participants


def test_a_slot_is_taken_once_and_only_where_there_is_room() -> None:
    one = ParticipantSlots().with_participant("a", usual=2)
    assert one == ParticipantSlots(("a",), 2)
    assert one.with_participant("a", usual=2) is one
    two = one.with_participant("b", usual=9)
    assert two == ParticipantSlots(("a", "b"), 2), "the room that was written down counts"
    assert two.with_participant("c", usual=9) is two
    assert two.without("a") == ParticipantSlots(("b",), 2)
    assert ParticipantSlots().with_participant("a", usual=0) == ParticipantSlots()


def test_participants_who_came_before_the_limit_keep_their_slots() -> None:
    frozen = ParticipantSlots(("a",), 9).without_room(["b", "a"])
    assert frozen == ParticipantSlots(("a", "b"), 2)
    assert frozen.with_room_for(3) == ParticipantSlots(("a", "b"), 5)
    assert limits.counts([frozen, ParticipantSlots()]) == [2, 0]


@pytest.mark.parametrize("limit", [1, 5, 16, 17, 100])
def test_the_shards_share_the_limit_as_evenly_as_they_can(limit: int) -> None:
    shares = [limits.shard_share(limit, shard) for shard in range(limits.SHARDS)]
    assert sum(shares) == limit
    assert max(shares) - min(shares) <= 1
    assert shares == sorted(shares, reverse=True), "the first ones have more, since homes are looked for there"
    homes = Counter(limits.first_shard(str(number), limit) for number in range(2000))
    assert set(homes) == set(range(min(limits.SHARDS, limit)))


def test_a_limit_is_divided_when_the_rooms_of_all_shards_add_up_to_it() -> None:
    usual = [ParticipantSlots() for _ in range(limits.SHARDS)]
    assert limits.is_divided(20, usual)
    assert not limits.is_divided(20, [ParticipantSlots(room=3), *usual[1:]])
    assert not limits.is_divided(20, [ParticipantSlots(room=1), *usual[1:]])
    full = [ParticipantSlots(("a", "b"), 0), *(ParticipantSlots(room=0) for _ in usual[1:])]
    assert limits.is_divided(2, full)
    assert limits.is_divided(1, full), "more are there than may come, and nobody else is let in"
    assert not limits.is_divided(3, full)


# Servers


def test_a_server_reserves_what_it_may_use_and_counts_what_it_has_used() -> None:
    record = claimed()
    assert limits.seconds_reserved(record) == 1800
    assert limits.seconds_reserved(msgspec.structs.replace(record, deadline=NOW + timedelta(seconds=9.1))) == 10
    ends = [NOW + timedelta(seconds=seconds) for seconds in (5, 60, 60.5, 600)]
    assert [limits.seconds_used(record, Reason.STOPPED, end) for end in ends] == [60, 60, 61, 600]
    assert [limits.seconds_used(record, reason, ends[-1]) for reason in Reason] == [
        0 if reason in (Reason.REFUSED, Reason.NO_CAPACITY) else 600 for reason in Reason
    ]


def test_a_server_takes_a_slot_while_one_is_free() -> None:
    two = study(max_servers=2)
    one = ServerSlots(used=5).with_server(two, claimed())
    assert one == ServerSlots({ALICE: ServerSlot(1, 1800)}, 5)
    assert one.with_server(two, claimed()) is one
    full = one.with_server(two, claimed("bob"))
    assert full is not None
    assert full.names == [f"{ALICE}-1", f"{BOB}-1"]
    assert full.with_server(two, claimed("carol")) is None
    again = full.with_server(two, claimed(attempt=2))
    assert again == ServerSlots({BOB: ServerSlot(1, 1800), ALICE: ServerSlot(2, 1800)}, 1805), (
        "the first attempt counts with all it had"
    )


def test_hours_are_reserved_to_the_second() -> None:
    hour = study(max_server_hours=1)
    half = ServerSlots(used=1800)
    assert half.with_server(hour, claimed()) == ServerSlots({ALICE: ServerSlot(1, 1800)}, 1800)
    assert ServerSlots(used=1801).with_server(hour, claimed()) is None
    assert ServerSlots({BOB: ServerSlot(1, 1800)}).with_server(hour, claimed()) is not None
    assert ServerSlots({BOB: ServerSlot(1, 1801)}).with_server(hour, claimed()) is None
    assert ServerSlots({ALICE: ServerSlot(1, 1800)}, 1).with_server(hour, claimed(attempt=2)) is None


def test_warm_servers_keep_no_participant_out_and_get_only_slots_that_are_left() -> None:
    one = study(max_servers=1, max_server_hours=1)
    warm_server = ServerSlots().with_server(one, claimed(WARM_SERVER))
    assert warm_server == ServerSlots({claimed(WARM_SERVER).label: ServerSlot(1, 3600, True)})
    assert warm_server.with_server(one, claimed()) is not None
    assert ServerSlots({ALICE: ServerSlot(1)}).with_server(one, claimed(WARM_SERVER)) is None
    another = ids.warm_id("maze", NOW, 1)
    assert warm_server.with_server(one, claimed(another)) is None


@pytest.mark.parametrize(
    ("changes", "seconds", "room"),
    [
        ({}, 60, None),
        ({"max_servers": 3}, 60, 1),
        ({"max_servers": 1}, 60, -1),
        ({"max_server_hours": 2}, 600, 5),
        ({"max_server_hours": 1}, 600, -1),
        ({"max_servers": 3, "max_server_hours": 2}, 600, 1),
        ({"max_servers": 9, "max_server_hours": 2}, 600, 5),
    ],
)
def test_the_number_of_free_slots_follows_from_servers_and_hours(
    changes: dict[str, int], seconds: int, room: int | None
) -> None:
    running = ServerSlots({ALICE: ServerSlot(1, 1800), BOB: ServerSlot(1, 1800, True)}, 300)
    assert running.free_slots(study(**changes), seconds) == room


def test_a_server_that_ends_counts_once_and_no_more_than_it_reserved() -> None:
    running = ServerSlots({ALICE: ServerSlot(2, 1800), BOB: ServerSlot(1, 1800)}, 100)
    left = running.released(claimed(attempt=2), 60)
    assert left == ServerSlots({BOB: ServerSlot(1, 1800)}, 160)
    assert left.released(claimed(attempt=2), 60) == left
    assert running.released(claimed(attempt=1), 60) == running, "an earlier attempt's end"
    assert running.released(claimed(attempt=2), 9999).used == 1900
    assert running.released(claimed(attempt=2), 60, keep=True) == ServerSlots(
        {BOB: ServerSlot(1, 1800), ALICE: ServerSlot(2)}, 160
    )


def test_a_server_of_unknown_use_counts_with_all_that_it_reserved() -> None:
    running = ServerSlots({ALICE: ServerSlot(2, 1800), BOB: ServerSlot(1, 60)}, 100)
    assert running.without(ALICE) == ServerSlots({BOB: ServerSlot(1, 60)}, 1900)
    assert running.without("unknown") is running
