"""axe-core finds no fault in the pages that participants see, in any state of a game."""

from __future__ import annotations

import json
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe

from testing.processes import ROOT
from tests.browser.conftest import hold_timers
from tests.browser.test_phone_browser import play
from tests.browser.world import LAST_PICTURE, World, tell

pytestmark = pytest.mark.browser
SIZES = [(360, 740), (1280, 800)]
STEPS = ["consent-0", "questionnaire", "survey"]
ALL = ["up", "down", "left", "right", "start", "pause", "good", "bad"]


def faults(page: Any) -> list[str]:
    """Return what axe finds, with the elements."""
    found = Axe().run(page).response["violations"]
    return [f"{each['help']}: {node['html']}" for each in found for node in each["nodes"]]


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}")
@pytest.mark.parametrize("name", STEPS)
def test_a_page_before_and_after_its_answers_were_missing(
    world: World, tab: Any, name: str, size: tuple[int, int]
) -> None:
    tab.set_viewport_size({"width": size[0], "height": size[1]})
    world.source = (ROOT / "steps" / f"{name}.html").read_text()
    tab.goto(world.url)
    assert faults(tab) == []
    tab.locator("form button").last.click()
    tab.wait_for_selector(".note")
    assert faults(tab) == []


def test_the_wait_for_a_game(world: World, tab: Any) -> None:
    world.step = 2
    tab.goto(world.url)
    tab.wait_for_selector("#stage-queued[aria-current]")
    assert faults(tab) == []


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}")
def test_a_game_in_all_its_states(world: World, tab: Any, size: tuple[int, int]) -> None:
    hold_timers(tab, LAST_PICTURE)
    play(world, tab, size, {"episodeSeconds": 60}, ALL)
    for state in ("ready", "playing", "paused", "break"):
        tell(world, state=state, timeLeft=50, nextIn=9)
        tab.wait_for_selector(f"#play[data-state={state}]")
        assert faults(tab) == []
    world.connections[0].send(json.dumps({"done": True, "score": 21, "episodes": 3}))
    tab.wait_for_selector("#play[data-state=over]")
    assert faults(tab) == []
