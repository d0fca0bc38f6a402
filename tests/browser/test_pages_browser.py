"""Step pages and the game page in a real Chromium: what their scripts do, and that they fit a phone."""

from __future__ import annotations

import json
import struct
import threading
import time
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from hippodrome.control.model.texts import IN_ENGLISH
from hippodrome.control.participants import frame, game_modules
from hippodrome.control.participants.texts import in_script
from tests.browser.conftest import hold_timers
from tests.browser.world import (
    FLAWS,
    LAST_PICTURE,
    NOWHERE,
    PATIENCE,
    RED,
    World,
    deflated_zeros,
    pack,
    play,
    shot,
    tell,
    wait_for_reconnection,
)
from tests.trial.conftest import Running, grid_agent

STEPS = Path(__file__).resolve().parents[2] / "steps"
pytestmark = pytest.mark.browser


# Step pages


@pytest.mark.parametrize("path", sorted(STEPS.glob("*.html")), ids=lambda path: path.stem)
def test_the_example_fits_a_telephone(world: World, tab: Any, path: Path) -> None:
    world.source = path.read_text()
    tab.goto(world.url)
    assert tab.evaluate("document.documentElement.scrollWidth") <= 360
    small = tab.evaluate(
        """[...document.querySelectorAll('button, select, textarea, input:not([type=hidden])')].filter(field => {
            const target = field.closest('label') ?? field;
            return target.getBoundingClientRect().height < 44;
        }).map(field => field.outerHTML)"""
    )
    assert small == []


def test_answers_survive_a_reload_and_are_deleted_when_they_are_sent(world: World, tab: Any) -> None:
    world.source = """<input name=a id=a><input type=checkbox name=b value=1><input type=checkbox name=b value=2 id=b2>
        <input type=radio name=r value=x><input type=radio name=r value=y id=y><select name=s id=s><option>one<option>two</select>
        <textarea name=t id=t></textarea><input type=password name=p id=p>"""
    tab.goto(world.url)
    tab.fill("#a", "some words")
    tab.check("#b2")
    tab.check("#y")
    tab.select_option("#s", "two")
    tab.fill("#t", "one\ntwo")
    tab.fill("#p", "secret")
    assert "secret" not in tab.evaluate("JSON.stringify(localStorage)")
    tab.reload()
    assert tab.input_value("#a") == "some words"
    assert tab.input_value("#t") == "one\ntwo"
    assert tab.input_value("#s") == "two"
    assert tab.is_checked("#b2")
    assert tab.is_checked("#y")
    world.source = "<p id=second>Second</p>"
    tab.click("text=Continue")
    tab.wait_for_selector("#second")
    assert tab.evaluate("localStorage.length") == 0
    expected = {"a": "some words", "b": "2", "r": "y", "s": "two", "t": "one\r\ntwo", "p": ""}
    assert world.posts == [{"hippodrome-step": "1", "hippodrome-ticket": "T", **expected}]


@pytest.mark.parametrize(
    "name",
    [
        "elements",
        "submit",
        "action",
        "length",
        "name",
        "reset",
        "checkValidity",
        "addEventListener",
        "querySelectorAll",
    ],
)
def test_a_field_may_have_the_name_of_a_property_of_forms(world: World, tab: Any, name: str) -> None:
    world.source = f"<input name={name} class=field><input type=range name=slider>"
    tab.goto(world.url)
    tab.fill(".field", "words")
    tab.reload()
    assert tab.input_value(".field") == "words"
    assert tab.text_content("output") == "\N{EN DASH}"
    world.source = "<p id=second>Second</p>"
    said = tab.evaluate(
        """() => {
            for (let i = 0; i < 2; i += 1) document.querySelector('.send button').click();
            return document.querySelector('.send .status').textContent;
        }"""
    )
    assert said == IN_ENGLISH["sending"]
    tab.wait_for_selector("#second")
    assert [post[name] for post in world.posts] == ["words"]


def test_a_second_click_sends_nothing(world: World, tab: Any) -> None:
    world.may_answer.clear()
    sent: list[str] = []
    tab.on("request", lambda request: sent.append(request.method))
    tab.goto(world.url)
    said = tab.evaluate(
        """async () => {
            for (let i = 0; i < 5; i += 1) {
                document.querySelector('.send button').click();
                await new Promise((done) => setTimeout(done, 20));  // a browser sends only the last of clicks at once
            }
            return document.querySelector('.status').textContent;
        }"""
    )
    assert said == "Sending…"
    world.may_answer.set()
    tab.wait_for_selector("text=Step 2 of 4")
    assert sent.count("POST") == 1
    assert len(world.posts) == 1


def test_a_form_that_is_too_large_is_not_sent(world: World, tab: Any) -> None:
    world.source = "<textarea name=t id=t></textarea>"
    tab.goto(world.url)
    tab.fill("#t", "x" * 300_000)
    tab.click("text=Continue")
    assert "Please shorten your longest answer by about 51,000 characters." in tab.inner_text(".status")
    assert len(tab.input_value("#t")) == 300_000
    assert world.posts == []


def test_the_page_says_by_how_many_characters_an_answer_is_too_long(world: World, tab: Any) -> None:
    world.source = "<label>Story <textarea name=t id=t></textarea></label><input name=other value=short>"
    tab.goto(world.url)
    tab.evaluate("document.getElementById('t').value = '\\u{1F600}'.repeat(80_000)")  # 320 KB, and encoded 960 KB
    tab.click("text=Continue")
    assert "Please shorten your answer to “Story” by about 60,000 characters." in tab.inner_text(".status")
    tab.evaluate("document.getElementById('t').value = '\\u{1F600}'.repeat(20_000)")
    tab.click("text=Continue")
    tab.wait_for_selector("text=Step 2 of 4")


