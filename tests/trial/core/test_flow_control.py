"""How many frames may be under way to a client."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.trial.core.clients import Client
from hippodrome.trial.core.timing import Window
from hippodrome.trial.settings import STALLED_SECONDS


def test_more_frames_may_be_under_way_if_the_round_trip_is_longer():
    for round_trip, rate, wanted in ((0.001, 30, 3), (0.1, 30, 5), (0.1, 60, 8), (10, 60, 15)):
        window = Window()
        assert window.wait(0.0, rate) == 0.0
        window.sent(1, 0.0)
        window.acknowledged(1, round_trip)
        under_way = 0
        while window.wait(100.0, rate) == 0.0:
            window.sent(2 + under_way, 100.0)
            under_way += 1
        assert under_way == wanted
        assert window.wait(100.5, rate) == pytest.approx(0.5)
        assert window.wait(101.0, rate) == 0.0
        assert not window.stalled(100.0 + STALLED_SECONDS)
        assert window.stalled(100.1 + STALLED_SECONDS)
        window.acknowledged(2, 104.0)
        assert window.wait(104.0, rate) == 0.0


def send_until_it_must_wait(window: Window, rate: int, first: int, now: float) -> int:
    """Send frames from number `first` on, until one must wait for an acknowledgement; return how many were sent."""
    number = first
    while window.wait(now, rate) == 0.0:
        window.sent(number, now)
        number += 1
    return number - first


def test_a_client_is_stalled_if_two_looks_a_tenth_of_a_second_apart_find_it_so():
    window = Window()
    client = Client("tab", window, "player_0")
    window.sent(1, -10.0)
    window.acknowledged(1, -9.9)
    window.sent(2, -9.0)
    window.sent(3, -9.0)
    assert [client.stalled(now) for now in (0.0, 0.05, 0.1)] == [None, None, True]
    window.acknowledged(2, 0.1)
    assert [client.stalled(now) for now in (1.0, 1.2)] == [None, True], "it has acknowledged one since"
    window.acknowledged(3, 1.2)
    assert client.stalled(1.3) is False


def test_a_client_that_acknowledges_two_frames_at_once_may_have_one_more_under_way():
    window = Window()
    window.sent(1, 0.0)
    window.acknowledged(1, 0.1)
    window.sent(2, 1.0)
    window.sent(3, 1.0)
    window.acknowledged(3, 1.1)
    assert send_until_it_must_wait(window, 30, 4, 2.0) == 6
    window.acknowledged(9, 2.2)  # the six of them
    window.sent(10, 3.0)
    window.acknowledged(10, 3.1)
    assert send_until_it_must_wait(window, 30, 11, 4.0) == 5, "it acknowledges each frame again"


def test_frames_that_are_acknowledged_in_pairs_never_wait():
    """Round trips that vary by a frame: the client acknowledges every second frame as it is drawn."""
    rate, window, acks = 30, Window(), []
    for number in range(1, 300):
        now = number / rate
        while acks and acks[0][1] <= now:
            window.acknowledged(*acks.pop(0))
        assert window.wait(now, rate) == 0.0, number
        window.sent(number, now)
        if number % 2 or number < 3:
            acks.append((number, now + 0.1 + number % 3 / rate / 2))


def _is_between_frames(round_trip):
    """At a whole number of frames, rounding decides: 0.25 + 0.3 - 0.25 is more than 0.3."""
    return abs(round_trip * 30 - round(round_trip * 30)) > 1e-9


@given(
    st.floats(0.05, 1.0).filter(_is_between_frames),
    st.lists(st.tuples(st.floats(0.001, 0.3), st.booleans()), min_size=1, max_size=60),
)
def test_rows_of_a_picture_do_not_make_the_round_trip_seem_shorter(round_trip, sendings):
    """Several messages with one id are under way, and the client may acknowledge an earlier one of them."""
    window, now, number, acks = Window(), 0.0, 1, []
    for pause, is_new in sendings:
        now += pause
        while acks and acks[0][1] <= now:
            window.acknowledged(*acks.pop(0))
        number += is_new
        window.sent(number, now)
        acks.append((number, now + round_trip))
    for ack in acks:
        window.acknowledged(*ack)
    window.sent(number + 1, now + 2)
    under_way = 1
    while window.wait(now + 2, 30) == 0.0:
        under_way += 1
        window.sent(number + under_way, now + 2)
    assert under_way == min(2 + math.ceil(round_trip * 30), 15)
