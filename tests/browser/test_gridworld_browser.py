"""A participant who plays turn by turn with a policy, in a real Chromium: examples/gridworld, drawn by objects."""

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
HUD = "text => document.querySelector('.hud').textContent.includes(text)"


@pytest.fixture(scope="module")
def study(hold: Hold) -> StudyProcess:
    return hold("gridworld")


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (360, 740)])
def test_the_game_waits_for_the_participant_and_the_partner_moves_by_itself(
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
    for left in (36, 34, 32):
        page.wait_for_function(HUD, arg="Your turn")
        page.wait_for_function(HUD, arg=f"{left} turns left")
        wait = page.get_by_role("button", name="Wait", exact=True)
        (wait.tap if narrow else wait.click)()
    page.wait_for_function(HUD, arg="30 turns left")
    out_of_the_forest = page.get_by_role("button", name="Left", exact=True)
    (out_of_the_forest.tap if narrow else out_of_the_forest.click)()
    page.wait_for_function("() => document.getElementById('trouble').textContent === 'That move is not possible now'")
    assert page.evaluate(HUD, "30 turns left")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(FLAWS) == []
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="End the game").click()
    page.wait_for_selector("body[data-step='4']")
    context.close()
    assert complaints == []
    [recording] = (study.data / "gridworld" / "users" / name / "trials").glob("*/*.gz")
    steps = [line for line in read(recording.read_bytes()) if line["kind"] == "step"]
    assert [step["actionName"] for step in steps[::2]] == ["wait"] * 3
    assert {step["by"] for step in steps[::2]} == {"human"}
    assert {step["players"]["partner"]["by"] for step in steps[1::2]} == {"policy"}