def test_a_missing_answer_is_named(world: World, tab: Any) -> None:
    world.source = (
        "<fieldset><legend>How are you?</legend><label><input type=radio name=r required> Fine</label></fieldset>"
    )
    tab.goto(world.url)
    tab.click("text=Continue")
    assert tab.inner_text(".status") == "Please answer this question: “How are you?”"
    assert tab.evaluate("document.activeElement.name") == "r"


def test_the_sentence_on_a_missing_answer_goes_when_the_answer_is_given(world: World, tab: Any) -> None:
    world.source = (
        "<label>Age <input name=age required></label>"
        "<fieldset><legend>How are you?</legend><label><input type=radio name=r value=1 required> Fine</label>"
        "<label><input type=radio name=r value=2> Tired</label></fieldset>"
    )
    tab.goto(world.url)
    tab.click("text=Continue")
    age, how = (f"Please answer this question: “{name}”" for name in ("Age", "How are you?"))
    assert tab.inner_text(".status") == f"{age}\n{how}"
    assert tab.locator(".note").all_inner_texts() == ["Please answer this question."] * 2
    assert tab.evaluate("document.activeElement.name") == "age"
    tab.click("text=Continue")
    assert tab.inner_text(".status") == f"{age}\n{how}"
    tab.check("text=Tired")
    assert tab.inner_text(".status") == age, "another answer does not take it away"
    tab.fill("[name=age]", "30")
    assert (tab.inner_text(".status"), tab.locator(".note").count()) == ("", 0)
    tab.click("text=Continue")
    tab.wait_for_selector("text=Step 2 of 4")


def test_without_a_connection_the_first_click_only_warns(world: World, lone_tab: Any) -> None:
    lone_tab.goto(world.url)
    lone_tab.context.set_offline(True)
    lone_tab.click("text=Continue")
    assert "You appear to be offline" in lone_tab.inner_text(".status")
    lone_tab.context.set_offline(False)
    lone_tab.click("text=Continue")
    lone_tab.wait_for_selector("text=Step 2 of 4")


BARE = """<h1>Bare</h1>
<label for=c>Colour</label><input type=color id=c name=c><label for=f>File</label><input type=file id=f name=f>
<label for=x>Text</label><input id=x name=x><label>Slider <input type=range name=r></label>
<input type=radio id=q name=q><label for=q>One</label>
<label for=t>More</label><textarea id=t name=t></textarea>
<img alt="" width=120 height=60 src="data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg'/%3E">
<button>I agree</button>"""


@pytest.mark.parametrize("width", [360, 1280])
def test_bare_tags_stand_below_each_other(world: World, tab: Any, width: int) -> None:
    world.source = BARE
    tab.set_viewport_size({"width": width, "height": 800})
    tab.goto(world.url)
    order = ["h1", "[for=c]", "#c", "[for=f]", "#f", "[for=x]", "#x", "label:has(.range)", "#q", "[for=t]", "#t", "img", "button"]  # fmt: skip
    boxes = [tab.locator(f".page > {each}").bounding_box() for each in order]
    for name, above, below in zip(order[1:], boxes, boxes[1:], strict=False):
        assert below["y"] >= above["y"] + above["height"], name
    assert tab.evaluate("document.documentElement.scrollWidth") <= width


def test_a_table_that_its_page_makes_narrow_has_the_width_of_a_phone(world: World, tab: Any) -> None:
    """The tables of HIPPO Gym's sample pages say `width: 60%`."""
    cells = "".join(f"<td>Strongly disagree {number}" for number in range(6))
    world.source = f"<style>table {{ width: 60% }}</style><p>Hi</p><table><tr>{cells}</table>"
    tab.set_viewport_size({"width": 360, "height": 740})
    tab.goto(world.url)
    assert tab.locator("table").bounding_box()["width"] == tab.locator(".page > p").bounding_box()["width"]
    assert tab.evaluate("document.documentElement.scrollWidth") <= 360


def test_a_slider_shows_its_number(world: World, tab: Any) -> None:
    world.source = "<input type=range name=r id=r min=0 max=10 value=3>"
    tab.goto(world.url)
    assert tab.inner_text("output") == "3"
    tab.focus("#r")
    tab.keyboard.press("ArrowRight")
    assert tab.inner_text("output") == "4"


def sent_answers(world: World, tab: Any) -> dict[str, str]:
    world.source = "<p id=second>Second</p>"
    tab.click("text=Continue")
    tab.wait_for_selector("#second")
    return {name: value for name, value in world.posts[-1].items() if not name.startswith("hippodrome-")}


UNSET = "<label for=r>How sure?</label><input type=range name=r id=r min=0 max=10 {}><input name=t id=t>"


def test_a_slider_without_a_value_sends_nothing_until_it_is_moved(world: World, tab: Any) -> None:
    world.source = UNSET.format("")
    tab.goto(world.url)
    assert tab.inner_text("output") == "\N{EN DASH}"
    tab.fill("#t", "words")
    tab.reload()
    assert tab.inner_text("output") == "\N{EN DASH}", "the draft does not move it"
    assert sent_answers(world, tab) == {"t": "words"}


@pytest.mark.parametrize(("touch", "value"), [("tap", "5"), ("key", "6"), ("script", "9")])
def test_a_slider_that_was_touched_is_an_answer(world: World, tab: Any, touch: str, value: str) -> None:
    world.source = UNSET.format("")
    tab.goto(world.url)
    if touch == "tap":
        tab.click("#r")
        tab.reload()  # the draft has it
    elif touch == "key":
        tab.focus("#r")
        tab.keyboard.press("ArrowRight")
    else:
        tab.evaluate("document.querySelector('#r').value = 9")
    assert sent_answers(world, tab) == {"r": value, "t": ""}


def test_an_unset_slider_takes_no_other_answer_of_its_name_with_it(world: World, tab: Any) -> None:
    world.source = (
        "<input type=range name=r id=first><input type=range name=r>"
        "<input type=range name=t disabled><input name=t value=50><input type=range value=7><input type=range name=none>"
    )
    tab.goto(world.url)
    tab.focus("#first")
    tab.keyboard.press("End")
    assert sent_answers(world, tab) == {"r": "100", "t": "50"}


