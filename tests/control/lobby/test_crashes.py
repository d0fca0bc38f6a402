"""Each call of each function of the lobby fails once with each fault; then other functions go on. No group is split or lost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from hippodrome.control.lobby import decisions
from hippodrome.control.lobby.lobby import LobbyState
from testing.exploration import sample, sample_of_each
from testing.port_faults import PortFault
from tests.control.lobby.interleaved import Crossing, Running
from tests.control.lobby.waiting_room import pairs, serve

FAULTS = [PortFault.CRASH_BEFORE, PortFault.CRASH_AFTER, PortFault.REPLY, PortFault.ERROR]
USERS = ["ann", "bob", "cem", "dan"]
Act = Callable[[Crossing], Running]


def visit(user: str) -> Act:
    return lambda crossing: crossing.visit(user)


def pair(crossing: Crossing) -> list[Act]:
    """Two participants come, are proposed, confirm, and get their memberships."""
    return [visit(user) for user in ("ann", "bob", "ann", "bob", "ann", "bob")]


def pair_with_a_server_ahead(crossing: Crossing) -> list[Act]:
    return [*(lambda c, u=user: c.under_way(u) for user in ("ann", "bob")), *pair(crossing)]


def pair_whose_server_is_ready_later(crossing: Crossing) -> list[Act]:
    return [*pair_with_a_server_ahead(crossing), lambda c: c.serve(), *pair(crossing)[:3]]


def two_pairs_whose_first_gets_the_server_of_the_second(crossing: Crossing) -> list[Act]:
    def serve_the_second(c: Crossing) -> Running:
        ids = [each["waits_for"]["id"] for each in c.decisions().get("formed", ()) if "waits_for" in each]
        for session_id in ids[1:]:
            serve(c.platform, c.project, session_id)
        return c.begin("serve", lambda lobby: None)

    begun = [*(lambda c, u=user: c.under_way(u) for user in USERS)]
    others = [visit(user) for user in ("cem", "dan", "cem", "dan")]
    return [*begun, *pair(crossing)[:4], *others, serve_the_second, visit("dan"), visit("ann"), visit("dan")]


def one_leaves(crossing: Crossing) -> list[Act]:
    return [visit("ann"), visit("bob"), lambda c: c.leave("bob"), visit("ann"), visit("bob"), *pair(crossing)]


def one_is_unmatched(crossing: Crossing) -> list[Act]:
    def late(c: Crossing) -> Running:
        c.platform.wait(seconds=27)
        return c.visit("ann")

    return [visit("ann"), late, late, visit("ann")]


def pair_with_a_sweep(crossing: Crossing) -> list[Act]:
    return [*pair_with_a_server_ahead(crossing)[:6], lambda c: c.repair(), lambda c: c.forget("ann"), visit("bob")]


JOURNEYS = [
    pair,
    pair_with_a_server_ahead,
    pair_whose_server_is_ready_later,
    two_pairs_whose_first_gets_the_server_of_the_second,
    one_leaves,
    one_is_unmatched,
    pair_with_a_sweep,
]


def play(crossing: Crossing, acts: list[Act], fault: PortFault | None, at: int) -> int:
    """Run these functions one after the other; the fault occurs at the call of this number. Returns the number of calls."""
    calls = 0
    for act in acts:
        crossing.platform.wait(seconds=1)
        one = act(crossing)
        crossing.finish(one, fault, at - calls)
        calls += one.calls
    return calls


@pytest.mark.explores
@pytest.mark.parametrize("journey", JOURNEYS)
def test_after_a_fault_at_any_call_later_requests_match_all_participants(
    journey: Callable[[Crossing], list[Act]],
) -> None:
    count = play(crossing := Crossing(pairs(patience=50)), journey(crossing), None, 0)
    assert count > 10
    points = [(at, fault) for at in range(1, count + 1) for fault in FAULTS]
    for at, fault in sample_of_each(points, 5, lambda point: point[1]):
        crossing = Crossing(pairs(patience=50))
        play(crossing, journey(crossing), fault, at)
        told: dict[str, Any] = {}
        for _ in range(40):
            crossing.serve()
            for user in USERS[: 4 if len(journey(crossing)) > 12 else 2]:
                told[user] = crossing.finish(crossing.visit(user)).result
            crossing.platform.wait(seconds=2)
        crossing.platform.wait(seconds=180)  # so that the sweep sends a lost start message again
        for _ in range(2):
            crossing.finish(crossing.repair())
            crossing.serve()
        where = f"{journey.__name__}, call {at} {fault}"
        assert not any(isinstance(one, LobbyState) for one in told.values()), where
        assert crossing.wrong(USERS, at_rest=True) == [], where
        assert crossing.decisions().keys() <= {"version", "open"}, where


def test_the_sweep_finishes_an_interrupted_session_if_no_member_asks() -> None:
    """The function that forms the session crashes after each of its calls in turn; the members have closed their pages."""
    count = play(crossing := Crossing(), pair(crossing)[:4], None, 0)
    for at in range(1, count + 1):
        crossing = Crossing()
        play(crossing, pair(crossing)[:4], PortFault.CRASH_AFTER, at)
        crossing.platform.wait(seconds=60)
        crossing.finish(crossing.repair())
        assert crossing.wrong(USERS, at_rest=True) == [], at
        assert crossing.decisions().keys() <= {"version", "open"}, at


def damage(crossing: Crossing) -> None:
    """Make the document of decisions unreadable."""
    crossing.platform.documents.kept[decisions.key(crossing.project.id)] = (b"{", '"damaged"', crossing.platform.now())


def ask_for(crossing: Crossing, users: list[str], seconds: int) -> None:
    for _ in range(seconds // 2):
        for user in users:
            crossing.finish(crossing.visit(user))
        crossing.platform.wait(seconds=2)


@pytest.mark.parametrize("goes_on", [False, True], ids=["crashed", "slow"])
def test_a_document_that_is_damaged_while_a_session_is_written_splits_no_group(goes_on: bool) -> None:
    """The function that writes the session has made each possible number of calls, and then ends or goes on half a minute later."""
    calls = play(crossing := Crossing(), pair(crossing)[:4], None, 0)
    before = play(crossing := Crossing(), pair(crossing)[:3], None, 0)
    for done in range(calls - before):
        crossing = Crossing(pairs(patience=900))
        play(crossing, pair(crossing)[:3], None, 0)
        crossing.platform.wait(seconds=1)
        writing = crossing.visit("bob")
        for _ in range(done):
            crossing.advance(writing)
        damage(crossing)
        ask_for(crossing, ["ann", "bob", "cem", "dan"], 24)
        if goes_on:
            crossing.finish(writing)
        else:
            crossing.running.remove(writing)
        ask_for(crossing, ["ann", "bob", "cem", "dan"], 60)
        assert crossing.wrong(USERS) == [], done
        crossing.finish(crossing.repair())
        crossing.serve()
        ask_for(crossing, ["ann", "bob", "cem", "dan"], 60)
        crossing.finish(crossing.repair())
        assert crossing.wrong(USERS, at_rest=True) == [], done
        assert [user for user in USERS if not crossing.membership(user)] == [], done


@pytest.mark.explores
def test_two_requests_in_any_order_form_each_pair_once() -> None:
    """Both members confirm and form the session at the same time: a sample of the orders of their first 12 calls."""
    for order in sample(range(2**12), 8):
        crossing = Crossing()
        play(crossing, pair(crossing)[:2], None, 0)
        crossing.platform.wait(seconds=1)
        both = [crossing.visit("ann"), crossing.visit("bob")]
        for bit in range(12):
            one = both[order >> bit & 1]
            if not one.is_over:
                crossing.advance(one)
        for one in both:
            crossing.finish(one)
        assert crossing.wrong(USERS) == [], order
        assert len(crossing.sessions()) == 1, order
        crossing.platform.wait(seconds=1)
        for user in ("ann", "bob"):
            crossing.finish(crossing.visit(user))
        assert crossing.wrong(USERS, at_rest=True) == [], order
