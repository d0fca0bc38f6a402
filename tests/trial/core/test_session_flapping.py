"""A member whose connection comes and goes: how long the others are held, and who plays meanwhile."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.trial.session_driver import SessionDriver

ON = {"afterAbsent": "policy", "substitute": "random"}


def comes_and_goes(driver: SessionDriver, number: int, seconds: float, *, gone: float, there: float) -> float:
    """Let the member leave and come back in turns; return after how many seconds the trial was over, at most `seconds`."""
    since = driver.now
    while driver.now - since < seconds and not driver.trial.progress.over:
        driver.go(number).wait(gone)
        driver.come(number).wait(there)
    return driver.now - since


@pytest.mark.parametrize(("gone", "there"), [(0.025, 0.025), (0.001, 0.049), (0.1, 3.2), (5, 3.5)])
def test_a_member_who_comes_and_goes_all_the_time_ends_the_game_within_a_minute(gone: float, there: float) -> None:
    driver = SessionDriver(absent=10).begin().wait(60)
    assert comes_and_goes(driver, 0, 600, gone=gone, there=there) < 60
    assert driver.outcomes == {"P0": "left", "P1": "partnerLeft"}


@pytest.mark.parametrize(("gone", "there"), [(0.025, 0.025), (0.1, 3.2)])
def test_the_others_play_on_with_a_policy_while_a_member_comes_and_goes(gone: float, there: float) -> None:
    driver = SessionDriver(absent=10, **ON).begin().wait(2)
    comes_and_goes(driver, 0, 60, gone=gone, there=there)
    before = len(driver.taken)
    comes_and_goes(driver, 0, 30, gone=gone, there=there)
    assert len(driver.taken) - before > 220, "of 300, at ten steps a second"


def test_a_page_that_stops_answering_again_and_again_ends_the_game_within_a_minute() -> None:
    driver = SessionDriver(absent=10).begin().wait(60)
    session, since = driver.trial._participants, driver.now
    assert session is not None
    while driver.now - since < 600 and not driver.trial.progress.over:
        session.stalls("left", driver.now)
        driver.wait(0.1)
        session.answers_again("left", driver.now)
        driver.wait(0.1)
    assert driver.now - since < 60
    assert driver.outcomes == {"P0": "left", "P1": "partnerLeft"}


@pytest.mark.parametrize(("absent", "left"), [(30, [30, 27, 24]), (9, [9, 6, 3]), (6, [6, 4, 2])])
def test_each_absence_uses_at_least_three_seconds_or_a_third_of_absent(absent: int, left: list[int]) -> None:
    driver = SessionDriver(absent=absent).begin().take()
    for seconds in left:
        driver.go(0)
        assert driver.state_seen_by(1)["heldFor"] == seconds
        driver.come(0)


def test_the_others_do_not_wait_for_a_member_who_has_used_all_time_for_absences() -> None:
    driver = SessionDriver(absent=6).begin().take()
    for _ in range(3):
        driver.go(0).come(0)
    driver.go(0)
    assert driver.outcomes == {"P0": "left", "P1": "partnerLeft"}


def test_members_get_used_time_back_while_they_play() -> None:
    driver = SessionDriver(absent=10).begin().wait(1)
    driver.go(0).wait(8).come(0).wait(3 + 4 * 4)
    driver.go(0)
    assert driver.state_seen_by(1)["heldFor"] == pytest.approx(2 + 4, abs=0.3)
    driver.come(0).wait(60).go(0)
    assert driver.state_seen_by(1)["heldFor"] == pytest.approx(10)


@pytest.mark.parametrize("then", [
    lambda driver: driver.say(0, hidden=True),
    lambda driver: driver.say(1, command="pause").go(0),
    lambda driver: driver.say(1, command="start").take().wait(0.1).go(0),
], ids=["looks away", "goes in a pause", "goes after a start that changes nothing"])  # fmt: skip
def test_members_get_time_back_for_all_they_have_played_however_they_leave(
    then: Callable[[SessionDriver], object],
) -> None:
    driver = SessionDriver().begin().wait(1)
    driver.go(0).wait(20).come(0).wait(3 + 4 * 4)
    then(driver)
    assert driver.state_seen_by(1)["heldFor"] == pytest.approx(10 + 4, abs=0.3)


def test_a_pause_gives_no_time_back() -> None:
    driver = SessionDriver().begin().wait(1)
    driver.go(0).wait(20).come(0).wait(3.05).say(1, command="pause").wait(60).go(0)
    assert driver.state_seen_by(1)["heldFor"] == pytest.approx(10, abs=0.1)


@pytest.mark.parametrize("absent", [10, 3])
def test_a_member_gets_no_time_back_while_a_policy_plays_for_them(absent: int) -> None:
    driver = SessionDriver(absent=absent, **ON).begin().take().go(0).wait(60)
    driver.come(0).take().go(0).take()
    assert driver.state_seen_by(1)["people"]["left"] == "policy", "the others do not wait once more"
    assert driver.presence().count(("left", "replaced")) == 2


def test_while_all_are_gone_a_member_loses_only_the_time_that_another_has_waited() -> None:
    driver = SessionDriver().begin().take().go(0).wait(0.5).go(1).wait(100).come(1)
    assert driver.state_seen_by(1)["heldFor"] == pytest.approx(29.5)


@pytest.mark.parametrize(("absent", "gather"), [(10, 60), (30, 10)])
def test_a_member_who_comes_late_has_all_their_time_in_the_game(absent: int, gather: int) -> None:
    driver = SessionDriver(absent=absent, gather=gather).come(0).wait(9).come(1).wait(3.5)
    driver.go(1)
    assert driver.state_seen_by(0)["heldFor"] == pytest.approx(absent, abs=0.3)


def test_a_member_who_comes_and_goes_cannot_use_up_the_time_of_one_who_is_away() -> None:
    driver = SessionDriver(3, absent=30).begin().wait(60)
    driver.go(0)
    for _ in range(20):
        driver.go(1).wait(0.01).come(1).wait(0.01)
    assert driver.outcomes == {"P0": "partnerLeft", "P1": "left", "P2": "partnerLeft"}


def test_who_waits_and_loads_the_page_again_waits_no_less_for_who_has_not_come() -> None:
    driver = SessionDriver(gather=30).come(0).wait(29)
    driver.go(0)
    driver.come(0).wait(0.9)
    assert not driver.trial.progress.over
    driver.wait(0.2)
    assert driver.trial.progress.outcome == "partnerLeft"
