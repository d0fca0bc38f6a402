"""examples/negotiate in real browsers: two people, one of them on a phone, and one participant with the stand-in of a model."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from hippodrome.bots.links import with_user
from hippodrome.local.new import LEFT_OUT
from hippodrome.local.rehearsal.study_process import StudyProcess
from testing.held_study import HeldStudy
from testing.processes import ROOT
from tests.browser.world import FLAWS, PATIENCE, shot

pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]
EXAMPLE = ROOT / "examples" / "negotiate"
LINES = "all => all.map(each => [each.classList.contains('mine'), each.querySelector('p').textContent])"
Held = Callable[[str], StudyProcess]


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Held]:
    """The example, held with one of its configs, for two rounds and with a button that ends a round."""
    studies: list[HeldStudy] = []

    def start(file: str) -> StudyProcess:
        folder = tmp_path_factory.mktemp("negotiate")
        shutil.copytree(EXAMPLE, folder / "project", ignore=LEFT_OUT)
        config = yaml.safe_load((EXAMPLE / file).read_text(encoding="utf-8"))
        config["project"] |= {"patience": 300}
        config["trial"] |= {"maxEpisodes": 2, "ui": {"reset": True}}
        (folder / "project" / "config.yml").write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
        studies.append(HeldStudy(folder / "project", folder / "data", stalled=60))
        studies[-1].start()
        return studies[-1]

    yield start
    for study in studies:
        study.clear()


class Negotiator:
    """A participant in a browser of their own, who has read the rules."""

    def __init__(self, chromium: Any, study: StudyProcess, name: str, width: int) -> None:
        narrow = width < 600
        size = {"width": width, "height": 740 if narrow else 800}
        self.context = chromium.new_context(viewport=size, has_touch=narrow, is_mobile=narrow)
        self.context.set_default_timeout(PATIENCE)
        self.name, self.width, self.complaints = name, width, list[str]()
        self.page = self.context.new_page()
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.goto(with_user(study.link, name))
        self.page.check("[name=consent]")
        self.page.click("text=Begin")

    def look(self, what: str) -> None:
        """Take a picture of the page, on which nothing keeps people out or is wider than the window."""
        assert self.page.evaluate(FLAWS) == []
        assert self.page.evaluate("document.documentElement.scrollWidth") == self.width
        shot(self.page, f"{self.width}-negotiate-{what}")

    def read(self, text: str) -> None:
        """Wait until this line is in the panel."""
        self.page.wait_for_selector(f".line p:text('{text}')")

    def write(self, text: str) -> None:
        self.page.fill("#chat-field", text)
        self.page.press("#chat-field", "Enter")
        self.page.wait_for_selector(f".line.mine:not(.waiting) p:text('{text}')")

    def offer(self, price: int) -> None:
        """Fill in the page between two rounds."""
        self.page.wait_for_selector("#reading h1:text-is('Your offer'):visible")
        self.page.fill("[name=price]", str(price))

    def finish(self, price: int) -> None:
        """Go on from the end of the game to the last page of the study."""
        self.page.click("#overlay-button")
        self.page.check("[name=agreed][value=yes]")
        self.page.fill("[name=price]", str(price))
        self.page.check("[name=trust][value='4']")
        self.look("last")
        self.page.click("text=Continue")
        self.page.wait_for_selector(".code")

    def close(self) -> None:
        self.context.close()
        assert self.complaints == []


def answers(study: StudyProcess, name: str, step: str) -> dict[str, Any]:
    (path,) = Path(study.data).glob(f"*/users/{name}/answers/{step}.json")
    found: dict[str, Any] = json.loads(path.read_text())["answers"]
    return found


def test_two_people_agree_on_a_price(chromium: Any, held: Held) -> None:
    study = held("config.yml")
    ada, bert = Negotiator(chromium, study, "ada", 1280), Negotiator(chromium, study, "bert", 360)
    people = {}
    for person in (ada, bert):
        person.page.wait_for_selector("#reading h1:text('A used bicycle')")
        person.read("You are the")
        person.look("rules")
        role = "buyer" if "You are the buyer" in person.page.inner_text("#chat-log") else "seller"
        people[role] = person
    assert set(people) == {"buyer", "seller"}, "each has a role of their own"
    buyer, seller = people["buyer"], people["seller"]
    buyer.write("Hello! Would you take 70?")
    seller.read("Would you take 70?")
    assert "You are the buyer" not in seller.page.inner_text("#chat-log"), "what is said in private"
    for person in (ada, bert):
        person.page.click("text=Go to the conversation")
    for person in (ada, bert):
        person.page.wait_for_selector("#play[data-state=playing]", state="attached")
    seller.write("85, and it is yours. It has new tyres and a light.")
    buyer.read("85, and it is yours.")
    for person in (ada, bert):
        person.look("talk")
    buyer.page.click("text=End this round")
    for person, price in ((buyer, 75), (seller, 80)):
        person.offer(price)
        person.look("offer")
        person.page.click("text=Next round")
    for person in (ada, bert):
        person.read("The buyer offers 75, and the seller asks for 80.")
    for person in (ada, bert):
        person.page.wait_for_selector("#play[data-state=playing]", state="attached")
    seller.write("78?")
    buyer.read("78?")
    assert buyer.page.inner_text("#episode") == "Round 2 of 2"
    buyer.page.click("text=End this round")
    for person in (ada, bert):
        person.page.wait_for_selector("#overlay-title:text('The conversation is over')")
        person.look("over")
        person.finish(78)
        person.close()
    for name in ("ada", "bert"):
        assert answers(study, name, "last")["price"] == "78"
        assert answers(study, name, "game")["talk"]["lines"] == (1 if name == buyer.name else 2)


@pytest.mark.parametrize("width", [360, 1280])
def test_a_participant_negotiates_with_a_model(chromium: Any, held: Held, width: int) -> None:
    study = held("with-a-model.yml")
    eve = Negotiator(chromium, study, "eve", width)
    eve.page.click("text=Go to the conversation")
    eve.page.wait_for_selector(".line:not(.mine) b:text('Seller')")
    eve.page.click("#overlay-button")
    eve.page.wait_for_selector("#play[data-state=playing]", state="attached")
    eve.write("Would you take 70?")
    eve.page.wait_for_function("() => document.querySelectorAll('.line:not(.mine):not([aria-hidden])').length === 2")
    eve.look("model")
    eve.page.click("text=End this round")
    eve.offer(70)
    eve.page.click("text=Next round")
    eve.page.wait_for_selector("#play[data-state=playing]", state="attached")
    eve.page.reload()
    eve.read("Would you take 70?")
    lines = eve.page.eval_on_selector_all("#chat-log .line", LINES)
    assert [mine for mine, _ in lines] == [False, True, False]
    if eve.page.locator("#overlay-button:visible").count():
        eve.page.click("#overlay-button")
    eve.page.click("text=End this round")
    eve.finish(70)
    eve.close()
    assert answers(study, "eve", "game")["talk"]["lines"] == 1
