"""Two participants in two real browsers, from the link to the end: examples/two-players, one of them on a phone."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hippodrome.bots.links import with_user
from hippodrome.local.rehearsal.study_process import StudyProcess
from hippodrome.trial.recordings.recording import read
from hippodrome.trial.settings import STALLED_SECONDS
from tests.browser.conftest import Hold
from tests.browser.test_together_browser import asleep, players_shown, wait_for_text
from tests.browser.world import FLAWS, shot

pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]
CHANGES = {
    "afterAbsent: policy\n": "afterAbsent: end\n",
    # On a busy machine the second participant may come late, and a page needs seconds to load again.
    "  patience: 30\n": "  patience: 300\n",
    "  absent: 15\n": "  absent: 30\n",
}


@pytest.fixture(scope="module")
def study(hold: Hold) -> StudyProcess:
    return hold("two-players", CHANGES, stalled=STALLED_SECONDS)


NOTE_TITLES = """() => {
    const title = document.getElementById("overlay-title");
    window.titles = [];
    new MutationObserver(() => window.titles.push(title.textContent)).observe(title, { childList: true, characterData: true, subtree: true });
}"""


class Person:
    """A participant in a browser of their own."""

    def __init__(self, chromium: Any, study: StudyProcess, name: str, *, narrow: bool = False) -> None:
        size = {"width": 360, "height": 740} if narrow else {"width": 1280, "height": 800}
        self.context = chromium.new_context(viewport=size, has_touch=narrow, is_mobile=narrow)
        self.context.set_default_timeout(45_000)
        self.study, self.name, self.narrow = study, name, narrow
        self.link = with_user(study.link, name)
        self.complaints: list[str] = []
        self.page = self.tab()

    def tab(self) -> Any:
        page = self.context.new_page()
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", lambda said: self.complaints.append(said.text) if said.type == "error" else None)
        return page

    def come_to_the_lobby(self) -> None:
        self.page.goto(self.link)
        for step in ("2", "3"):
            for field in self.page.locator("input[type=checkbox], input[value=never]").all():
                field.check()
            self.page.locator("form.page button:not([type=button])").last.click()
            self.page.wait_for_selector(f"body[data-step='{step}']")

    def wait_for_title(self, title: str) -> None:
        self.page.wait_for_selector(f"#overlay-title:text('{title}'):visible")

    def wait_for_earlier_title(self, title: str) -> None:
        """Wait until the overlay has shown this title at any time since `NOTE_TITLES` or the last call."""
        self.page.wait_for_function("title => window.titles.includes(title)", arg=title)
        self.page.evaluate("window.titles = []")

    def wait_until_playing(self) -> None:
        self.page.wait_for_selector("#play[data-state=playing]", state="attached")

    def answers(self, step: str = "3") -> dict[str, Any]:
        path = self.study.data / "two-players" / "users" / self.name / "answers" / f"{step}.json"
        found: dict[str, Any] = json.loads(path.read_text())["answers"]
        return found


@pytest.fixture
def come(chromium: Any, study: StudyProcess) -> Iterator[Any]:
    """Makes a participant who waits in the lobby: `come("ada")`."""
    people: list[Person] = []

    def arrive(name: str, *, narrow: bool = False) -> Person:
        people.append(Person(chromium, study, name, narrow=narrow))
        people[-1].come_to_the_lobby()
        return people[-1]

    yield arrive
    for person in people:
        person.context.close()
    assert [person.complaints for person in people] == [[] for _ in people]


ELSEWHERE = "The game is open in another tab or on another device"
SEATS = (["You: Red", "Blue"], ["Red", "You: Blue"])
"""What each of the two pages says about the players. Places are drawn by lot."""


def assert_one_is_red_and_one_blue(*two: Person) -> None:
    assert sorted(players_shown(person.page) for person in two) == sorted(SEATS)


def press(person: Person, key: str, button: str) -> None:
    if person.narrow:
        person.page.get_by_role("button", name=button, exact=True).tap()
    else:
        person.page.keyboard.press(key, delay=400)


def test_two_people_meet_in_the_lobby_and_play_together(come: Any) -> None:
    ada = come("ada")
    wait_for_text(ada.page, "#lobby-here", "You are the first of 2 people")
    bert = come("bert", narrow=True)
    for person in (ada, bert):
        person.wait_until_playing()
        assert person.page.evaluate(FLAWS) == []
    assert_one_is_red_and_one_blue(ada, bert)
    press(ada, "ArrowRight", "Right")
    press(bert, "ArrowLeft", "Left")
    shot(ada.page, "1280-two-players")
    shot(bert.page, "360-two-players")
    ada.page.evaluate(NOTE_TITLES)
    # A phone whose screen is locked: the game is held, and goes on when its participant is back.
    with asleep(bert.page):
        ada.wait_for_title("Waiting for the other participant")
        wait_for_text(ada.page, "#overlay-hint", "the game will end for everyone")
    ada.wait_for_earlier_title("The game is about to continue")
    for person in (ada, bert):
        person.wait_until_playing()
    # A reload in the game. The game is held unless the page is back before the server sees that it was gone.
    bert.page.reload()
    for person in (bert, ada):
        person.wait_until_playing()
    # Sideways.
    bert.page.set_viewport_size({"width": 740, "height": 360})
    overflow = (
        "[document.documentElement.scrollWidth - innerWidth, document.documentElement.scrollHeight - innerHeight]"
    )
    assert bert.page.evaluate(overflow) == [0, 0]
    shot(bert.page, "740-two-players")
    # One stays away: the game ends for both, and both learn why and go on with the study.
    bert.page.goto("about:blank")
    ada.wait_for_title("Waiting for the other participant")
    ada.wait_for_title("The game has ended")
    assert "not your fault" in ada.page.inner_text("#overlay-hint")
    shot(ada.page, "1280-two-players-ended")
    ada.page.click("#overlay-button")
    ada.page.wait_for_selector("body[data-step='4']")
    bert.page.goto(bert.link)
    bert.page.wait_for_selector("body[data-step='4']")
    assert ada.answers()["outcome"] == "partnerLeft"
    assert bert.answers()["outcome"] == "left"
    acted = keys_pressed(ada.study.data)
    of_ada, of_bert = (person.answers()["player"] for person in (ada, bert))
    assert acted == {of_ada: {"right"}, of_bert: {"left"}}


LOOKS_AWAY = """hidden => {
    window.unseen = hidden;
    Object.defineProperty(document, "hidden", { configurable: true, get: () => window.unseen });
    document.dispatchEvent(new Event("visibilitychange"));
}"""
"""Chromium without a window hides no page."""


def test_the_game_waits_for_a_participant_who_looks_at_another_tab(come: Any) -> None:
    ida = come("ida")
    theo = come("theo")
    theo.page.evaluate(LOOKS_AWAY, True)
    ida.wait_for_title("Waiting for the other participant")
    ida.page.wait_for_function("() => document.getElementById('people').textContent.includes('away')")
    ida.page.evaluate(NOTE_TITLES)
    ida.page.wait_for_timeout(5_000)  # longer than the countdown
    assert ida.page.evaluate("window.titles") == []
    assert theo.page.get_attribute("#play", "data-state") != "playing"
    theo.page.evaluate(LOOKS_AWAY, False)
    for person in (ida, theo):
        person.wait_until_playing()
    # In the game a short look at another tab does not hold the game; a participant who stays there is away.
    ida.page.evaluate(NOTE_TITLES)
    theo.page.evaluate(LOOKS_AWAY, True)
    theo.page.wait_for_timeout(1_000)
    theo.page.evaluate(LOOKS_AWAY, False)
    theo.page.wait_for_timeout(3_500)
    assert ida.page.evaluate("window.titles") == []
    theo.page.evaluate(LOOKS_AWAY, True)
    ida.wait_for_title("Waiting for the other participant")
    theo.page.evaluate(LOOKS_AWAY, False)
    ida.wait_for_earlier_title("The game is about to continue")
    for person in (ida, theo):
        person.wait_until_playing()


def keys_pressed(data: Path) -> dict[str, set[str]]:
    """For each player, the actions that its participant has chosen."""
    found: dict[str, set[str]] = {}
    for path in (data / "two-players" / "sessions").glob("*/trials/*/*.gz"):
        for line in read(path.read_bytes()):
            for player, told in line.get("players", {}).items() if line["kind"] == "step" else ():
                if told.get("by") == "human":
                    found.setdefault(player, set()).add(told["actionName"])
    return found


def test_two_tabs_and_a_reload_in_the_lobby_are_one_participant(come: Any) -> None:
    eva = come("eva")
    eva.page.wait_for_timeout(3_000)
    eva.page.reload()
    second = eva.tab()
    second.goto(eva.link)
    for page in (eva.page, second):
        wait_for_text(page, "#lobby-here", "You are the first of 2 people")
        page.wait_for_timeout(2_500)
        assert page.inner_text("#lobby-here") == "You are the first of 2 people"
    assert "Waiting time: 0" not in eva.page.inner_text("#lobby-clock")
    assert eva.page.inner_text("#lobby-note") == "", "the reload has not begun the waiting anew"
    otto = come("otto")
    otto.wait_until_playing()
    assert players_shown(otto.page) in SEATS
    elsewhere = "() => document.getElementById('overlay-title').textContent.includes('another tab')"
    until = 60
    while not any(page.evaluate(elsewhere) for page in (eva.page, second)):
        eva.page.wait_for_timeout(500)
        until -= 1
        assert until, "one of the two tabs has the game, and the other says so"


def test_two_people_with_one_link_are_one_participant_and_the_last_page_plays(come: Any, chromium: Any) -> None:
    """The other page says so, and takes the game back only after a click. The partner plays on after each change."""
    gwen, hans = come("gwen"), come("hans")
    for person in (gwen, hans):
        person.wait_until_playing()
    other = chromium.new_context()
    try:
        second = other.new_page()
        second.set_default_timeout(45_000)
        second.goto(gwen.link)
        gwen.wait_for_title(ELSEWHERE)
        second.wait_for_selector("#play[data-state=playing]", state="attached")
        hans.wait_until_playing()
        gwen.page.wait_for_timeout(3_000)  # a page that takes the game back by itself would have done so by now
        assert second.locator("#overlay-title:text('another tab'):visible").count() == 0
        gwen.page.locator("#overlay-button").click()
        gwen.wait_until_playing()
        second.wait_for_selector(f"#overlay-title:text('{ELSEWHERE}'):visible")
        hans.wait_until_playing()
        second.locator("#overlay-button").click()
        gwen.wait_for_title(ELSEWHERE)
        second.close()
        hans.wait_for_title("Waiting for the other participant")
        # The other page's words are still true, and say how to get the game back.
        gwen.wait_for_title(ELSEWHERE)
        assert gwen.page.inner_text("#overlay-hint") == "If you have closed it there, continue here."
        shot(gwen.page, "1280-two-players-elsewhere")
        gwen.page.locator("#overlay-button").click()
        hans.wait_until_playing()
    finally:
        other.close()
    for person in (gwen, hans):
        person.wait_until_playing()
    assert_one_is_red_and_one_blue(gwen, hans)
