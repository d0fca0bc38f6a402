"""The game page of an installation without a domain: it reaches its own server alone, and knows about clocks."""

from __future__ import annotations

from typing import Any

import pytest

from testing.waiting import until
from tests.browser.world import NOWHERE, World, shot

pytestmark = pytest.mark.browser


def test_the_page_is_loaded_again_for_each_server_and_reaches_it(world: World, lone_tab: Any) -> None:
    world.named, world.step = False, 2
    lone_tab.goto(world.url)
    lone_tab.wait_for_selector("#wait:visible")
    with lone_tab.expect_navigation():
        world.ready()
    lone_tab.wait_for_selector("#play:visible")
    until(lambda: world.connections)
    world.game_url = NOWHERE  # Spot has taken the server, and another is ready
    world.ready()
    with lone_tab.expect_navigation():
        world.connections[0].close(1001)


@pytest.mark.parametrize("width", [360, 1280])
def test_a_device_whose_clock_is_behind_is_told_so(world: World, lone_tab: Any, width: int) -> None:
    lone_tab.set_viewport_size({"width": width, "height": 740})
    world.named, world.step, world.ahead = False, 2, 12 * 60
    world.game_url = NOWHERE
    world.ready()
    lone_tab.goto(world.url)
    lone_tab.wait_for_selector('#overlay-hint:text("Your device\'s clock is 12 minutes behind")')
    shot(lone_tab, f"clock-behind-{width}")
    world.ahead = 0
    lone_tab.wait_for_selector("#overlay-hint:text('Please stay on this page')")
