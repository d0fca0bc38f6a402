"""The game page on a phone: size of the picture, buttons for thumbs, messages, and a dead connection."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.conftest import hold_timers, own_page
from tests.browser.world import LAST_PICTURE, NOWHERE, PATIENCE, World, shot, tell

pytestmark = pytest.mark.browser
SCENE = {"width": 960, "height": 500, "background": "#c6e8f4", "coordinates": "pixels"}


@pytest.fixture(scope="module")
def phone_context(chromium: Any) -> Iterator[Any]:
    """The browser context that the phones of all tests share."""
    context = chromium.new_context(viewport={"width": 360, "height": 640}, has_touch=True, is_mobile=True)
    context.set_default_timeout(PATIENCE)
    context.new_page()  # keeps a window open, as in `narrow`
    yield context
    context.close()


@pytest.fixture
def phone(phone_context: Any) -> Iterator[Any]:
    """A page on a phone of 360 by 640 pixels."""
    with own_page(phone_context) as page:
        yield page


def play(world: World, phone: Any, size: tuple[int, int], trial: dict[str, Any], ui: list[str]) -> None:
    """Open the page of a running game that is drawn by objects and shows a line of text above its picture."""
    width, height = size
    phone.set_viewport_size({"width": width, "height": height})
    scene = {**SCENE, **trial.get("scene", {})}
    world.trial = {**trial, "scene": scene, "ui": dict.fromkeys(ui, True)}
    world.controls = {
        "UI": ui, "scene": scene, "assets": [], "maxEpisodes": 3, "actionSpace": ["noop", "up", "left", "right", "down", "wait"],
        **{key: trial[key] for key in ("pace", "keys", "labels") if key in trial},
    }  # fmt: skip

    world.step = 2
    world.ready()
    phone.goto(world.url)
    phone.wait_for_selector("#overlay-button:visible")
    drawn = {"new": True, "set": {}, "hud": "0 of 8 acorns, 36 turns left"}
    world.connections[0].send(struct.pack("!BI", 4, 3) + json.dumps(drawn).encode())
    phone.wait_for_selector("#scene-hud:visible")
    tell(world, state="playing", toAct=True)
    phone.wait_for_selector("#play[data-state=playing]", state="attached")


def box(phone: Any, selector: str) -> dict[str, float]:
    found: dict[str, float] = phone.locator(selector).bounding_box()
    return found


def overflow(phone: Any) -> list[int]:
    """By how many pixels the page is wider and higher than the window."""
    found: list[int] = phone.evaluate(
        "[document.documentElement.scrollWidth - innerWidth, document.documentElement.scrollHeight - innerHeight]"
    )
    return found


ALL = ["up", "down", "left", "right", "start", "pause"]


def test_a_game_with_turns_and_a_line_of_its_own_fits_the_smallest_phone(world: World, phone: Any) -> None:
    play(world, phone, (320, 568), {"pace": "turns", "scene": {"width": 640, "height": 480}}, ALL)
    assert phone.inner_text("#turn") == "Your turn"
    shot(phone, "320-turns")
    assert overflow(phone) == [0, 0]


def test_a_wide_picture_on_a_phone_held_sideways_is_larger_than_upright(world: World, phone: Any) -> None:
    play(world, phone, (640, 360), {}, ALL)
    assert overflow(phone) == [0, 0]
    shot(phone, "640-wide")
    sideways = box(phone, "#screen")["width"]
    phone.set_viewport_size({"width": 360, "height": 640})
    assert sideways > 1.15 * box(phone, "#screen")["width"]


def test_the_whole_page_fits_a_small_phone_held_sideways(world: World, phone: Any) -> None:
    play(world, phone, (568, 320), {"scene": {"width": 480, "height": 384}}, ALL)
    assert overflow(phone) == [0, 0]


def test_words_above_the_picture_wrap_into_a_second_line(world: World, phone: Any) -> None:
    play(world, phone, (568, 320), {"pace": "turns", "scene": {"width": 640, "height": 480}}, ALL)
    tell(world, state="playing", toAct=True, episode=2, score=123456, episodeScore=123456)
    phone.wait_for_selector("#total:text('Total 123,456')")
    shot(phone, "568-turns")
    assert all(box(phone, f"#{each}")["x"] + box(phone, f"#{each}")["width"] <= 568 for each in ("turn", "scene-hud"))
    assert overflow(phone) == [0, 0]


@pytest.mark.parametrize("size", [(360, 640), (568, 320)], ids=str)
@pytest.mark.parametrize("keys", [{}, {"keys": {"ArrowLeft": "left", "ArrowUp": "up", "ArrowRight": "right"}}])
def test_an_arrow_has_the_projects_text_below_it(
    world: World, phone: Any, size: tuple[int, int], keys: dict[str, Any]
) -> None:
    labels = {"left": "Nach links", "up": "Rudern!"}
    play(world, phone, size, {**keys, "labels": labels}, ["up", "left", "right", "start"])
    shot(phone, f"{size[0]}-labels-{len(keys)}")
    shown = "([name, part]) => getComputedStyle(document.querySelector(`.pad .${name}`), part).content"
    texts = [phone.evaluate(shown, [name, "::after"]) for name in ("left", "up", "right")]
    assert texts == ['"Nach links"', '"Rudern!"', "none"]
    for name in labels:
        assert phone.evaluate(
            "name => (each => each.scrollHeight <= each.clientHeight && each.scrollWidth <= each.clientWidth)"
            "(document.querySelector(`.pad .${name}`))",
            name,
        )
    assert overflow(phone) == [0, 0]


JUMPS = {"keys": {"ArrowLeft": "left", "ArrowUp": "up", "ArrowRight": "right"}}


@pytest.mark.parametrize("size", [(360, 640), (320, 568), (640, 360), (568, 320)], ids=str)
def test_left_and_right_are_under_the_left_thumb_and_jump_under_the_right(
    world: World, phone: Any, size: tuple[int, int]
) -> None:
    play(world, phone, size, JUMPS, ["up", "left", "right", "start", "pause"])
    assert overflow(phone) == [0, 0]
    shot(phone, f"{size[0]}-thumbs")
    left, right, up = (box(phone, f".pad .{name}") for name in ("left", "right", "up"))
    assert left["x"] < right["x"] < size[0] / 2 < up["x"]
    assert min(up["x"] - right["x"] - right["width"], left["width"] - 43, up["height"] - 43) > 0
    for touched in (right, up):
        x, y = touched["x"] + touched["width"] / 2, touched["y"] + touched["height"] / 2
        assert phone.evaluate("([x, y]) => Boolean(document.elementFromPoint(x, y).closest('.hold'))", [x, y])


def test_two_thumbs_hold_two_buttons_at_once(world: World, phone: Any) -> None:
    play(world, phone, (640, 360), JUMPS, ["up", "left", "right", "start", "pause"])
    fingers = [
        {"x": each["x"] + each["width"] / 2, "y": each["y"] + each["height"] / 2, "id": at}
        for at, each in enumerate(box(phone, f".pad .{name}") for name in ("right", "up"))
    ]
    devtools = phone.context.new_cdp_session(phone)
    for touching in (fingers[:1], fingers):
        devtools.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": touching})
    world.wait_for({"key": "ArrowUp", "held": True})
    assert {"key": "ArrowRight", "held": True} in world.received
    assert {"key": "ArrowRight", "held": False} not in world.received
    devtools.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    world.wait_for({"key": "ArrowRight", "held": False})
    world.wait_for({"key": "ArrowUp", "held": False})


def test_the_countdown_covers_little_of_the_first_picture(world: World, phone: Any) -> None:
    play(world, phone, (360, 640), {"resetFreeze": 2}, ALL)
    tell(world, state="playing", startsIn=2)
    world.trial_state |= {"startsIn": 2}
    phone.wait_for_selector("#overlay-title:text('Get ready')")
    shot(phone, "360-freeze")
    assert box(phone, "#overlay")["height"] < box(phone, "#screen")["height"] / 4
    assert box(phone, "#overlay")["y"] < box(phone, "#screen")["y"] + 1
    tell(world, state="paused")
    phone.wait_for_selector("#overlay-title:text('Paused')")
    panel, picture = box(phone, "#overlay"), box(phone, "#screen")
    assert abs(2 * panel["y"] + panel["height"] - 2 * picture["y"] - picture["height"]) < 2, "it stands in the middle"


def test_at_a_zoom_of_200_percent_the_picture_is_beside_the_buttons_and_the_keys_are_below_them(
    world: World, chromium: Any
) -> None:
    """The window has 1280 by 800 pixels of the screen, which are 640 by 400 of the page."""
    context = chromium.new_context(viewport={"width": 640, "height": 400}, device_scale_factor=2)
    page = context.new_page()
    play(world, page, (640, 400), JUMPS, ["up", "left", "right", "start", "pause"])
    shot(page, "640-zoom")
    picture, buttons, keys = (box(page, each) for each in ("#screen", "#controls", "#legend"))
    context.close()
    assert picture["width"] > 360
    assert picture["x"] + picture["width"] <= buttons["x"]
    assert keys["y"] >= buttons["y"] + buttons["height"]
    assert abs(keys["x"] + keys["width"] / 2 - buttons["x"] - buttons["width"] / 2) < 20


def test_no_message_covers_the_last_picture_and_its_score_is_announced(world: World, phone: Any) -> None:
    hold_timers(phone, LAST_PICTURE)
    play(world, phone, (360, 640), {}, ALL)
    world.connections[0].send(json.dumps({"error": "That move is not possible now"}))
    phone.wait_for_selector("#trouble:text('not possible')")
    world.connections[0].send(json.dumps({"done": True, "score": 21, "episodes": 3}))
    phone.wait_for_selector("#overlay-title:text('The game is over')")
    assert phone.inner_text("#trouble") == ""
    assert phone.inner_text("#announce") == "Your total score in 3 games: 21"


@pytest.mark.parametrize("size", [(320, 568), (360, 640), (568, 320), (740, 360)], ids=lambda size: f"{size[0]}")
def test_the_words_at_the_end_of_a_game_that_failed_fit_a_phone(
    world: World, phone: Any, size: tuple[int, int]
) -> None:
    play(world, phone, size, {}, ALL)
    failed = "Something went wrong, so the game ends here. Everything so far is saved."
    world.connections[0].send(json.dumps({"done": True, "score": 21, "episodes": 1, "error": failed}))
    phone.wait_for_selector("#overlay-hint:visible:text('ends here')")
    shot(phone, f"{size[0]}-failed")
    over, line = box(phone, "#overlay"), box(phone, ".hud")
    assert over["y"] >= line["y"] + line["height"] - 1, "the line above the picture is not covered"
    assert over["y"] + over["height"] <= size[1]
    assert phone.evaluate("(each => each.scrollHeight <= each.clientHeight)(document.getElementById('overlay'))")


# Bad Wi-Fi

HANGS = "Your connection is slow. Please stay on this page."


def fall_silent(world: World, heard: list[dict[str, Any]], state: str = "playing") -> None:
    """Make the trial server send its first message and nothing more."""

    def speak(connection: Any) -> None:
        world.connections.append(connection)
        for text in connection:
            heard.append(json.loads(text))
            if "token" in heard[-1] and len(world.connections) == 1:
                said = {"UI": ["start"], "actionSpace": ["noop"], "state": state, "episode": 1, "maxEpisodes": 1}
                connection.send(json.dumps({**said, "score": 0, "frameRate": 30}))

    world.play = speak  # type: ignore[method-assign]
    world.step = 2
    world.ready()


@pytest.mark.parametrize("state", ["playing", "paused"])
def test_within_three_seconds_the_page_says_that_the_connection_hangs(
    world: World, stopped_clock_tab: Any, state: str
) -> None:
    heard: list[dict[str, Any]] = []
    fall_silent(world, heard, state)
    stopped_clock_tab.goto(world.url)
    stopped_clock_tab.wait_for_selector(f"#play[data-state={state}]", state="attached")
    stopped_clock_tab.clock.run_for(3_000)
    assert stopped_clock_tab.inner_text("#trouble") == HANGS
    shot(stopped_clock_tab, "360-hangs")
    stopped_clock_tab.evaluate(
        """() => {
            const title = document.getElementById("overlay-title"), trouble = document.getElementById("trouble");
            const note = () => title.textContent.includes("lost") && (window.beside ??= trouble.textContent);
            new MutationObserver(note).observe(title, { childList: true });
        }"""
    )
    stopped_clock_tab.clock.run_for(7_000)
    stopped_clock_tab.wait_for_selector("#overlay-title:text('Connection lost')")
    assert stopped_clock_tab.evaluate("window.beside") == "", "what hangs is not said of a connection that is lost"


def test_a_message_of_the_server_clears_the_sentence_about_the_connection(world: World, stopped_clock_tab: Any) -> None:
    heard: list[dict[str, Any]] = []
    fall_silent(world, heard)
    stopped_clock_tab.goto(world.url)
    stopped_clock_tab.wait_for_selector("#play[data-state=playing]", state="attached")
    stopped_clock_tab.clock.run_for(3_000)
    assert stopped_clock_tab.inner_text("#trouble") == HANGS
    tell(world, state="playing", episodeScore=30)
    stopped_clock_tab.wait_for_selector("#score:text('30')")
    stopped_clock_tab.clock.run_for(1_000)
    assert stopped_clock_tab.inner_text("#trouble") == ""


MESSAGE = 8_000  # ms for which the page shows one, as hippodrome/web/game/overlay.js has it
COVERED = """() => {
    const box = (each) => each.getBoundingClientRect(), words = box(document.getElementById("trouble"));
    return [...document.getElementById("overlay").children].filter((each) => {
        const { top, bottom, left, right } = box(each);
        return bottom > top && top < words.bottom && bottom > words.top && left < words.right && right > words.left;
    }).map((each) => each.textContent);
}"""


@pytest.mark.parametrize("size", [(360, 640), (740, 360), (768, 1024), (1280, 800)], ids=lambda size: f"{size[0]}")
def test_a_message_covers_none_of_the_words_over_the_picture(world: World, phone: Any, size: tuple[int, int]) -> None:
    hold_timers(phone, MESSAGE)
    play(world, phone, size, {}, ALL)
    failed = "Something went wrong, so this game has ended. You will continue with the next game."
    world.connections[0].send(json.dumps({"error": failed}))
    tell(world, state="break", nextIn=9)
    phone.wait_for_selector("#overlay-hint:text('The next game starts')")
    assert (phone.evaluate(COVERED), phone.inner_text("#trouble")) == ([], failed)
    shot(phone, f"{size[0]}-message-in-a-break")
    world.connections[0].send(json.dumps({"error": failed}))
    world.state = {**world.state, "url": NOWHERE}
    world.connections[0].socket.close()
    world.connections[0].close()
    phone.wait_for_selector("#overlay-title:text('Connection lost')")
    assert (phone.evaluate(COVERED), phone.inner_text("#trouble")) == ([], failed)
    shot(phone, f"{size[0]}-message-and-lost")


def test_scores_of_any_kind_stand_in_one_line_above_the_picture(world: World, phone: Any) -> None:
    play(world, phone, (360, 640), {}, ALL)
    height = "document.querySelector('.hud').scrollHeight"
    tell(world, state="playing", episode=10, maxEpisodes=12, score=70, episodeScore=30)
    phone.wait_for_selector("#episode:text('Game 10 of 12')")
    before = phone.evaluate(height)
    tell(world, state="playing", episode=10, maxEpisodes=12, score=-12345.6789, episodeScore=-234.5678)
    phone.wait_for_selector("#score:text('-234.57')")
    assert phone.inner_text("#total") == "Total -12,346"
    assert phone.evaluate(height) == before
    assert phone.evaluate("document.documentElement.scrollWidth") <= 360
    right = "Math.max(...[...document.querySelectorAll('.hud span')].map((each) => each.getBoundingClientRect().right))"
    assert phone.evaluate(right) <= 360
    shot(phone, "360-scores")


@pytest.mark.parametrize(("score", "shown"), [(0.1 + 0.2, "0.3"), (999.996, "1,000"), (1234.5, "1,235"), (-7, "-7")])
def test_scores_below_a_thousand_have_at_most_two_decimals(world: World, phone: Any, score: float, shown: str) -> None:
    play(world, phone, (360, 640), {}, ALL)
    tell(world, state="playing", score=score, episodeScore=score)
    phone.wait_for_selector(f"#score:text-is('{shown}')")
