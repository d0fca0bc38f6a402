"""The keys play the game, whatever was clicked or touched; a control that was reached with Tab keeps its own keys."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.browser.world import World, play, tell

pytestmark = pytest.mark.browser
CONTROLS = ["left", "right", "start", "pause", "good", "fpsUp", "fpsSet"]


@pytest.fixture
def rated(world: World) -> World:
    """A game whose speed participants may change with a slider and a button."""
    world.trial = {"allowFrameRateChange": True}
    world.controls = {"UI": CONTROLS, "actionSpace": ["noop", "left", "right", "fire"], "allowFrameRateChange": True}
    return world


def begin(world: World, page: Any) -> None:
    play(world, page)
    tell(world, state="playing")
    page.wait_for_selector("#play[data-state=playing]", state="attached")


def drag(page: Any) -> None:
    """Drag the slider, and let go of the mouse outside."""
    box = page.locator("#rate").bounding_box()
    page.mouse.move(box["x"] + 10, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 5)
    page.mouse.move(5, 5)
    page.mouse.up()


USES: list[Callable[[Any], None]] = [
    lambda page: page.click("#rate"),
    drag,
    lambda page: page.click("label[for=rate]"),
    lambda page: page.click("[data-command=faster]"),
    lambda page: page.click("[data-command=good]"),
    lambda page: page.click("[data-action=left]"),
]


@pytest.mark.parametrize("use", USES, ids=["click", "drag", "label", "button", "feedback", "action"])
@pytest.mark.parametrize("tabs", [0, 3], ids=["", "after Tab"])
def test_after_a_click_on_any_control_the_keys_play_the_game(
    rated: World, tab: Any, use: Callable[[Any], None], tabs: int
) -> None:
    begin(rated, tab)
    for _ in range(tabs):
        tab.keyboard.press("Tab")
    use(tab)
    for key, action in (("ArrowRight", "right"), ("Space", "fire")):
        tab.keyboard.press(key)
        rated.wait_for({"action": action, "held": True})
        rated.wait_for({"action": action, "held": False})
    tab.keyboard.press("p")
    rated.wait_for({"command": "pause"})
    assert len(rated.commands("changeFrameRate")) <= 1, "ArrowRight moves no slider"
    assert rated.commands("command").count("good") <= 1, "Space presses no button"


def test_after_a_touch_of_the_slider_the_keys_play_the_game(rated: World, chromium: Any) -> None:
    with chromium.new_context(viewport={"width": 820, "height": 1180}, has_touch=True, is_mobile=True) as context:
        tablet = context.new_page()
        begin(rated, tablet)
        tablet.tap("#rate")
        tablet.keyboard.press("ArrowRight")
        rated.wait_for({"action": "right", "held": True})


def test_a_slider_that_was_reached_with_tab_keeps_its_keys_and_no_others(rated: World, tab: Any) -> None:
    begin(rated, tab)
    while tab.evaluate("document.activeElement.id") != "rate":
        tab.keyboard.press("Tab")
    before = int(tab.input_value("#rate"))
    tab.keyboard.press("ArrowRight")
    rated.wait_for({"changeFrameRate": before + 1})
    tab.keyboard.press("Space")
    rated.wait_for({"action": "fire", "held": True})
    assert {"action": "right", "held": True} not in rated.received
    tab.click("#screen")
    tab.keyboard.press("ArrowRight")
    rated.wait_for({"action": "right", "held": True})


def test_a_button_that_was_reached_with_tab_is_pressed_by_its_keys_and_keeps_no_arrows(rated: World, tab: Any) -> None:
    begin(rated, tab)
    while tab.evaluate("document.activeElement.dataset.command") != "good":
        tab.keyboard.press("Tab")
    for key in ("Space", "Enter"):
        tab.keyboard.press(key)
    tab.keyboard.press("ArrowRight")
    rated.wait_for({"action": "right", "held": True})
    assert rated.commands("command").count("good") == 2
    assert {"action": "fire", "held": True} not in rated.received
