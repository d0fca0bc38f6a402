"""The game page without a network: in each phase it says so, that what was done is kept, and what to do. Then it recovers."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import pytest

from tests.browser.test_together_browser import LOBBY
from tests.browser.world import World, play, shot, tell

pytestmark = pytest.mark.browser


def waiting(world: World, page: Any) -> None:
    world.step = 2
    page.goto(world.url)
    page.wait_for_selector("#wait:visible")


def in_lobby(world: World, page: Any) -> None:
    world.more, world.state = {"players": 2}, dict(LOBBY)
    waiting(world, page)


def playing(world: World, page: Any) -> None:
    play(world, page)
    tell(world, state="playing")
    page.wait_for_selector("#play[data-state=playing]", state="attached")


def paused(world: World, page: Any) -> None:
    play(world, page)
    tell(world, state="paused")
    page.wait_for_selector("#overlay-title:text('Paused')")


def on_a_break(world: World, page: Any) -> None:
    play(world, page)
    tell(world, state="break", nextIn=60)
    page.wait_for_selector("#overlay-hint:text('The next game starts')")


def reading(world: World, page: Any) -> None:
    world.trial, world.texts = {"betweenEpisodes": "pause"}, {"betweenEpisodes": "<h2>Have a rest</h2>"}
    play(world, page)
    tell(world, state="break")
    page.wait_for_selector("h2:visible:text('Have a rest')")


def saving(world: World, page: Any) -> None:
    play(world, page)
    tell(world, state="ended")
    page.wait_for_selector("#overlay-title:text('Saving')")


def over(world: World, page: Any) -> None:
    play(world, page)
    page.route("**/*", lambda route: route.abort() if route.request.method == "HEAD" else route.continue_())
    world.connections[0].send(json.dumps({"done": True, "score": 21, "episodes": 1}))
    page.click("#overlay-button:text('Continue')")
    page.wait_for_selector("#leave:visible")
    page.unroute("**/*")


PHASES = [waiting, in_lobby, playing, paused, on_a_break, reading, saving, over]


@pytest.mark.parametrize("width", [360, 1280])
@pytest.mark.parametrize("phase", PHASES, ids=lambda phase: phase.__name__)
def test_without_a_network_the_page_says_what_is_kept_and_what_to_do_and_it_recovers(
    world: World, lone_tab: Any, phase: Callable[[World, Any], None], width: int
) -> None:
    lone_tab.set_viewport_size({"width": width, "height": 740})
    phase(world, lone_tab)
    lone_tab.context.set_offline(True)
    for connection in world.connections:
        connection.socket.close()  # Chromium keeps a WebSocket to this machine
    lone_tab.wait_for_function(
        "() => ['connection', 'trying again', 'stay on this page', 'mobile data'].every(each => document.body.innerText.toLowerCase().includes(each))"
    )
    assert re.search(r"Your (answers are|game is) (safe|saved)", lone_tab.inner_text("main"))
    assert lone_tab.evaluate("[document.documentElement.scrollWidth - innerWidth]") == [0]
    shot(lone_tab, f"{width}-no-network-{phase.__name__}")
    requests = len(world.polls)
    if phase is over:
        world.step, world.source = 3, "<h1>Next page</h1>"
    lone_tab.context.set_offline(False)
    if phase is over:
        lone_tab.wait_for_selector("h1:text('Next page')")
    elif world.connections:
        lone_tab.wait_for_selector("#overlay-title:text('Ready?')")
        assert len(world.connections) == 2
    else:
        lone_tab.wait_for_selector("#wait-status:empty", state="attached")
        assert len(world.polls) > requests


def test_what_is_filled_in_between_two_games_is_sent_once_it_is_complete(world: World, tab: Any) -> None:
    world.trial = {"betweenEpisodes": "beliefs"}
    world.texts = {
        "betweenEpisodes": "<label>How sure are you? <input name='sure' type='number' required></label>"
        "<label><input type='checkbox' name='saw' value='red'> red</label>"
        "<label><input type='checkbox' name='saw' value='blue'> blue</label>"
    }
    play(world, tab)
    tell(world, state="break")
    tab.wait_for_selector("input[name=sure]:visible")
    tab.click("#reading-button")
    assert tab.is_visible("input[name=sure]"), "a required field is empty"
    tab.fill("input[name=sure]", "70")
    tab.check("input[value=red]")
    tab.check("input[value=blue]")
    shot(tab, "fields-between-games")
    tab.press("input[name=sure]", "Enter")
    world.wait_for({"form": {"page": "betweenEpisodes", "fields": {"sure": "70", "saw": ["red", "blue"]}}})
    world.wait_for({"command": "start"})
    tell(world, state="playing", episode=2)
    tab.wait_for_selector("#screen:visible")
    tell(world, state="break", episode=2)
    tab.wait_for_selector("input[name=sure]:visible")
    assert tab.input_value("input[name=sure]") == ""
