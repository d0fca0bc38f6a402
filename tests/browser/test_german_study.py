"""A study in German in two real browsers, one wide and one a phone: no text of Hippodrome is English, and all fits."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from hippodrome.bots.links import with_user
from hippodrome.control.model.texts import ENGLISH, PLACE
from hippodrome.local.rehearsal.study_process import StudyProcess, copy_of
from testing.held_study import HeldStudy
from testing.processes import ROOT
from tests.browser.conftest import GamesToEnd
from tests.browser.world import FLAWS, SHOTS

pytestmark = [pytest.mark.browser, pytest.mark.explores, pytest.mark.timeout(300)]

GERMAN: dict[str, str] = yaml.safe_load((ROOT / "docs" / "texts.de.yml").read_text(encoding="utf-8"))["project"][
    "texts"
]
PAGES = {
    "consent": "<h1>Möchten Sie teilnehmen?</h1><label><input type=checkbox name=ja value=ja required> Ja, ich möchte.</label>",
    "rules": "<h1>Die Regeln</h1><p>Stellen Sie sich zu zweit auf die goldenen Platten.</p>",
    "survey": "<h1>Wie war es?</h1><label for=a>Anmerkungen</label><textarea id=a name=a></textarea>",
    "debrief": "<h1>Danke!</h1><p>Ihr Code:</p><p class=code>{{ completion_code }}</p>",
}
PATTERNS = [
    re.compile(".+".join(map(re.escape, PLACE.split(text)[::2])))
    for name, text in ENGLISH.items()
    if text != GERMAN[name] and name not in ("language", "notSavedText")
]
READ = """() => {
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    const found = [document.title];
    while (walker.nextNode()) {
        if (!walker.currentNode.parentElement.closest("script, style, #scene-hud")) found.push(walker.currentNode.data);
    }
    for (const each of document.querySelectorAll("[aria-label], [title]")) {
        found.push(each.getAttribute("aria-label") ?? "", each.title);
    }
    return found.map((text) => text.trim().replace(/\\s+/g, " ")).filter(Boolean);
}"""


NOTE_WHAT_IS_SAID = """() => {
    const trouble = document.getElementById("trouble");
    window.said = [];
    new MutationObserver(() => window.said.push(trouble.textContent)).observe(trouble, { childList: true });
}"""
"""Notes the server's messages, because the page may show them only for a moment."""