def test_a_required_slider_must_be_moved(world: World, tab: Any) -> None:
    world.source = UNSET.format("required")
    tab.goto(world.url)
    tab.click("text=Continue")
    assert "How sure?" in tab.inner_text(".status")
    assert world.posts == []
    tab.click("#r")
    assert tab.locator(".note").count() == 0
    assert sent_answers(world, tab) == {"r": "5", "t": ""}


def test_a_completion_code_is_copied(world: World, lone_tab: Any) -> None:
    world.step, world.source = 3, "<h1>Bye</h1><p class=code>ABC</p>"
    lone_tab.context.grant_permissions(["clipboard-read", "clipboard-write"])
    lone_tab.goto(world.url)
    lone_tab.click(".code")
    assert lone_tab.evaluate("getSelection().toString().trim()") == "ABC"
    before = lone_tab.locator(".copy").bounding_box()
    lone_tab.click("text=Copy")
    lone_tab.wait_for_selector("text=Copied")
    assert lone_tab.locator(".copy").bounding_box() == before
    assert lone_tab.evaluate("navigator.clipboard.readText()") == "ABC"


def test_the_researchers_scripts_run_and_inline_handlers_do_not(world: World, chromium: Any) -> None:
    world.source = "<p id=a>no</p><script>document.getElementById('a').textContent='yes'</script><img src=/x onerror='document.title=1'>"
    page = chromium.new_page()
    page.goto(world.url)
    page.wait_for_timeout(200)
    assert page.inner_text("#a") == "yes"
    assert page.title() != "1"
    page.close()


def test_step_pages_work_without_javascript(world: World, chromium: Any) -> None:
    world.source = "<label>Age <input name=age></label>"
    page = chromium.new_context(java_script_enabled=False).new_page()
    page.goto(world.url)
    page.get_by_label("Age").fill("30")
    page.get_by_role("button", name="Continue").click()
    page.get_by_text("Step 2 of 4").wait_for()
    assert world.posts[0]["age"] == "30"
    page.context.close()


# The game


MARK = "getComputedStyle(document.querySelector('.stages [aria-current]'), '::before').boxShadow"


def test_the_mark_of_the_stage_beats_with_the_clock_and_nothing_is_drawn_in_between(
    world: World, stopped_clock_tab: Any
) -> None:
    """An animation would keep a phone drawing for as long as the participant waits."""
    tab = stopped_clock_tab
    world.step = 2
    tab.goto(world.url)
    tab.wait_for_selector(".stages:visible")
    marks = []
    for _ in range(4):
        marks.append(tab.evaluate(MARK))
        assert tab.evaluate("document.getAnimations().length") == 0
        tab.clock.run_for(1_000)
    assert marks[:2] == marks[2:]
    assert marks[0] != marks[1]
    tab.emulate_media(reduced_motion="reduce")
    still = tab.evaluate(MARK)
    tab.clock.run_for(1_000)
    assert tab.evaluate(MARK) == still


def test_the_page_goes_from_waiting_to_the_game_without_a_reload(world: World, tab: Any) -> None:
    world.step = 2
    tab.goto(world.url)
    tab.evaluate("window.same = true")
    assert tab.inner_text("[aria-current=step]") == "Request received"
    world.state = {"state": "naming", "seconds": 9, "typical": 20, "attempt": 1}
    tab.wait_for_selector("[aria-current=step]:text('connection')")
    assert "This usually takes about 20 seconds." in tab.inner_text(".clock")
    world.ready()
    tab.wait_for_selector("#overlay-button:visible")
    assert tab.evaluate("window.same") is True
    assert tab.title().startswith("Ready")
    assert world.received[0] == {"userId": "P1", "token": "TOKEN", "step": "3", "decodes": ["deflate", "jpeg"]}


def test_the_start_button_appears_with_the_first_picture(world: World, tab: Any) -> None:
    """A button that appeared earlier would move with the first picture, and a tap on it would be lost."""
    pictures = threading.Event()
    world.before_pictures = lambda: pictures.wait(PATIENCE / 1000)
    tab.add_init_script(
        "const sheet = new CSSStyleSheet(); sheet.replaceSync('* { animation-play-state: paused !important }');"
        "document.adoptedStyleSheets = [sheet];"
    )
    world.step = 2
    world.ready()
    tab.goto(world.url)
    tab.wait_for_selector("#overlay-title:text('Ready')")
    assert not tab.is_visible("#overlay-button")
    pictures.set()
    tab.wait_for_selector("#overlay-button:visible")
    assert tab.evaluate("document.getElementById('screen').width") == 2


def test_the_start_button_appears_even_if_no_picture_comes(world: World, tab: Any) -> None:
    pictures = threading.Event()
    world.before_pictures = lambda: pictures.wait(PATIENCE / 1000)
    world.step = 2
    world.ready()
    tab.goto(world.url)
    tab.wait_for_selector("#overlay-button:visible")
    tab.click("#overlay-button")
    assert tab.evaluate("document.getElementById('screen').width") == 160
    pictures.set()
    world.wait_for({"command": "start"})


def test_the_title_says_ready_until_the_game_has_begun(world: World, tab: Any) -> None:
    play(world, tab)
    title = tab.title()
    assert title.startswith("Ready")
    tell(world, state="playing")
    tab.wait_for_selector("#overlay", state="hidden")
    assert not tab.title().startswith("Ready")
    assert title.endswith(tab.title())


def test_one_button_starts_pauses_and_goes_on(world: World, tab: Any) -> None:
    play(world, tab)
    both = tab.locator("#overlay-button, [data-command=toggle]")
    for state, word in (("ready", "Start"), ("playing", "Pause"), ("paused", "Resume")):
        tell(world, state=state)
        tab.wait_for_selector(f"#play[data-state={state}]")
        assert both.locator("visible=true").all_inner_texts() == [word]


