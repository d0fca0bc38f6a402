"""A member who looks at another page: the others do not begin without them, and do not wait for ever."""

from __future__ import annotations

import json

import pytest

from hippodrome.trial.core.effects import SendMessage
from tests.trial.core.trial_driver import Driver
from tests.trial.session_driver import SessionDriver

ON = {"afterAbsent": "policy", "substitute": "random"}


def people(driver: SessionDriver, number: int) -> dict[str, str]:
    return driver.state_seen_by(number)["people"]


def test_the_game_does_not_begin_while_a_member_looks_at_another_page() -> None:
    driver = SessionDriver(gather=60, countdown=3).come(0).come(1)
    driver.say(1, hidden=True).wait(30)
    assert not driver.taken
    assert people(driver, 0) == {"left": "here", "right": "away"}
    assert driver.state_seen_by(0)["heldFor"] == pytest.approx(57), "who comes after the first has used three seconds"
    driver.say(1, hidden=False).wait(2.9)
    assert not driver.taken, "the countdown begins anew"
    driver.wait(0.2)
    assert driver.taken


def test_the_others_wait_for_a_hidden_member_no_longer_than_for_one_who_does_not_come() -> None:
    driver = SessionDriver(gather=60).come(0).come(1).say(1, hidden=True).wait(60.1)
    assert driver.outcomes == {"P0": "partnerLeft", "P1": "left"}


def test_a_policy_gives_the_place_back_to_a_member_who_looks_again() -> None:
    driver = SessionDriver(gather=60, **ON).come(0).come(1).say(1, hidden=True).wait(65)
    assert driver.taken
    assert people(driver, 0)["right"] == "policy"
    driver.say(1, hidden=False).wait(1)
    assert people(driver, 0)["right"] == "here"
    assert driver.presence()[-3:] == [("right", "left"), ("right", "replaced"), ("right", "returned")]


def test_a_browser_that_answers_pings_for_a_hidden_page_does_not_take_the_place_back() -> None:
    driver = SessionDriver(gather=60, **ON).come(0).come(1).say(1, hidden=True).wait(65).round_trip(1, 0.02)
    assert people(driver, 0)["right"] == "policy"
    assert driver.presence()[-1] == ("right", "replaced")


def test_in_the_game_a_hidden_member_is_away_and_lets_go_of_their_keys() -> None:
    driver = SessionDriver(absent=30).begin().wait(2)
    driver.say(0, action="up", held=True).wait(0.2).say(0, hidden=True).wait(0.2)
    taken = len(driver.taken)
    assert driver.state_seen_by(1)["heldFor"] == pytest.approx(30, abs=0.3)
    driver.wait(10)
    assert len(driver.taken) == taken
    driver.say(0, hidden=False).wait(4)
    assert driver.taken[-1].actions["left"].name == "noop"


def test_a_key_that_a_hidden_page_holds_does_not_act_after_a_policy_has_played() -> None:
    driver = SessionDriver(absent=10, **ON).begin().say(1, hidden=True).say(1, action="up", held=True).wait(15)
    assert people(driver, 0)["right"] == "policy"
    driver.say(1, hidden=False).wait(1)
    assert driver.taken[-1].actions["right"].name == "noop"


def test_a_hidden_page_stays_hidden_until_it_says_that_it_is_seen_again() -> None:
    driver = SessionDriver().come(0).come(1).say(1, hidden=True)
    driver.say(1, command="requestUI").say(1, hidden=True).wait(5)
    assert people(driver, 0)["right"] == "away"
    assert driver.presence().count(("right", "left")) == 1


def test_a_hidden_page_whose_connection_is_lost_is_recorded_as_one_absence() -> None:
    driver = SessionDriver().begin().wait(1).say(1, hidden=True).wait(1).go(1).wait(1).come(1).wait(1)
    assert driver.presence()[-2:] == [("right", "left"), ("right", "returned")]
    assert driver.presence().count(("right", "left")) == 1


def test_a_hidden_page_that_stops_answering_and_answers_again_is_still_hidden() -> None:
    driver = SessionDriver().begin().wait(1).say(1, hidden=True)
    session = driver.trial._participants
    assert session is not None
    session.stalls("right", driver.now)
    session.answers_again("right", driver.now)
    driver.wait(1)
    assert people(driver, 0)["right"] == "away"
    assert driver.presence()[-1] == ("right", "left")


def test_a_page_that_connects_anew_is_not_hidden() -> None:
    driver = SessionDriver(countdown=3).come(0).come(1).say(1, hidden=True).wait(5).come(1).wait(3.1)
    assert driver.taken


def test_a_game_of_one_participant_refuses_the_message_hidden() -> None:
    driver = Driver()
    driver.begin()
    driver.connect()
    driver.say(hidden=True)
    assert [json.loads(said.text) for said in driver.of(SendMessage)][-1] == {"error": "unknown field 'hidden'"}