class Person:
    """A participant in a browser of their own, whose connection to the game can be cut."""

    def __init__(self, chromium: Any, study: StudyProcess, name: str, width: int) -> None:
        narrow = width < 600
        size = {"width": width, "height": 740 if narrow else 800}
        self.context = chromium.new_context(viewport=size, has_touch=narrow, is_mobile=narrow)
        self.context.set_default_timeout(60_000)
        self.page = self.context.new_page()
        self.complaints: list[str] = []
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.width, self._cut, self._sockets = width, False, []
        self.page.route_web_socket(re.compile("^ws"), self._connect)
        self.page.goto(with_user(study.link, name))

    def _connect(self, socket: Any) -> None:
        if self._cut:
            socket.close(code=4000)
        else:
            self._sockets.append(socket)
            socket.connect_to_server()

    def disconnect(self) -> None:
        """Close the connection to the game, and refuse new ones until `reconnect`."""
        self._cut = True
        self._sockets[-1].close(code=4000)

    def reconnect(self) -> None:
        self._cut = False

    def wait_for_text(self, selector: str, text: str) -> None:
        says = "([selector, text]) => document.querySelector(selector)?.textContent.includes(text)"
        self.page.wait_for_function(says, arg=[selector, text])

    def wait_until_playing(self) -> None:
        self.page.wait_for_selector("#play[data-state=playing]", state="attached")

    def check_german(self, name: str) -> None:
        """Check that no text of Hippodrome is English, shown or hidden, and that nothing is wider than the page."""
        self.page.screenshot(path=SHOTS / f"{self.width}-german-{name}.png")
        texts = self.page.evaluate(READ)
        assert [text for text in texts if any(english.fullmatch(text) for english in PATTERNS)] == []
        assert self.page.evaluate("document.documentElement.lang") == "de"
        assert self.page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
        assert self.page.evaluate(FLAWS) == []

    def go_on(self) -> None:
        for box in self.page.get_by_role("checkbox").all():
            box.check()
        self.page.get_by_role("button", name="Weiter").click()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of `project`: the example for two, with pages and texts in German."""
    folder = tmp_path_factory.mktemp("german")
    copy_of(ROOT / "examples" / "two-players", folder / "project")
    (folder / "project" / "steps").unlink()
    (folder / "project" / "steps").mkdir()
    for name, page in PAGES.items():
        (folder / "project" / "steps" / f"{name}.html").write_text(page, encoding="utf-8")
    config = folder / "project" / "config.yml"
    tree = yaml.safe_load(config.read_text(encoding="utf-8"))
    tree["project"] |= {"texts": GERMAN, "name": "Laternen für zwei"}
    tree["trial"] |= {
        "maxEpisodes": 2,
        "episodeSeconds": 14,
        "betweenEpisodes": 4,
        "absent": 5,
        "countdown": 2,
        "playerNames": {"red": "Rot", "blue": "Blau"},
    }
    config.write_text(json.dumps(tree), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def games(folder: Path) -> GamesToEnd:
    """Ends games before their time is over."""
    return GamesToEnd(folder / "project")


@pytest.fixture(scope="module")
def study(folder: Path, games: GamesToEnd) -> Iterator[StudyProcess]:
    held = HeldStudy(folder / "project", folder / "data")
    held.start()
    yield held
    held.clear()


@pytest.fixture
def come(chromium: Any, study: StudyProcess) -> Iterator[Callable[[str, int], Person]]:
    """Makes a participant at the first page: `come("ada", 1280)`."""
    people: list[Person] = []
    SHOTS.mkdir(exist_ok=True)

    def arrive(name: str, width: int) -> Person:
        people.append(Person(chromium, study, name, width))
        return people[-1]

    yield arrive
    for person in people:
        person.context.close()
    assert [person.complaints for person in people] == [[] for _ in people]


def test_two_people_read_german_from_the_link_to_the_end(come: Callable[[str, int], Person], games: GamesToEnd) -> None:
    phone, wide = come("bo", 360), come("ada", 1280)
    for person in (phone, wide):
        person.check_german("consent")
        person.go_on()
        person.page.wait_for_selector("body[data-step='2']")
        person.go_on()
        if person is phone:
            phone.wait_for_text("#lobby-here", "1 von 2 ist da: Sie")
            phone.wait_for_text("#lobby-then", "geht es für Sie ohne dieses Spiel weiter")
            phone.check_german("lobby")
    for person in (wide, phone):
        person.wait_until_playing()
        person.check_german("game")
    phone.disconnect()
    phone.wait_for_text("#overlay-title", GERMAN["lost"])
    phone.check_german("lost")
    wide.wait_for_text("#overlay-title", "Warten auf die andere Person")
    wide.wait_for_text("#overlay-hint", "übernimmt ein Computerspieler den Platz")
    wide.check_german("waits")
    wide.wait_for_text("#trouble", "Ein Computerspieler hat die andere Person ersetzt.")
    wide.check_german("replaced")
    phone.reconnect()
    wide.wait_for_text("#trouble", "Die andere Person ist wieder da.")
    for person in (wide, phone):
        person.wait_for_text("#overlay-title", "Spiel 1 von 2 ist vorbei")
        person.check_german("break")
    with games.over(2):
        for person in (wide, phone):
            person.wait_for_text("#overlay-title", "Das Spiel ist vorbei")
            person.wait_for_text("#overlay-score", "Ihre Punkte in 2 Spielen: ")
            person.check_german("over")
            person.page.click("#overlay-button")
    for person in (wide, phone):
        person.page.wait_for_selector("body[data-step='4']")
        person.check_german("survey")
        person.go_on()
        person.wait_for_text(".copy", "Kopieren")
        person.check_german("end")


def test_ending_the_game_is_confirmed_in_german_and_the_other_participant_is_told(
    come: Callable[[str, int], Person],
) -> None:
    phone, wide = come("ed", 360), come("fi", 1280)
    for person in (phone, wide):
        for step in ("2", "3"):
            person.go_on()
            person.page.wait_for_selector(f"body[data-step='{step}']")
    for person in (phone, wide):
        person.wait_until_playing()
    wide.page.evaluate(NOTE_WHAT_IS_SAID)
    asked: list[str] = []
    phone.page.on("dialog", lambda dialog: (asked.append(dialog.message), dialog.accept()))
    phone.page.get_by_role("button", name="Spiel für alle beenden").tap()
    wide.page.wait_for_function("text => window.said.includes(text)", arg=GERMAN["saidPartnerStopped"])
    wide.wait_for_text("#overlay-title", GERMAN["hasEnded"])
    wide.check_german("stopped")
    assert asked == [GERMAN["endConfirm"]]


def test_the_page_of_a_broken_link_is_german(come: Callable[[str, int], Person], study: StudyProcess) -> None:
    phone = come("cy", 360)
    phone.page.goto(f"{study.link}&userId=a%20b")
    phone.wait_for_text("h1", "Dieser Link funktioniert nicht")
    phone.check_german("broken-link")
