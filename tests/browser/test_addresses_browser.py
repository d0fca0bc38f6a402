"""The game page of an installation without a domain: it reaches its own server alone, and knows about clocks."""

from __future__ import annotations

from datetime import datetime, timedelta
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
@pytest.mark.parametrize("ahead", [12 * 60, -8 * 86_400], ids=["late", "early"])
def test_a_device_whose_clock_is_wrong_is_told_so(world: World, lone_tab: Any, width: int, ahead: int) -> None:
    lone_tab.set_viewport_size({"width": width, "height": 740})
    world.named, world.step, world.ahead = False, 2, ahead
    world.game_url = NOWHERE
    world.ready()
    lone_tab.goto(world.url)
    right = datetime.now() + timedelta(seconds=ahead)
    hint = lone_tab.locator("#overlay-hint", has_text=f"it should show {right:%B} {right.day}, {right.year}")
    hint.wait_for()
    shot(lone_tab, f"clock-wrong-{'late' if ahead > 0 else 'early'}-{width}")
    world.ahead = 0
    lone_tab.wait_for_selector("#overlay-hint:text('Please stay on this page')")