def test_frames_are_drawn_in_order_and_acknowledged(world: World, tab: Any) -> None:
    play(world, tab)
    world.wait_for({"ack": 2})
    pixel = "[...document.getElementById('screen').getContext('2d').getImageData(1, 1, 1, 1).data]"
    assert tab.evaluate(pixel) == [0, 0, 255, 255]
    assert tab.evaluate("document.getElementById('screen').width") == 2


def test_keys_are_sent_as_held_and_released(world: World, tab: Any) -> None:
    play(world, tab)
    tab.keyboard.down("ArrowLeft")
    tab.keyboard.down("ArrowLeft")  # a keyboard repeats a key that is held
    world.wait_for({"action": "left", "held": True})
    tab.keyboard.down("KeyA")  # another key with the same action
    tab.keyboard.up("ArrowLeft")
    tab.keyboard.up("KeyA")
    world.wait_for({"action": "left", "held": False})
    tab.keyboard.press("Space")
    world.wait_for({"action": "fire", "held": True})
    tab.wait_for_selector("#play[data-state=playing]", state="attached")
    tab.keyboard.press("KeyP")
    world.wait_for({"command": "pause"})
    tab.keyboard.press("KeyR")
    world.wait_for({"command": "reset"})
    said = [each for each in world.received if each.get("action") == "left"]
    assert said == [{"action": "left", "held": True}, {"action": "left", "held": False}]


def test_the_numeric_keypad_has_arrows_without_numlock_and_digits_with_it(world: World, tab: Any) -> None:
    world.controls = {"actionSpace": ["noop", "left", "jump", "crouch"]}
    play(world, tab)
    tab.keyboard.down("Numpad4")  # in Playwright "ArrowLeft", and with Shift "4"
    world.wait_for({"action": "left", "held": True})
    tab.keyboard.down("Shift")
    tab.keyboard.up("Numpad4")
    world.wait_for({"action": "left", "held": False})
    tab.keyboard.press("Numpad2")
    world.wait_for({"action": "crouch", "held": False})
    assert world.player_commands()[0] == "start"  # the first key starts the game
    assert tab.evaluate("scrollY") == 0


def test_the_legend_lists_the_controls_of_the_project(world: World, tab: Any) -> None:
    play(world, tab)
    legend = tab.eval_on_selector_all("#legend > span", "all => all.map((each) => each.textContent)")
    assert legend == ["←↑→ move", "Space fire", "P start or pause", "R restart"]
    said = {"UI": ["left"], "actionSpace": ["noop", "left", "right"], "state": "ready", "episode": 1}
    world.connections[0].send(json.dumps(said))
    tab.wait_for_selector("#legend > span:nth-child(3)", state="detached")
    legend = tab.eval_on_selector_all("#legend > span", "all => all.map((each) => each.textContent)")
    assert legend == ["← move", "Space start"]


def test_leaving_the_window_releases_the_key(world: World, tab: Any) -> None:
    play(world, tab)
    tab.keyboard.down("ArrowRight")
    world.wait_for({"action": "right", "held": True})
    tab.evaluate("window.dispatchEvent(new Event('blur'))")
    world.wait_for({"action": "right", "held": False})


def test_the_command_key_releases_the_key(world: World, tab: Any) -> None:
    """macOS sends no keyup of another key while Cmd is held: the browser does not tell that the arrow is released."""
    play(world, tab)
    tab.keyboard.down("ArrowRight")
    world.wait_for({"action": "right", "held": True})
    tab.keyboard.down("Meta")
    world.wait_for({"action": "right", "held": False})
    tab.keyboard.up("Meta")
    tab.keyboard.up("ArrowRight")  # the browser of this test knows that the arrow was held
    world.received.clear()
    tab.keyboard.down("ArrowRight")
    world.wait_for({"action": "right", "held": True})


def test_each_control_of_the_project_has_a_button(world: World, tab: Any) -> None:
    play(world, tab)
    names = tab.eval_on_selector_all(
        "#controls button", "all => all.map(each => each.getAttribute('aria-label') ?? each.textContent)"
    )
    assert names == ["Up", "Left", "Right", "Fire", "Pause", "Restart"]  # "down" is no action of this game
    assert tab.evaluate("document.documentElement.scrollWidth") <= 360
    tab.dispatch_event("#controls button.left", "pointerdown", {"button": 0, "pointerId": 1})
    tab.focus("#controls button.right")
    tab.keyboard.press("Enter")
    world.wait_for({"action": "right"})


PLACES = """() => [...document.querySelectorAll("header, #screen, #controls button, #legend, .hud")]
    .map((each) => each.getBoundingClientRect()).map((box) => [box.x, box.y, box.right, box.bottom])"""


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (1280, 720), (1366, 657), (1024, 768), (1920, 1080)])
def test_the_game_fits_the_window_and_nothing_moves(world: World, tab: Any, width: int, height: int) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    play(world, tab)
    check_places(tab, width, height)
    assert tab.is_visible("#legend")
    before = tab.evaluate(PLACES)
    for button, command, state in (
        ("#overlay-button", "start", "playing"),
        ("[data-command=toggle]", "pause", "paused"),
    ):
        tab.click(button)
        world.wait_for({"command": command})
        tab.wait_for_selector(f"#play[data-state={state}]")
        assert tab.evaluate(PLACES) == before


