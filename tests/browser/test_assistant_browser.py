"""A participant who asks a language model for hints beside the game: examples/assistant, with the stand-in."""

from __future__ import annotations

from typing import Any

import pytest

from hippodrome.bots.links import with_user
from hippodrome.local.rehearsal.study_process import StudyProcess
from hippodrome.trial.recordings.recording import read
from tests.browser.conftest import Hold
from tests.browser.world import FLAWS, shot

pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]
HUD = "text => document.querySelector('.hud').textContent.includes(text)"


@pytest.fixture(scope="module")
def study(hold: Hold) -> StudyProcess:
    return hold("assistant")


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (360, 740)])
def test_the_owl_answers_what_is_typed_and_the_button(
    chromium: Any, study: StudyProcess, width: int, height: int
) -> None:
    narrow, name = width < 600, f"squirrel-{width}"
    context = chromium.new_context(
        viewport={"width": width, "height": height}, has_touch=narrow, is_mobile=narrow, reduced_motion="reduce"
    )
    context.set_default_timeout(45_000)
    page, complaints = context.new_page(), []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(with_user(study.link, name))
    for box in page.get_by_role("checkbox").all():
        box.check()
    page.get_by_role("button", name="I agree").click()
    page.get_by_role("button", name="Continue").click()
    page.wait_for_selector("#play:not([hidden])")
    page.wait_for_function("() => document.getElementById('play').dataset.state === 'ready'")
    page.locator("#overlay-button").click()
    page.fill("#chat-field", "Which way is up?")
    page.press("#chat-field", "Enter")
    page.wait_for_selector(".line:not(.mine) >> text=Which way is up?")
    page.get_by_role("button", name="Am I close?").click()
    page.wait_for_selector(".line:not(.mine) >> text=Am I close?")
    up = page.get_by_role("button", name="Up", exact=True)
    (up.tap if narrow else up.click)()
    page.wait_for_function(HUD, arg="23 moves left")
    assert page.locator(".line:not(.mine)").count() == 2
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(FLAWS) == []
    shot(page, f"{width}-assistant")
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="End the game").click()
    page.wait_for_selector("body[data-step='4']")
    context.close()
    assert complaints == []
    [recording] = (study.data / "assistant" / "users" / name / "trials").glob("*/*.gz")
    assert [line["actionName"] for line in read(recording.read_bytes()) if line["kind"] == "step"] == ["up"]
