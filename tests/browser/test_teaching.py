"""A participant teaches the car in a real Chromium with large buttons and keys, and the picture shows each word."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hippodrome.bots.links import with_user
from hippodrome.local.rehearsal.study_process import StudyProcess
from hippodrome.trial.recordings.recording import read
from tests.browser.conftest import Hold

pytestmark = [pytest.mark.browser, pytest.mark.explores, pytest.mark.timeout(300)]

FLAWS = (Path(__file__).parent / "flaws.js").read_text()
WATCH = """() => {
  const canvas = document.getElementById("screen");
  const context = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  window.heard = [];
  setInterval(() => {
    context.drawImage(canvas, 30, 345, 1, 1, 0, 0, 1, 1);
    const [red, green] = context.getImageData(0, 0, 1, 1).data;
    const word = red > green + 80 ? "bad" : green > red + 40 ? "good" : "";
    if (word !== window.heard.at(-1)) window.heard.push(word);
  }, 50);
}"""
"""Notes each word that the picture says the car has heard: on green or on red, at this place of it."""
WORDS = ("good", "bad")
LOOKS = 15  # pictures, ten of which come in a second; a word teaches nothing about the car of less than 0.2 s ago, so a person looks first


@pytest.fixture(scope="module")
def study(hold: Hold) -> StudyProcess:
    return hold("tamer")


def come_to_the_game(page: Any, link: str) -> None:
    page.goto(link)
    for box in page.get_by_role("checkbox").all():
        box.check()
    page.get_by_role("button", name="I agree").click()
    page.get_by_label("How many of the eight times").fill("3")
    page.get_by_role("button", name="Continue").click()
    page.wait_for_selector("#play:not([hidden])")
    page.wait_for_function("() => document.getElementById('play').dataset.state === 'ready'")


def words(step: dict[str, Any]) -> list[str]:
    """Return the words that the car received before this step."""
    return [said["command"] for said in step.get("messages", ()) if said.get("command") in WORDS]


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (360, 740)])
def test_a_participant_says_good_and_bad_and_sees_that_it_was_heard(
    chromium: Any, study: StudyProcess, width: int, height: int
) -> None:
    narrow, name = width < 600, f"teacher-{width}"
    context = chromium.new_context(
        viewport={"width": width, "height": height}, has_touch=narrow, is_mobile=narrow, reduced_motion="reduce"
    )
    context.set_default_timeout(45_000)
    page, pictures = context.new_page(), []
    page.on(
        "websocket",
        lambda socket: socket.on("framereceived", lambda data: pictures.append(1) if isinstance(data, bytes) else None),
    )
    come_to_the_game(page, with_user(study.link, name))
    page.locator("#overlay-button").click()
    page.wait_for_function("() => document.getElementById('play').dataset.state === 'playing'")
    page.evaluate(WATCH)
    before = len(pictures)
    while len(pictures) < before + LOOKS:
        page.wait_for_timeout(50)
    for word in ("Good", "Bad"):
        button = page.get_by_role("button", name=word, exact=True)
        box = button.bounding_box()
        assert box["width"] >= 120
        assert box["height"] >= 56
        assert box["y"] + box["height"] <= height
        (button.tap if narrow else button.click)()
        page.wait_for_function("word => window.heard.includes(word)", arg=word.lower())
    if not narrow:
        page.keyboard.press("g")
        page.wait_for_function("word => window.heard.at(-1) === word", arg="good")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(FLAWS) == []
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="End the game").click()
    page.wait_for_selector("body[data-step='4']")
    context.close()
    [recording] = (study.data / "tamer" / "users" / name / "trials").glob("*/*.gz")
    steps = [line for line in read(recording.read_bytes()) if line["kind"] == "step"]
    heard = [words(step) for step in steps]
    assert [word for said in heard for word in said] == (["good", "bad"] if narrow else ["good", "bad", "good"])
    first = next(number for number, said in enumerate(heard) if said)
    assert all(not any(step["info"]["predicted"]) for step in steps[:first]), "it has learnt nothing yet"
    assert any(any(step["info"]["predicted"]) for step in steps[first:]), "it has learnt"
