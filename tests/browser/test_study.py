"""Participants take part in the example study in a real Chromium, wide and narrow, by keyboard, mouse and touch."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from hippodrome.local.rehearsal.study_process import servers_of, wait_until_gone
from tests.browser.world import PATIENCE

pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]

FLAWS = (Path(__file__).parent / "flaws.js").read_text()
CANVAS = """() => {
  const canvas = document.getElementById("screen");
  const copy = Object.assign(document.createElement("canvas"), { width: canvas.width, height: canvas.height });
  const context = copy.getContext("2d", { willReadFrequently: true });
  context.drawImage(canvas, 0, 0);
  const pixels = new Uint32Array(context.getImageData(0, 0, copy.width, copy.height).data.buffer);
  let sum = 7;
  for (const pixel of pixels) sum = (Math.imul(sum, 31) + pixel) | 0;
  const colours = new Set(pixels);
  const coloured = [...colours].filter((c) => Math.max(c & 255, c >> 8 & 255, c >> 16 & 255) - Math.min(c & 255, c >> 8 & 255, c >> 16 & 255) > 60);
  return { sum, coloured: coloured.length, width: canvas.width, height: canvas.height };
}"""


def check_page(visitor: Any, what: str) -> None:
    """Save a screenshot and the size of the page, and check that it fits and has no flaws."""
    visitor.shot(what)
    visitor.record_size(what)
    page = visitor.page
    assert page.evaluate("document.documentElement.scrollWidth") <= visitor.width, what
    assert page.evaluate(FLAWS) == [], what


def give_consent(visitor: Any) -> None:
    visitor.open()
    assert visitor.step == "1"
    visitor.invited = visitor.page.locator("h1").inner_text()
    check_page(visitor, "1-consent")
    for box in visitor.page.get_by_role("checkbox").all():
        box.check()
    visitor.send("2")


def answer_questionnaire(visitor: Any) -> None:
    page = visitor.page
    check_page(visitor, "2-questionnaire")
    page.get_by_label("How old are you?").fill("33")
    page.get_by_label("A few times a week").check()
    page.get_by_label("An arcade machine").check()
    page.get_by_label("A computer").check()
    page.get_by_label("Have you played Pac-Man").select_option("often")
    page.get_by_label("How well do you think").fill("7")
    page.get_by_label("Do you have a plan").fill("Eat.\nDo not be eaten — „nie“.")
    visitor.shot("2-questionnaire-filled")
    visitor.send("3")


def wait_for_game(visitor: Any, state: str = "ready") -> None:
    visitor.page.wait_for_selector("#play:not([hidden])")
    visitor.page.wait_for_function("state => document.getElementById('play').dataset.state === state", arg=state)


def wait_for_motion(visitor: Any) -> dict[str, Any]:
    """Wait until the canvas changes, and check that its picture has colours."""
    before = visitor.page.evaluate(CANVAS)
    visitor.page.wait_for_function(f"before => ({CANVAS})().sum !== before", arg=before["sum"])
    after: dict[str, Any] = visitor.page.evaluate(CANVAS)
    assert after["coloured"] >= 3, after
    assert (after["width"], after["height"]) == (160, 210)
    return after


def wait_for_standstill(visitor: Any) -> None:
    """Wait until the canvas has not changed for 0.8 seconds."""
    before, since, until = None, time.monotonic(), time.monotonic() + PATIENCE / 1000
    while time.monotonic() - since < 0.8:
        now = visitor.page.evaluate(CANVAS)["sum"]
        if now != before:
            before, since = now, time.monotonic()
        assert time.monotonic() < until
        visitor.page.wait_for_timeout(100)


def end_game(visitor: Any, following: str = "4") -> None:
    visitor.page.once("dialog", lambda dialog: dialog.accept())
    visitor.page.get_by_role("button", name="End the game").click()
    visitor.page.wait_for_selector(f"body[data-step='{following}']")


def answer_survey(visitor: Any) -> None:
    page = visitor.page
    for name in ("fun", "control", "learned", "effort"):
        page.locator(f"input[name={name}][value='4']").check()
    page.locator("input[name=trouble][value=no]").check()
    page.get_by_label("Is there anything else").fill("No <b>thanks</b> & bye")
    visitor.shot("4-survey-filled")
    visitor.send("finalStep")


def hold_finger(visitor: Any, button: Any, ms: int) -> None:
    """Hold a finger on a button for so many milliseconds."""
    box = button.bounding_box()
    touch = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    session = visitor.context.new_cdp_session(visitor.page)
    session.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [touch]})
    visitor.page.wait_for_timeout(ms)
    session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


def test_two_participants_take_part_at_once_one_wide_and_one_narrow(visit: Any, study: Any) -> None:
    wide, narrow = visit("wide", 1280, pictures=True), visit("narrow", 360, pictures=True)
    for visitor in (wide, narrow):
        give_consent(visitor)
        answer_questionnaire(visitor)
        visitor.shot("3-waiting")
    for visitor in (wide, narrow):
        wait_for_game(visitor)
        check_page(visitor, "3-ready")

    wide.page.keyboard.press("ArrowLeft")
    wait_for_game(wide, "playing")
    for key in ("ArrowLeft", "ArrowRight", "ArrowUp"):
        wide.page.keyboard.down(key)
        wait_for_motion(wide)
        wide.page.wait_for_timeout(250)
        wide.page.keyboard.up(key)
    check_page(wide, "3-playing")

    narrow.page.locator("#overlay-button").tap()
    wait_for_game(narrow, "playing")
    for label in ("Left", "Right"):
        hold_finger(narrow, narrow.page.get_by_role("button", name=label, exact=True), 400)
        wait_for_motion(narrow)
    check_page(narrow, "3-playing")
    assert {process.environ()["USER_ID"] for process in servers_of(study.data)} >= {"wide", "narrow"}
    assert set(wide.sockets).isdisjoint(narrow.sockets)

    wide.page.keyboard.press("Space")
    narrow.page.get_by_role("button", name="Pause").tap()
    for visitor in (wide, narrow):
        wait_for_game(visitor, "paused")
        wait_for_standstill(visitor)
        check_page(visitor, "3-paused")
    wide.page.keyboard.press("ArrowUp")
    wait_for_game(wide, "playing")
    wait_for_motion(wide)

    for visitor in (wide, narrow):
        end_game(visitor)
        check_page(visitor, "4-survey")
        answer_survey(visitor)
        check_page(visitor, "5-debrief")
        code = visitor.page.locator(".code").inner_text()
        assert len(code) == 10
        wording = "personal request" if visitor.invited.startswith("Help us") else "plain list"
        assert f"You saw the {wording}." in visitor.page.locator("main").inner_text()
        assert code in (study.data / "ms-pacman" / "users" / visitor.name / "participant.json").read_text()
        visitor.open()
        assert visitor.page.locator(".code").inner_text() == code  # a reload shows the same wording
        assert visitor.answers("2")["plan"] == "Eat.\r\nDo not be eaten — „nie“."
        assert visitor.answers("2")["devices"] == ["computer", "arcade"]
        assert visitor.answers("3")["outcome"] == "stopped"
        assert visitor.answers("4")["notes"] == "No <b>thanks</b> & bye"
        visitor.check_all()

    left = wait_until_gone(study.data, {"wide", "narrow"})
    assert left.words() == []
    for visitor, actions in ((wide, {"left", "right", "up"}), (narrow, {"left", "right"})):
        steps = visitor.steps_played()
        assert len(steps) == visitor.answers("3")["frames"]
        assert actions <= {step["actionName"] for step in steps if step["by"] == "human"}


def test_the_game_goes_on_after_a_reload_and_in_a_second_tab(visit: Any, study: Any) -> None:
    visitor = visit("tabs")
    give_consent(visitor)
    visitor.page.get_by_label("How old are you?").fill("44")
    visitor.page.get_by_label("Every day").check()
    visitor.send("3")
    wait_for_game(visitor)
    visitor.page.keyboard.press("ArrowLeft")
    wait_for_game(visitor, "playing")
    wait_for_motion(visitor)

    visitor.page.reload()
    wait_for_game(visitor, "paused")
    wait_for_standstill(visitor)
    visitor.page.keyboard.press("ArrowRight")
    wait_for_game(visitor, "playing")
    wait_for_motion(visitor)

    first, visitor.page = visitor.page, visitor.tab()
    visitor.page.goto(visitor.link)
    wait_for_game(visitor, "paused")
    first.wait_for_function("() => document.getElementById('play').dataset.state === 'elsewhere'")
    assert "another tab" in first.locator("#overlay-title").inner_text()
    first.bring_to_front()
    second, visitor.page, visitor.pictures = visitor.page, first, True
    check_page(visitor, "3-elsewhere")
    visitor.page, visitor.pictures = second, False
    visitor.page.bring_to_front()
    visitor.page.keyboard.press("ArrowUp")
    wait_for_game(visitor, "playing")
    wait_for_motion(visitor)
    visitor.page = first
    visitor.page.bring_to_front()
    visitor.page.get_by_role("button", name="Play here instead").click()
    wait_for_game(visitor, "paused")
    second.wait_for_function("() => document.getElementById('play').dataset.state === 'elsewhere'")
    end_game(visitor)

    assert len(set(visitor.sockets)) == 1  # the same server throughout
    visitor.check_all()
    steps = visitor.steps_played()
    assert len({step["trial"] for step in steps}) == 1
    assert [step["step"] for step in steps] == list(range(1, len(steps) + 1))


def test_a_draft_survives_a_reload_and_is_deleted_when_it_is_sent(visit: Any) -> None:
    visitor = visit("draft")
    give_consent(visitor)
    page = visitor.page
    page.get_by_label("How old are you?").fill("55")
    page.get_by_label("A console").check()
    page.get_by_label("A few times a month").check()
    page.get_by_label("How well do you think").fill("9")
    page.get_by_label("Do you have a plan").fill("Half a tho")
    page.reload()
    assert page.get_by_label("How old are you?").input_value() == "55"
    assert page.get_by_label("A console").is_checked()
    assert page.get_by_label("A few times a month").is_checked()
    assert page.get_by_label("How well do you think").input_value() == "9"
    assert page.locator("output").inner_text() == "9"
    assert page.get_by_label("Do you have a plan").input_value() == "Half a tho"
    visitor.send("3")
    assert page.evaluate("Object.keys(localStorage).filter(key => key.startsWith('hippodrome:'))") == []
    assert visitor.answers("2")["plan"] == "Half a tho"
    visitor.check_all()


def test_a_participant_can_consent_with_the_keyboard_alone(visit: Any) -> None:
    visitor = visit("keys")
    visitor.open()
    page = visitor.page
    focused = "() => document.activeElement.name || document.activeElement.tagName"
    outlined = "() => getComputedStyle(document.activeElement).outlineStyle !== 'none'"
    page.keyboard.press("Tab")
    for name in ("adult", "consent"):
        assert page.evaluate(focused) == name
        assert page.evaluate(outlined)
        if name == "adult":
            page.keyboard.press("Space")
        page.keyboard.press("Tab")
    assert page.evaluate(focused) == "BUTTON"
    assert page.evaluate(outlined)
    page.keyboard.press("Enter")  # one answer is missing
    assert page.evaluate(focused) == "consent"
    assert "Please answer this question" in page.locator(".status").inner_text()
    visitor.pictures = True
    visitor.shot("1-consent-missing")
    page.keyboard.press("Space")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.wait_for_selector("body[data-step='2']")
    assert visitor.answers("1") == {"adult": "yes", "consent": "yes"}
    visitor.check_all()


def test_a_server_lost_in_mid_game_is_replaced(visit: Any, study: Any) -> None:
    visitor = visit("unlucky")
    give_consent(visitor)
    visitor.page.get_by_label("How old are you?").fill("66")
    visitor.page.get_by_label("Every day").check()
    visitor.send("3")
    wait_for_game(visitor)
    visitor.page.keyboard.press("ArrowLeft")
    wait_for_game(visitor, "playing")
    wait_for_motion(visitor)
    until = time.monotonic() + PATIENCE / 1000
    while not study.steps_written("unlucky"):  # a server that is killed earlier has stored nothing
        assert time.monotonic() < until
        visitor.page.wait_for_timeout(100)
    for process in servers_of(study.data, {"unlucky"}):
        with contextlib.suppress(psutil.NoSuchProcess):  # local mode ends the others when one has ended
            process.kill()
    wait_for_game(visitor, "ready")  # on another server; the participant has done nothing
    assert len(set(visitor.sockets)) == 2
    visitor.page.keyboard.press("ArrowLeft")
    wait_for_game(visitor, "playing")
    wait_for_motion(visitor)
    end_game(visitor)
    assert visitor.hosts == {"127.0.0.1"}  # not `check_all`: Chromium complains of the lost connection
    assert len({step["trial"] for step in visitor.steps_played()}) == 2


def test_pages_work_without_scripts(visit: Any) -> None:
    visitor = visit("plain", 360, java_script_enabled=False)
    visitor.open()
    for box in visitor.page.get_by_role("checkbox").all():
        box.check()
    visitor.send("2")
    visitor.page.get_by_label("How old are you?").fill("77")
    visitor.page.get_by_label("Every day").check()
    visitor.send("3")
    assert "The game needs JavaScript" in visitor.page.locator("main").inner_text()
    assert visitor.answers("2")["age"] == "77"
    visitor.check_all()


def test_a_wrong_link_is_answered_with_an_error_page(visit: Any, study: Any) -> None:
    visitor = visit("lost", 360)
    for link, status in ((study.link.replace("ms-pacman", "nobody"), 404), (study.link + "&userId=a/b", 400)):
        answer = visitor.page.goto(link)
        assert answer.status == status
        assert visitor.page.evaluate(FLAWS) == []
    visitor.pictures = True
    visitor.shot("0-broken-link")
    assert visitor.hosts == {"127.0.0.1"}


def test_two_clicks_on_a_button_send_one_form(visit: Any, study: Any) -> None:
    visitor = visit("twice")
    visitor.open()
    for box in visitor.page.get_by_role("checkbox").all():
        box.check()
    visitor.page.locator("form.page button").dblclick()
    visitor.page.wait_for_selector("body[data-step='2']")
    began = time.monotonic()
    while not servers_of(study.data, {"twice"}) and time.monotonic() < began + PATIENCE / 1000:
        visitor.page.wait_for_timeout(100)
    assert len({process.environ()["SERVER"] for process in servers_of(study.data, {"twice"})}) == 1
    visitor.check_all()
