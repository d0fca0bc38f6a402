"""A project's own keys, labels and game pages in a real Chromium."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.browser.conftest import hold_timers, note_texts, wait_for_noted
from tests.browser.world import FLAWS, LAST_PICTURE, PATIENCE, World, play, shot, tell
from tests.trial.conftest import Running, grid_agent

pytestmark = pytest.mark.browser

KEYS = {
    "ArrowLeft": "left", "a": "left", "ArrowUp": "up", "ArrowLeft+ArrowUp": "leftup", " ": "jump", "Enter": "put", "1": "one",
}  # fmt: skip
LABELS = {"left": "Go left", "jump": "Jump!"}
SPACE = ["noop", "left", "up", "leftup", "jump", "put", "one"]
SIZES = pytest.mark.parametrize(("width", "height"), [(360, 740), (1280, 800)])


@pytest.fixture
def world_with_keys(world: World) -> World:
    world.trial = {"keys": KEYS, "labels": LABELS}
    world.controls = {"keys": KEYS, "labels": LABELS, "actionSpace": SPACE}
    return world


def wait_for_press(world: World, key: str) -> None:
    world.wait_for({"key": key, "held": True})
    world.wait_for({"key": key, "held": False})


def test_the_page_sends_the_projects_keys_by_the_browsers_names(world_with_keys: World, tab: Any) -> None:
    play(world_with_keys, tab)
    for key in ("ArrowLeft", "a", "Enter", "1"):
        tab.keyboard.press(key)
        wait_for_press(world_with_keys, key)
    tab.keyboard.press("Space")
    wait_for_press(world_with_keys, " ")
    assert world_with_keys.commands("action") == []


def test_a_letter_is_released_even_if_shift_was_pressed_meanwhile(world_with_keys: World, tab: Any) -> None:
    play(world_with_keys, tab)
    tab.keyboard.down("a")
    tab.keyboard.down("Shift")
    tab.keyboard.up("a")
    wait_for_press(world_with_keys, "a")
    tab.keyboard.press("Digit1")  # "!" with Shift
    wait_for_press(world_with_keys, "1")


def test_keys_outside_the_project_send_nothing_and_p_still_starts_and_pauses(world_with_keys: World, tab: Any) -> None:
    play(world_with_keys, tab)
    tab.keyboard.press("p")
    world_with_keys.wait_for({"command": "start"})
    tab.wait_for_selector("#play[data-state=playing]", state="attached")
    tab.keyboard.press("p")
    world_with_keys.wait_for({"command": "pause"})
    tab.keyboard.press("d")
    tab.keyboard.press("ArrowRight")
    tab.keyboard.press("a")
    wait_for_press(world_with_keys, "a")
    assert not [each for each in world_with_keys.received if "action" in each or each.get("key") in ("d", "ArrowRight")]


@SIZES
def test_each_action_has_a_button_except_those_that_two_keys_make_together(
    world_with_keys: World, tab: Any, width: int, height: int
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    play(world_with_keys, tab)
    names = "all => all.map(each => each.getAttribute('aria-label'))"
    assert tab.eval_on_selector_all("#controls .pad button", names) == ["Up", "Go left"]
    assert tab.eval_on_selector_all("#controls .others button", names) == ["Jump!", "Put", "One"]
    assert tab.evaluate(FLAWS) == []
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    shot(tab, f"{width}-keys")
    tab.click("text=Jump!")
    wait_for_press(world_with_keys, " ")
    tab.click("#controls .pad .left")
    wait_for_press(world_with_keys, "ArrowLeft")
    if width > 1000:
        assert tab.inner_text("#legend") == (
            "←A Go left\n↑ up\nSpace Jump!\nEnter put\n1 one\nP start or pause\nR restart"
        )


def test_an_action_of_two_keys_has_a_button_if_neither_key_has_one(world: World, tab: Any) -> None:
    world.trial = {"keys": {"x+y": "jump"}}
    world.controls = {"keys": {"x+y": "jump"}, "actionSpace": ["noop", "jump"]}
    play(world, tab)
    tab.click("#controls .others button")
    world.wait_for({"action": "jump", "held": True})
    world.wait_for({"action": "jump", "held": False})


def test_labels_without_keys_are_the_texts_of_the_usual_buttons(world: World, tab: Any) -> None:
    world.trial = {"labels": {"fire": "Serve", "left": "To the left"}}
    world.controls = world.trial
    tab.set_viewport_size({"width": 1280, "height": 800})
    play(world, tab)
    shot(tab, "1280-labels")
    assert tab.inner_text("#controls [data-action=fire]") == "Serve"
    assert tab.get_attribute("#controls [data-action=left]", "aria-label") == "To the left"
    below = tab.evaluate("getComputedStyle(document.querySelector('.pad .left'), '::after').content")
    assert below == '"To the left"', "also on a computer, where the page lists the keys without the project's texts"


# Pages beside the game

BETWEEN = 2_500  # ms for which the last picture is shown before the page between two games, as hippodrome/web/game/reading.js has it
RULES = "<h1>The rules</h1><p>Jump over the stones.</p>"
PAUSE = "<h2>Have a rest</h2><p>Look out of the window.</p>"


@pytest.fixture
def world_with_pages(world: World) -> World:
    world.trial = {"instructions": "rules", "betweenEpisodes": "pause"}
    world.texts = {"instructions": RULES, "betweenEpisodes": PAUSE}
    world.step = 2
    world.ready()
    return world


def test_a_slider_of_instructions_shows_its_number_and_is_no_answer_until_it_is_moved(
    world_with_pages: World, tab: Any
) -> None:
    sliders = "".join(
        f"<label for={name}>{name}</label><input type=range id={name} name={name} {more}>"
        for name, more in (("trust", "required"), ("fun", ""), ("set", "value=7"))
    )
    world_with_pages.texts["instructions"] = f"<h1>The rules</h1>{sliders}"
    tab.goto(world_with_pages.url)
    tab.click("text=Go to the game")
    assert tab.is_visible("#trust"), "it is required"
    tab.click("#trust")
    assert tab.locator("#reading output").all_inner_texts() == ["50", "\N{EN DASH}", "7"]
    shot(tab, "360-instructions-sliders")
    tab.click("text=Go to the game")
    world_with_pages.wait_for({"form": {"page": "instructions", "fields": {"trust": "50", "set": "7"}}})


@SIZES
def test_the_game_does_not_begin_while_the_instructions_are_shown(
    world_with_pages: World, tab: Any, width: int, height: int
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    tab.goto(world_with_pages.url)
    tab.wait_for_selector("text=Jump over the stones.")
    assert not tab.is_visible("#play")
    assert not tab.is_visible("text=Have a rest")
    assert tab.evaluate("document.activeElement.id") == "reading"
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-instructions")
    for key in ("Space", "ArrowLeft", "KeyP"):
        tab.keyboard.press(key)
    world_with_pages.wait_for({"ack": 2})
    assert {"command": "start"} not in world_with_pages.received
    assert not tab.is_visible("#play")
    tab.click("text=Go to the game")
    tab.wait_for_selector("#overlay-title:text('Ready?')")
    shot(tab, f"{width}-instructions-ready")
    tab.click("#overlay-button")
    world_with_pages.wait_for({"command": "start"})


def test_instructions_can_be_read_again_in_a_pause_and_are_not_shown_after_a_reload(
    world_with_pages: World, tab: Any
) -> None:
    tab.goto(world_with_pages.url)
    tab.click("text=Go to the game")
    tab.click("#overlay-button")
    tab.wait_for_selector("#play[data-state=playing]", state="attached")
    assert not tab.is_visible("#instructions-button")
    tab.keyboard.press("KeyP")
    tab.click("#instructions-button")
    tab.wait_for_selector("text=Jump over the stones.")
    shot(tab, "360-instructions-again")
    tab.click("text=Back to the game")
    tab.wait_for_selector("#overlay-title:text('Paused')")
    tab.reload()
    tab.wait_for_selector("#overlay-title:text('Ready?')")
    assert not tab.is_visible("text=Jump over the stones.")


@SIZES
def test_the_page_between_two_games_follows_the_last_picture_and_its_button_starts_the_next(
    world_with_pages: World, tab: Any, width: int, height: int
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    hold_timers(tab, BETWEEN)
    tab.goto(world_with_pages.url)
    tab.click("text=Go to the game")
    tab.click("#overlay-button")
    world_with_pages.wait_for({"command": "start"})
    tell(world_with_pages, state="break")
    tab.wait_for_selector("#overlay-title:text('Game 1 of 2 is over')")
    assert not tab.is_visible("text=Have a rest")
    assert tab.inner_text("#overlay-hint") == ""
    shot(tab, f"{width}-last-picture")
    tab.evaluate("window.letGo()")
    tab.wait_for_selector("text=Have a rest")
    assert tab.inner_text("#reading-score") == "Game 1 of 2 is over. Your score: 30"
    assert not tab.is_visible("text=Jump over the stones.")
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-between")
    before = len(world_with_pages.player_commands())
    tab.click("text=Next game")
    tab.wait_for_selector("#play[data-state=playing]", state="attached")
    assert world_with_pages.player_commands()[before:] == ["start"]
    assert tab.is_visible("#play")


def test_a_button_on_the_last_picture_opens_the_page_between_two_games(world_with_pages: World, tab: Any) -> None:
    hold_timers(tab, BETWEEN)
    tab.goto(world_with_pages.url)
    tab.click("text=Go to the game")
    tab.click("#overlay-button")
    world_with_pages.wait_for({"command": "start"})
    before = len(world_with_pages.player_commands())
    tell(world_with_pages, state="break")
    tab.click("#overlay-button:text('Continue')")
    tab.wait_for_selector("text=Have a rest")
    assert world_with_pages.player_commands()[before:] == []


# The first picture, and the time that is left


@SIZES
def test_the_first_picture_stands_still_with_a_countdown(
    world: World, stopped_clock_tab: Any, width: int, height: int
) -> None:
    tab = stopped_clock_tab
    tab.set_viewport_size({"width": width, "height": height})
    world.trial = {"resetFreeze": 3, "episodeSeconds": 90}
    play(world, tab)
    tell(world, state="playing", startsIn=2.9, timeLeft=90)
    tab.wait_for_selector("#overlay-title:text('Get ready')")
    assert tab.inner_text("#announce") == "Get ready. The game starts in 3 seconds."
    assert tab.inner_text("#left") == "1:30"
    assert tab.inner_text("#overlay-hint") == "3"
    shot(tab, f"{width}-countdown")
    for left in ("2", "1"):
        tab.clock.run_for(1_000)
        assert tab.inner_text("#overlay-hint") == left
    assert tab.inner_text("#left") == "1:30"
    assert tab.inner_text("#announce") == "Get ready. The game starts in 3 seconds."
    tell(world, state="playing", timeLeft=11.5)
    tab.wait_for_selector("#overlay", state="hidden")
    assert tab.inner_text("#announce") == "Playing"
    assert tab.inner_text("#left") == "0:12"
    tab.clock.run_for(1_000)
    assert tab.inner_text("#left") == "0:11"
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-time-left")
    tab.clock.run_for(800)
    assert tab.inner_text("#announce") == "10 seconds left"
    tell(world, state="paused", timeLeft=9.2)
    tab.wait_for_selector("#overlay-title:text('Paused')")
    tab.clock.run_for(1_500)
    assert tab.inner_text("#left") == "0:10"


def test_an_id_in_the_projects_page_does_not_shadow_that_of_the_game_page(world_with_pages: World, tab: Any) -> None:
    world_with_pages.texts["instructions"] += "<p id='score'>1</p>"
    tab.goto(world_with_pages.url)
    tab.click("text=Go to the game")
    world_with_pages.connections[0].send(json.dumps({"state": "playing", "episode": 1, "score": 5, "frameRate": 30}))
    tab.wait_for_selector(".hud #score:text('5')")
    assert tab.text_content("#text-instructions #score") == "1"


# On a real server

WAITS = grid_agent(1000).replace(
    "        self.t += 1\n",
    """        self.t += 1
        while self.t == 5 and not pathlib.Path(PRESSED).exists():
            time.sleep(0.01)
