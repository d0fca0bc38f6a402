"""The clocks of a session's members, without a game: their version changes whenever members are to be told something new."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from hippodrome.trial.core.presence import Presence, Rules


def comes_and_is_measured(presence: Presence, now: float) -> None:
    presence.come("right", now)
    presence.round_trip("right", 0.02, now)


def pauses(presence: Presence, now: float) -> None:
    presence.pauses()
    presence.may_play(now, on=False)


def counts_down_again(presence: Presence, now: float) -> None:
    presence.goes_on("left", now)
    presence.may_play(now, on=False)


CHANGES: dict[str, Callable[[Presence, float], object]] = {
    "comes": lambda presence, now: presence.come("left", now),
    "is fast enough": lambda presence, now: presence.round_trip("left", 0.02, now),
    "the other comes_and_is_measured": comes_and_is_measured,
    "looks away": lambda presence, now: presence.hides("left", now),
    "comes back": lambda presence, now: presence.come("left", now),
    "goes on": lambda presence, now: presence.goes_on("left", now),
    "the other goes on": lambda presence, now: presence.goes_on("right", now),
    "they count down": lambda presence, now: presence.may_play(now, on=False),
    "one pauses": pauses,
    "they count down again": counts_down_again,
    "they play": lambda presence, now: presence.may_play(now + 3, on=False),
    "a break begins": lambda presence, _: presence.begin_break(),
    "goes": lambda presence, now: presence.go("left", now),
    "is waited for no longer": lambda presence, now: presence.look(now + 30),
}


@pytest.mark.parametrize("last", CHANGES)
def test_the_version_changes_whenever_members_are_to_be_told_something_new(last: str) -> None:
    presence = Presence(Rules(30, 60, 3, 100, 1), ("left", "right"), reads=True, begun=False)

    def told() -> tuple[object, ...]:
        people = presence.people((), reads=presence.begun, plays_on=True)
        return people, presence.begins_in(100.0), presence.held_for(100.0, reads=presence.begun)

    for name, change in CHANGES.items():
        before, version = told(), presence.version
        change(presence, 100.0)
        if name == last:
            break
    assert told() != before, "this is about something that is told"
    assert presence.version != version
