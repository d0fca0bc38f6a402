"""A game that is played turn by turn, in a real Chromium."""

from __future__ import annotations

from typing import Any

import pytest

from tests.browser.world import FLAWS, World, play, shot, tell

pytestmark = pytest.mark.browser


@pytest.fixture
def in_turns(world: World) -> World:
    world.trial = {"pace": "turns"}
    world.controls = {"pace": "turns", "toAct": False, "player": "left", "players": ["left", "right"]}
    return world


@pytest.mark.parametrize(("width", "height"), [(360, 740), (1280, 800)])
def test_the_page_says_whose_turn_it_is_and_how_long_it_lasts(
    in_turns: World, stopped_clock_tab: Any, width: int, height: int
) -> None:
    tab = stopped_clock_tab
    tab.set_viewport_size({"width": width, "height": height})
    play(in_turns, tab)
    tell(in_turns, state="playing", toAct=True, turnEndsIn=8.5)
    tab.wait_for_selector("#turn:text('Your turn (9 s)')")
    assert tab.inner_text("#announce") == "Your turn"
    shot(tab, f"{width}-your-turn")
    tab.clock.run_for(2_000)
    assert tab.inner_text("#turn") == "Your turn (7 s)"
    tell(in_turns, state="playing", toAct=False)
    tab.wait_for_selector("#turn:text('The other player\u2019s turn')")
    assert tab.inner_text("#announce") == "", "a screen reader finds no turn that is over"
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-other-turn")
    tell(in_turns, state="playing", toAct=True)
    tab.wait_for_selector("#announce:text('Your turn')", state="attached")
    tell(in_turns, state="paused", toAct=False)
    tab.wait_for_function("() => document.getElementById('turn').textContent === ''")
    assert tab.inner_text("#announce") == "Paused"


def test_the_key_that_starts_the_game_makes_no_move(in_turns: World, tab: Any) -> None:
    play(in_turns, tab)
    tell(in_turns, state="ready", toAct=False)
    tab.wait_for_selector("#play[data-state=ready]", state="attached")
    before = len(in_turns.commands("action"))
    tab.keyboard.press("ArrowUp")
    in_turns.wait_for({"command": "start"})
    tell(in_turns, state="playing", toAct=True)
    tab.wait_for_selector("#turn:text('Your turn')")
    assert len(in_turns.commands("action")) == before
    tab.keyboard.press("ArrowUp")
    in_turns.wait_for({"action": "up", "held": True})


def test_a_page_for_turns_says_nothing_of_turns_in_a_game_in_real_time(world: World, tab: Any) -> None:
    """The study was registered again with `pace: turns`; the server still runs the earlier registration."""
    world.trial = {"pace": "turns"}
    world.controls = {"player": "left", "players": ["left", "right"]}
    play(world, tab)
    tell(world, state="playing")
    tab.wait_for_selector("#play[data-state=playing]", state="attached")
    assert tab.inner_text("#turn") == ""