@pytest.mark.parametrize(
    ("width", "height"), [(360, 640), (360, 740), (390, 844), (320, 568), (740, 360), (667, 375), (768, 1024)]
)
def test_the_game_fits_phones_and_tablets(world: World, chromium: Any, width: int, height: int) -> None:
    context = chromium.new_context(
        viewport={"width": width, "height": height}, has_touch=True, is_mobile=True, reduced_motion="reduce"
    )
    page = context.new_page()
    play(world, page)
    check_places(page, width, height)
    assert page.is_hidden("#legend")  # these devices have no keyboard
    before = page.evaluate(PLACES)
    page.locator("#overlay-button").tap()
    page.wait_for_selector("#play[data-state=playing]")
    assert page.evaluate(PLACES) == before
    for part, action in (("#play", "manipulation"), (".pad", "none"), (".others", "none")):
        assert page.locator(part).evaluate("part => getComputedStyle(part).touchAction") == action
    assert page.locator(".pad button").first.evaluate("part => getComputedStyle(part).userSelect") == "none"
    assert (
        page.locator("#play").evaluate("part => part.dispatchEvent(new Event('contextmenu', {cancelable: true}))")
        is False
    )
    context.close()


def check_places(page: Any, width: int, height: int) -> None:
    page.wait_for_function("() => document.getElementById('screen').width === 2")
    size = page.evaluate("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
    assert size == [width, height]
    for left, top, right, bottom in page.evaluate(PLACES):
        assert left >= 0
        assert top >= 0
        assert right <= width
        assert bottom <= height
    picture = page.locator("#screen").bounding_box()
    assert min(picture["width"], picture["height"]) >= 200
    assert abs(picture["width"] - picture["height"]) < 2  # this game's frames are square


def test_a_thumb_slides_from_one_button_to_the_next(world: World, tab: Any) -> None:
    play(world, tab)
    middle = [tab.locator(f"#controls .{name}").bounding_box() for name in ("left", "right")]
    points = [(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2) for box in middle]
    tab.mouse.move(*points[0])
    tab.mouse.down()
    world.wait_for({"action": "left", "held": True})
    tab.mouse.move(*points[1])
    world.wait_for({"action": "left", "held": False})
    world.wait_for({"action": "right", "held": True})
    tab.mouse.up()
    world.wait_for({"action": "right", "held": False})


def test_a_lost_connection_is_made_again_where_the_server_is_now(world: World, tab: Any) -> None:
    play(world, tab)
    world.state = {**world.state, "token": "NEW"}
    world.connections[0].socket.close()
    world.connections[0].close()
    world.wait_for({"userId": "P1", "token": "NEW", "step": "3", "decodes": ["deflate", "jpeg"]})
    tab.wait_for_selector("#overlay-button:visible")


def test_a_game_opened_elsewhere_comes_back_only_after_a_click(world: World, tab: Any) -> None:
    play(world, tab)
    world.connections[0].close(4409, "opened elsewhere")
    tab.wait_for_selector("text=Play here instead")
    tab.wait_for_timeout(1500)
    assert len(world.connections) == 1
    tab.click("text=Play here instead")
    tab.wait_for_selector("#overlay-button:text('Start')")
    assert len(world.connections) == 2


def test_when_the_game_is_done_the_study_goes_on(world: World, tab: Any) -> None:
    play(world, tab)
    world.step = 3
    world.source = "<h1>Next page</h1>"
    world.connections[0].send(json.dumps({"done": True, "episodes": 2, "score": 70}))
    tab.wait_for_selector("text=Next page")


def test_the_header_has_the_score_of_this_game_and_the_total(world: World, tab: Any) -> None:
    play(world, tab)
    tell(world, state="playing", episode=2, score=1370, episodeScore=70)
    tab.wait_for_selector("#episode:text('Game 2 of 2')")
    assert tab.inner_text("#score") == "70"
    assert tab.inner_text("#total") == "Total 1,370"
    assert tab.evaluate("document.documentElement.scrollWidth") <= 360


def test_a_break_shows_the_score_and_counts_down(world: World, stopped_clock_tab: Any) -> None:
    tab = stopped_clock_tab
    play(world, tab)
    tab.keyboard.down("ArrowLeft")
    world.wait_for({"action": "left", "held": True})
    tell(world, state="break", nextIn=2.9)
    tab.wait_for_selector("#overlay-hint:text('The next game starts in 3 seconds.')")
    assert tab.inner_text("#overlay-title") == "Game 1 of 2 is over"
    assert tab.inner_text("#overlay-score") == "Your score: 30"
    world.wait_for({"action": "left", "held": False})
    before = world.player_commands()
    tab.keyboard.press("ArrowRight")
    tab.keyboard.press("Space")  # fires here
    world.wait_for({"action": "fire", "held": False})
    assert world.player_commands() == before, "no key of the game ends the break"
    tab.clock.run_for(2_000)
    assert tab.inner_text("#overlay-hint") == "The next game starts in 1 second."
    tab.click("text=Continue now")
    world.wait_for({"command": "start"})
    tab.wait_for_selector("#overlay", state="hidden")
    assert tab.inner_text("#overlay-score") == ""


def test_a_control_of_the_projects_own_is_a_button_that_sends_its_command(world: World, tab: Any) -> None:
    play(world, tab)
    said = {"UI": ["trainOnline", "reallyGood"], "words": ["reallyGood"], "actionSpace": ["noop"], "state": "ready"}
    world.connections[0].send(json.dumps(said))
    tab.wait_for_selector("[data-command=reallyGood]")
    assert tab.eval_on_selector_all("#controls button", "all => all.map(each => each.textContent)") == [
        "Really good",
        "Train online",
    ]
    tab.click("text=Really good")
    world.wait_for({"command": "reallyGood"})


def wait_for_next_page(tab: Any, *, within: int) -> None:
    """Let time pass on the stopped clock, at most `within` ms, until the next page is shown."""
    for _ in range(0, within, 10):
        if tab.is_visible("text=Next page"):
            return
        tab.clock.run_for(10)
        tab.wait_for_timeout(100)  # until the site has answered
    raise AssertionError


def test_the_end_shows_the_last_picture_with_the_score_for_four_seconds(world: World, stopped_clock_tab: Any) -> None:
    tab = stopped_clock_tab
    play(world, tab)
    world.step = 3
    world.source = "<h1>Next page</h1>"
    world.connections[0].send(json.dumps({"done": True, "episodes": 2, "score": 1370}))
    tab.wait_for_selector("#overlay-score:visible:text('Your total score in 2 games: 1,370')")
    assert tab.inner_text("#overlay-title") == "The game is over"
    tab.clock.run_for(3_900)
    assert tab.is_visible("#screen")
    assert tab.is_visible("#overlay-score")
    tab.clock.run_for(100)
    wait_for_next_page(tab, within=4_000)


FAILED = "Something went wrong, so the game ends here. Everything so far is saved."


@pytest.mark.parametrize("own", [None, "Das Spiel ging kaputt."])
def test_the_end_of_a_game_that_failed_says_so_until_the_participant_goes_on(
    world: World, stopped_clock_tab: Any, own: str | None
) -> None:
    tab = stopped_clock_tab
    world.more = {"texts": {"saidGameFailed": own}} if own else {}
    play(world, tab)
    world.step = 3
    world.source = "<h1>Next page</h1>"
    world.connections[0].send(json.dumps({"error": FAILED}))
    world.connections[0].send(json.dumps({"state": "ended", "episode": 1, "score": 2}))
    world.connections[0].send(json.dumps({"done": True, "episodes": 1, "score": 2, "error": FAILED}))
    tab.wait_for_selector("#overlay-score:visible:text('Your score: 2')")
    said = own or FAILED
    assert tab.inner_text("#overlay-hint") == said
    assert tab.inner_text("#announce") == f"Your score: 2 {said}"
    assert tab.inner_text("#trouble") == "", "not a second time"
    tab.clock.run_for(60_000)
    assert tab.is_visible("#overlay-hint")
    tab.click("#overlay-button")
    wait_for_next_page(tab, within=3_900)


def test_a_participant_can_go_on_from_the_last_picture_at_once(world: World, stopped_clock_tab: Any) -> None:
    tab = stopped_clock_tab
    play(world, tab)
    world.step = 3
    world.source = "<h1>Next page</h1>"
    world.connections[0].send(json.dumps({"done": True, "episodes": 1, "score": 7}))
    tab.wait_for_selector("#overlay-button:text('Continue')")
    assert tab.evaluate("document.activeElement.id") == "overlay-button"
    tab.keyboard.press("Enter")
    wait_for_next_page(tab, within=3_900)
    assert {"command": "start"} not in world.received


def test_the_last_picture_is_drawn_even_if_it_comes_with_the_end(world: World, tab: Any) -> None:
    hold_timers(tab, LAST_PICTURE)
    play(world, tab)
    tab.keyboard.press("Space")
    world.wait_for({"command": "start"})
    world.connections[0].send(pack(3, RED * 4))
    world.connections[0].send(json.dumps({"done": True, "episodes": 1, "score": 7}))
    tab.wait_for_selector("#overlay-button:text('Continue')")
    pixel = "[...document.getElementById('screen').getContext('2d').getImageData(0, 0, 1, 1).data].join()"
    tab.wait_for_function(f"() => {pixel} === '255,0,0,255'")


def test_without_ui_pause_the_page_offers_no_pause(world: World, tab: Any) -> None:
    play(world, tab)
    for score, ui in enumerate((["left", "start"], ["left"]), 1):
        said = {"UI": ui, "actionSpace": ["noop", "left"], "state": "ready", "episode": 1}
        world.connections[0].send(json.dumps(said))
        tab.wait_for_function("() => document.querySelectorAll('#legend > span').length === 2")
        tell(world, state="playing", episodeScore=score)
        tab.wait_for_function(f"() => document.getElementById('score').textContent === '{score}'")
        assert tab.inner_text("#legend") == "← move\nSpace start"
        assert tab.locator("[data-command=toggle]:visible").count() == 0
        before = world.player_commands()
        tab.keyboard.press("KeyP")
        tab.keyboard.press("Space")
        tab.keyboard.press("ArrowLeft")
        world.wait_for({"action": "left", "held": False})
        assert world.player_commands() == before
        world.received.clear()
        tell(world, state="paused")  # as after an absence of the page
        tab.wait_for_selector("#overlay-button:visible")
        tab.keyboard.press("Space")
        world.wait_for({"command": "start"})


@pytest.mark.parametrize(("width", "height"), [(360, 740), (1280, 800)])
def test_two_games_on_a_real_server(world: World, tab: Any, tmp_path: Path, width: int, height: int) -> None:
    """The page shows the first game, the break, the second game and the end. It saves screenshots for people to look at."""
    tab.set_viewport_size({"width": width, "height": height})
    ui = dict.fromkeys(("left", "right", "up", "down", "start", "pause"), True)
    server = Running(tmp_path, grid_agent(40), {"maxEpisodes": 2, "betweenEpisodes": 600, "ui": ui}, {})
    hold_timers(tab, LAST_PICTURE)
    try:
        play_two_games(world, tab, server, width)
    finally:
        server.process.kill()
        server.wait()


def play_two_games(world: World, tab: Any, server: Running, width: int) -> None:
    world.step = 2
    world.state = {**world.state, "state": "ready", "url": server.address, "token": "the-secret-token", "userId": "P1"}
    tab.goto(world.url)
    tab.click("#overlay-button")
    tab.wait_for_selector("text=Game 1 of 2 is over")
    assert tab.inner_text("#overlay-score") == "Your score: 60"
    assert tab.evaluate(FLAWS) == []
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    shot(tab, f"{width}-game-break")
    tab.click("text=Continue now")
    tab.wait_for_selector("#episode:text('Game 2 of 2')")
    world.step, world.source = 3, "<h1>Next page</h1>"
    tab.wait_for_selector("#overlay-title:text('The game is over')")
    assert tab.inner_text("#overlay-score") == "Your total score in 2 games: 120"
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-game-end")
    tab.evaluate("window.letGo()")
    tab.wait_for_selector("text=Next page")


@pytest.mark.parametrize("width", [360, 1200])
def test_the_page_says_that_the_server_was_lost_and_goes_on_with_the_next(world: World, tab: Any, width: int) -> None:
    tab.set_viewport_size({"width": width, "height": 740})
    play(world, tab)
    world.state = {"state": "ready", "seconds": 9, "attempt": 1, "url": NOWHERE, "token": "T", "userId": "P1"}
    world.connections[0].socket.close()
    world.connections[0].close()
    tab.wait_for_selector("#overlay-title:text('Connection lost')")
    assert "Your game is safe" in tab.inner_text("#overlay-hint")
    shot(tab, f"{width}-3-lost-connection")
    world.state = {"state": "queued", "seconds": 1, "attempt": 2, "reason": "lost", "replaces": True}
    tab.wait_for_selector("h1:text('is moving to another server'):visible")
    assert tab.locator("h1:visible").count() == 1
    shot(tab, f"{width}-3-moves")
    world.ready()
    tab.wait_for_selector("#overlay-button:visible")
    assert len(world.connections) == 2


@pytest.mark.parametrize("width", [360, 1280])
def test_a_game_that_could_not_begin_is_still_loading_and_not_lost(world: World, tab: Any, width: int) -> None:
    tab.set_viewport_size({"width": width, "height": 740})
    world.step = 2
    world.refusal = "The game cannot be started at the moment. Please wait: it is tried again."
    world.ready()
    tab.goto(world.url)
    tab.wait_for_selector(f"#trouble:text('{world.refusal}')")
    world.state = {**world.state, "url": NOWHERE}
    tab.wait_for_selector("#overlay-hint:text('This is taking longer than usual. Please stay on this page.')")
    assert tab.inner_text("#overlay-title") == "Loading the game…"
    shot(tab, f"{width}-not-begun")
    world.refusal = ""
    world.ready()
    tab.wait_for_selector("#overlay-button:visible")


def test_the_page_of_a_first_server_does_not_say_that_the_game_moves(world: World, tab: Any) -> None:
    world.step = 2
    tab.goto(world.url)
    assert tab.locator("h1:visible").all_inner_texts() == ["Preparing your game"]


def test_the_page_says_what_may_help_if_the_server_cannot_be_reached(world: World, lone_tab: Any) -> None:
    world.step = 2
    world.ready()
    world.state["url"] = NOWHERE
    lone_tab.clock.install()
    lone_tab.goto(world.url)
    lone_tab.wait_for_selector("#overlay-hint:text('try Wi-Fi or mobile data')")
    assert lone_tab.inner_text("#overlay-title") == "Loading the game…", "no connection was there to lose"
    world.ready()
    lone_tab.clock.run_for(10_000)
    lone_tab.wait_for_selector("#overlay-button:visible")


def test_a_page_that_waits_for_long_reloads_itself(world: World, lone_tab: Any) -> None:
    world.step = 2
    loads: list[str] = []
    lone_tab.on("request", lambda request: request.url == world.url and loads.append(request.url))
    lone_tab.clock.install()
    lone_tab.goto(world.url)
    assert len(loads) == 1
    until = time.monotonic() + PATIENCE / 1000
    while len(loads) == 1:
        assert time.monotonic() < until
        lone_tab.clock.run_for(4_000)
        lone_tab.wait_for_timeout(5)
    lone_tab.wait_for_selector("h1:visible:text('Preparing your game')")
    assert len(loads) == 2


@pytest.mark.parametrize("width", [360, 1200])
@pytest.mark.parametrize("reason", ["lost", "refused", "no capacity", "full"])
def test_the_page_of_a_game_that_failed_for_good_offers_to_try_again(
    world: World, tab: Any, width: int, reason: str
) -> None:
    tab.set_viewport_size({"width": width, "height": 740})
    world.step = 2
    world.state = {"state": "failed", "seconds": 5, "attempt": 3, "again": True, "reason": reason}
    tab.goto(world.url)
    assert "not your fault" in tab.inner_text("main")
    assert tab.locator("main button:visible").all_inner_texts() == ["Try again"]
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-3-{reason.replace(' ', '-')}")


@pytest.mark.parametrize("width", [360, 1280])
@pytest.mark.parametrize("again", [True, False])
def test_a_participant_goes_on_without_a_game_that_failed(world: World, tab: Any, width: int, again: bool) -> None:
    tab.set_viewport_size({"width": width, "height": 740})
    world.step = 2
    world.state = {"state": "failed", "seconds": 5, "attempt": 3, "again": again, "without": True, "reason": "lost"}
    tab.goto(world.url)
    buttons = ["Continue without the game", "Try again"] if again else ["Continue without the game"]
    assert tab.locator("main button:visible").all_inner_texts() == buttons
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-3-without{'-or-again' if again else ''}")
    with tab.expect_navigation():
        tab.click("button:text('Continue without the game')")
    assert world.posts == [{"hippodrome-step": "3", "hippodrome-ticket": "T", "hippodrome-action": "without"}]
    assert tab.locator("#over").count() == 0, "the next step is shown"


def test_the_button_of_a_failed_game_asks_for_it_again(world: World, tab: Any) -> None:
    world.step = 2
    world.state = {"state": "failed", "seconds": 5, "attempt": 3, "again": True}
    tab.goto(world.url)
    tab.click("button:text('Try again')")
    tab.wait_for_selector("#wait:visible")  # although the server's record still says `failed`
    assert world.posts == [{"hippodrome-step": "3", "hippodrome-ticket": "T", "hippodrome-action": "restart"}]
    world.ready()
    tab.wait_for_selector("#overlay-button:visible")


def test_after_a_broken_frame_the_page_connects_again(world: World, tab: Any) -> None:
    play(world, tab)
    world.connections[0].send(pack(3, RED * 4)[:-4] + b"nonsense")
    wait_for_reconnection(world, tab)


def test_the_page_shows_an_error_of_the_server_as_plain_text(world: World, tab: Any) -> None:
    play(world, tab)
    world.connections[0].send(json.dumps({"error": "that is <b>not</b> possible"}))
    tab.wait_for_selector("#trouble:text('That is <b>not</b> possible')")


# Messages of a server whose agent is broken or hostile


XSS = "<img src=x onerror=window.xss=1><script>window.xss=1</script>"


def test_messages_of_a_hostile_server_never_become_markup(world: World, tab: Any) -> None:
    play(world, tab)
    for said in (
        {"UI": ["left", "start", XSS], "actionSpace": [XSS, "left", *(f"a{n}" for n in range(5000)), 7, None]},
        {
            "UI": "left",
            "actionSpace": 1,
            "state": XSS,
            "score": XSS,
            "episode": XSS,
            "maxEpisodes": 9,
            "frameRate": XSS,
        },
        {"UI": 1, "words": 1},
        {"UI": ["good"], "actionSpace": [""], "words": ["", 7]},
        {"error": XSS},
        {"error": {"a": 1}},
        {"UI": ["fpsSet"], "actionSpace": {}, "allowFrameRateChange": True, "minFrameRate": XSS, "maxFrameRate": XSS},
        {"state": "__proto__"},
        {"state": ["constructor"], "episode": {}, "score": []},
        {"UI": ["left"], "actionSpace": [XSS], "state": "playing"},
    ):
        world.connections[0].send(json.dumps(said))
    for text in ("null", "7", "[]", json.dumps("x")):
        world.connections[0].send(text)
    tab.wait_for_selector("#controls button >> text=<img")
    assert tab.evaluate("document.querySelectorAll('#play img, #play script').length") == 0
    assert tab.evaluate("document.querySelectorAll('#controls button').length") < 100
    assert tab.evaluate("window.xss") is None
    world.connections[0].send("no JSON")
    wait_for_reconnection(world, tab)


def test_participants_may_change_the_frame_rate_if_the_project_lets_them(world: World, tab: Any) -> None:
    world.trial = {"allowFrameRateChange": True}
    world.controls = {"UI": ["start", "fpsSet", "fpsUp", "fpsDown"], "allowFrameRateChange": True}
    play(world, tab)
    assert tab.inner_text(".rates output") == "30 frames per second"
    tab.click("[data-command=faster]")
    world.wait_for({"changeFrameRate": "faster"})
    tab.fill("#rate", "12")
    world.wait_for({"changeFrameRate": 12})
    tell(world, state="playing", frameRate=12)
    tab.wait_for_selector(".rates output:text-is('12 frames per second')")


@pytest.mark.parametrize(
    ("header", "unpacked"),
    [
        ((0, 3, 65535, 65535, 3), 12),
        ((0, 3, 2, 2, 255), 12),
        ((0, 3, 2, 2, 3), 1_000_000_000),  # a megabyte that unpacks to a gigabyte
        ((0, 3, 0, 0, 3), 0),
        ((1, 3, 3, 2, 3), 18),
        ((9, 3, 2, 2, 3), 11),
        (None, 0),
    ],
)
def test_pictures_of_absurd_sizes_are_refused(
    world: World, tab: Any, header: tuple[int, ...] | None, unpacked: int
) -> None:
    play(world, tab)
    world.connections[0].send(struct.pack("!BIHHB", *header) + deflated_zeros(unpacked) if header else b"\0\0")
    wait_for_reconnection(world, tab)
    assert tab.evaluate("document.getElementById('screen').width * document.getElementById('screen').height") < 100_000


# The script's modules


@pytest.mark.parametrize("sheet", sorted(path.name for path in frame.WEB.glob("*.css")))
def test_a_page_carries_the_same_rules_as_the_style_sheet(tab: Any, sheet: str) -> None:
    whole = (frame.WEB / sheet).read_text(encoding="utf-8")
    read = "css => { const s = new CSSStyleSheet(); s.replaceSync(css); return [...s.cssRules].map((r) => r.cssText) }"
    written, carried = (  # browsers keep some values as they are written
        [" ".join(rule.split()).replace(", ", ",").replace(": ", ":") for rule in tab.evaluate(read, css)]
        for css in (whole, frame._plain(sheet, whole))
    )
    assert carried == written
    assert len(carried) > 5


def test_the_game_also_plays_with_its_modules_loaded_one_by_one(world: World, tab: Any) -> None:
    """Each file is a valid module; the page carries them joined only to save requests."""
    loaded: list[str] = []

    def answer(route: Any) -> None:
        loaded.append(urlsplit(route.request.url).path)
        code = (frame.WEB / loaded[-1][1:]).read_text(encoding="utf-8")
        route.fulfill(content_type="text/javascript", body=in_script(code, IN_ENGLISH))

    tab.route(f"{world.url}game/*.js", answer)
    world.joined = False
    world.step = 2
    tab.goto(world.url)
    tab.wait_for_selector("[aria-current=step]:text('request')")
    play(world, tab)
    world.wait_for({"ack": 2})
    tab.keyboard.press("ArrowLeft")
    world.wait_for({"action": "left", "held": False})
    tab.click("#controls [data-action=fire]")
    tell(world, state="break", nextIn=2.9)
    tab.wait_for_selector("#overlay-title:text('Game 1 of 2 is over')")
    world.connections[0].send(json.dumps({"error": "no"}))
    tab.wait_for_selector("#trouble:text('No')")
    world.connections[0].close(4409, "elsewhere")
    tab.wait_for_selector("#overlay-title:text('another tab')")
    tab.click("#overlay-button")
    tab.wait_for_selector("#overlay-title:text('Ready?')")
    world.connections[1].send(json.dumps({"done": True, "episodes": 2, "score": 70}))
    tab.wait_for_selector("#overlay-title:text('The game is over')")
    modules = {path.name for path in (frame.WEB / "game").glob("*.js")} - {
        *game_modules.MODULES,
        *game_modules.OWN_WORDS,
        *game_modules.TOGETHER,
        "sliders.js",  # `reading.js` imports it
    }
    assert set(loaded) == {f"/game/{name}" for name in modules}