""",
).replace("import gymnasium\n", "import pathlib\nimport time\n\nimport gymnasium\n", 1)  # fmt: skip
"""A game that waits at its fifth step until the test has pressed a key, however long that takes."""


@pytest.mark.parametrize(("width", "height", "touch"), [(360, 740, True), (1280, 800, False)])
def test_all_these_options_work_together_on_a_real_server(
    world: World, chromium: Any, tmp_path: Path, width: int, height: int, touch: bool
) -> None:
    """Instructions, a countdown, the project's own keys, a limit, a page between two games, the last picture."""
    section = {
        **{"maxEpisodes": 2, "maxSteps": 25, "resetFreeze": 1.5, "episodeSeconds": 60, "startingFrameRate": 20},
        **{"actionSpace": ["noop", "left", "right"], "keys": {"ArrowLeft": "left", "a": "left", "Enter": "right"}},
        **{"labels": {"right": "Go right"}, "instructions": "rules", "betweenEpisodes": "pause"},
    }
    context = chromium.new_context(
        viewport={"width": width, "height": height}, has_touch=touch, is_mobile=touch, reduced_motion="reduce"
    )
    context.set_default_timeout(PATIENCE)
    tab, wrong = context.new_page(), []
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.on("websocket", lambda socket: socket.on("framesent", lambda said: messages.append(str(said))))
    hold_timers(tab, BETWEEN, LAST_PICTURE)
    messages: list[str] = []
    pressed_file = tmp_path / "pressed"
    server = Running(tmp_path, WAITS.replace("PRESSED", repr(str(pressed_file))), section, {})
    try:
        world.trial, world.texts, world.step = section, {"instructions": RULES, "betweenEpisodes": PAUSE}, 2
        ready = {"state": "ready", "url": server.address, "token": "the-secret-token", "userId": "P1"}
        world.state = {**world.state, **ready}
        tab.goto(world.url)
        tab.click("text=Go to the game")
        tab.wait_for_selector("#overlay-title:text('Ready?')")
        shot(tab, f"{width}-real-ready")
        assert tab.is_visible("#legend") is not touch
        note_texts(tab, "#overlay-title")
        tab.click("#overlay-button")
        wait_for_noted(tab, "#overlay-title", "Get ready")
        shot(tab, f"{width}-real-countdown")
        tab.wait_for_selector("#overlay", state="hidden")
        with hold(tab, "#controls .others button" if touch else "Enter", touch):
            while not any("Enter" in each for each in messages):
                tab.wait_for_timeout(20)
            pressed_file.touch()
            tab.wait_for_selector("#overlay-title:text('Game 1 of 2 is over')")
        shot(tab, f"{width}-real-over")
        tab.click("#overlay-button")
        tab.click("text=Next game")
        world.step, world.source = 3, "<h1>Next page</h1>"
        tab.wait_for_selector("#overlay-title:text('The game is over')")
        shot(tab, f"{width}-real-end")
        assert tab.evaluate(FLAWS) == []
        tab.click("#overlay-button")
        tab.wait_for_selector("text=Next page")
    finally:
        server.process.kill()
        server.wait()
        context.close()
    assert not wrong
    recorded = [line for lines in server.recordings().values() for line in lines]
    taken = [line["actionName"] for line in recorded if line["kind"] == "step" and line["human"] is not None]
    assert taken
    assert set(taken) == {"right"}
    assert [line["limit"] for line in recorded if line["kind"] == "end"] == ["maxSteps", "maxSteps"]
    said = [message for line in recorded for message in line.get("messages", ()) if "key" in message]
    assert {message["key"] for message in said} == {"Enter"}


@contextlib.contextmanager
def hold(tab: Any, what: str, touch: bool) -> Iterator[None]:
    """Hold a key, or a finger on a button."""
    if touch:
        box = tab.locator(what).bounding_box()
        finger = tab.context.new_cdp_session(tab)
        point = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
        finger.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [point]})
        yield
        finger.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    else:
        tab.keyboard.down(what)
        yield
        tab.keyboard.up(what)
