"""Two participants in two real browsers who talk beside a game: examples/two-players with `chat: true`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from hippodrome.local.rehearsal.study_process import StudyProcess
from tests.browser.conftest import Hold
from tests.browser.test_two_participants import Person
from tests.browser.world import FLAWS, shot

pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]
CHANGES = {"  patience: 30\n": "  patience: 300\n", "  absent: 15\n": "  absent: 30\n  chat: true\n"}
LINES = "all => all.map(each => [each.classList.contains('mine'), each.querySelector('p').textContent])"


@pytest.fixture(scope="module")
def study(hold: Hold) -> StudyProcess:
    return hold("two-players", CHANGES)


@pytest.fixture
def pair(chromium: Any, study: StudyProcess) -> Iterator[tuple[Person, Person]]:
    """Two participants who play together, the second one on a phone."""
    ada, bert = Person(chromium, study, "ada"), Person(chromium, study, "bert", narrow=True)
    for person in (ada, bert):
        person.come_to_the_lobby()
    for person in (ada, bert):
        person.wait_until_playing()
    yield ada, bert
    for person in (ada, bert):
        person.context.close()
        assert person.complaints == []


def lines(person: Person) -> list[Any]:
    found: list[Any] = person.page.eval_on_selector_all("#chat-log .line", LINES)
    return found


def test_two_people_talk_beside_their_game(pair: tuple[Person, Person]) -> None:
    ada, bert = pair
    ada.page.focus("#chat-field")
    ada.page.keyboard.type("I take the ")
    bert.page.wait_for_selector("#chat-doing:text('is typing…')")
    ada.page.keyboard.type("left side")
    ada.page.keyboard.press("Enter")
    bert.page.wait_for_selector(".line >> text=I take the left side")
    bert.page.fill("#chat-field", "All right, <b>go</b>!")
    bert.page.tap("#chat-form button")
    ada.page.wait_for_selector(".line >> text=All right, <b>go</b>!")
    assert lines(ada) == [[True, "I take the left side"], [False, "All right, <b>go</b>!"]]
    bert.page.reload()
    bert.page.wait_for_selector(".line >> text=All right, <b>go</b>!")
    assert lines(bert) == [[False, "I take the left side"], [True, "All right, <b>go</b>!"]]
    for person, width in ((ada, 1280), (bert, 360)):
        assert person.page.evaluate(FLAWS) == []
        shot(person.page, f"{width}-two-people-talk")
