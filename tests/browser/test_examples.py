"""The examples with two players in a real Chromium: a participant plays by keys or fingers, wide and on a phone."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from hippodrome.bots.links import with_user
from hippodrome.trial.recordings.recording import read
from tests.browser.conftest import Hold
from tests.browser.world import SHOTS

pytestmark = [pytest.mark.browser, pytest.mark.explores, pytest.mark.timeout(300)]

FLAWS = (Path(__file__).parent / "flaws.js").read_text()
SIZES = [(1280, 800), (360, 740)]
STATE = "wanted => document.getElementById('play').dataset.state === wanted"


def come_to_the_game(page: Any, link: str) -> None:
    page.goto(link)
    for box in page.get_by_role("checkbox").all():
        box.check()
    page.get_by_role("button", name="I agree").click()
    page.get_by_role("combobox").select_option("no")
    page.get_by_role("button", name="Continue").click()
    page.wait_for_selector("#play:not([hidden])")
    page.wait_for_function(STATE, arg="ready")


def press(page: Any, key: str, button: str, *, narrow: bool, milliseconds: int) -> None:
    """Hold the key, or on a phone the button on the screen."""
    if narrow:
        box = page.get_by_role("button", name=button, exact=True).bounding_box()
        point = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
        touch = page.context.new_cdp_session(page)
        touch.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [point]})
        page.wait_for_timeout(milliseconds)
        touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    else:
        page.keyboard.down(key)
        page.wait_for_timeout(milliseconds)
        page.keyboard.up(key)


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize(
    ("example", "presses", "wanted"),
    [
        ("slime-volleyball", [("ArrowRight", "Right", 600), ("ArrowUp", "Up", 200)], {"right", "up"}),
        ("overcooked", [("ArrowLeft", "Left", 60)] * 3 + [(" ", "Take / put", 60)], {"left", "pickup"}),
    ],
)
def test_a_participant_plays(
    chromium: Any, hold: Hold, example: str, presses: list[Any], wanted: set[str], width: int, height: int
) -> None:
    study, narrow, name = hold(example), width < 600, f"ada-{width}"
    context = chromium.new_context(viewport={"width": width, "height": height}, has_touch=narrow, is_mobile=narrow)
    context.set_default_timeout(45_000)
    page, complaints, pictures = context.new_page(), [], []
    hear = lambda data: pictures.append(data) if isinstance(data, bytes) else None  # noqa: E731
    page.on("websocket", lambda socket: socket.on("framereceived", hear))
    page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    come_to_the_game(page, with_user(study.link, name))
    page.locator("#overlay-button").click()
    page.wait_for_function(STATE, arg="playing")
    for key, button, milliseconds in presses:
        press(page, key, button, narrow=narrow, milliseconds=milliseconds)
        before = len(pictures)
        while len(pictures) < before + 3:  # the steps of this press are over before the next press
            page.wait_for_timeout(20)
    shown = Image.open(io.BytesIO(page.locator("canvas").last.screenshot()))
    assert len(shown.getcolors(maxcolors=10_000_000)) > 20, "pictures are drawn"
    SHOTS.mkdir(exist_ok=True)
    page.screenshot(path=SHOTS / f"{width}-{example}.png", full_page=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(FLAWS) == []
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="End the game").click()
    page.wait_for_selector("body[data-step='4']")
    assert complaints == []
    context.close()
    (recording,) = (study.data / example / "users" / name / "trials").glob("*/*.gz")
    steps = [line for line in read(recording.read_bytes()) if line["kind"] == "step"]
    assert {step["actionName"] for step in steps if step["by"] == "human"} == wanted
