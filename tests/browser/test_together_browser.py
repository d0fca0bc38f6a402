"""The page of a game that several participants play together: the lobby, and who is there in the game."""

from __future__ import annotations

import contextlib
import json
import struct
import time
from collections.abc import Iterator
from typing import Any

import pytest

from testing.browser import ARGUMENTS, chromium_path, html_page
from tests.browser.conftest import PATIENCE, hold_timers, note_texts, noted
from tests.browser.test_pages_browser import FLAWS, LAST_PICTURE, World, shot, tell, world
from trial.core.session import PARTNER_MISSING, PING

__all__ = ["world"]  # a fixture
pytestmark = [pytest.mark.browser, pytest.mark.xdist_group("browser")]
SIZES = [(360, 740), (1280, 800)]
LOBBY = {
    "state": "lobby", "players": 2, "here": 1, "seconds": 40, "patience": 300, "then": "unmatched", "proposed": False,
    "userId": "P1", "step": "3",
}  # fmt: skip
MATCHED = {
    "state": "queued", "seconds": 0, "attempt": 1, "session": True, "players": 2, "members": 2, "userId": "P1",
    "step": "3",
}  # fmt: skip


@pytest.fixture
def together(world: World) -> World:
    world.more = {"players": 2}
    world.trial = {"afterAbsent": "end"}
    world.step = 2
    world.state = dict(LOBBY)
    world.controls = {"player": "blue", "players": ["blue", "red"], **people(red="here")}
    return world


def people(**others: str) -> dict[str, Any]:
    """What each message says of who is there, to the blue player."""
    return {"you": "blue", "people": {"blue": "here", **others}}


def shows(page: Any, selector: str, text: str) -> None:
    page.wait_for_function(
        "([selector, text]) => document.querySelector(selector).textContent.includes(text)", arg=[selector, text]
    )


def fits(page: Any) -> None:
    """What covers the picture, or the window, is no higher than that, and its words are seen whole."""
    assert page.evaluate(
        """() => {
            const each = document.getElementById("overlay"), covers = getComputedStyle(each).position === "fixed";
            const most = covers ? innerHeight : each.parentElement.getBoundingClientRect().height;
            return each.scrollHeight <= each.clientHeight && each.getBoundingClientRect().height <= most + .5;
        }"""
    )


def waited_for(world: World, polls: int) -> None:
    """The page has asked so many times more."""
    until, wanted = time.monotonic() + PATIENCE / 1000, len(world.polled) + polls
    while len(world.polled) < wanted:
        assert time.monotonic() < until
        time.sleep(0.02)


# The lobby


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_lobby_says_how_many_are_there_for_how_long_and_what_happens_at_the_end(
    together: World, tab: Any, width: int, height: int
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    tab.goto(together.url)
    assert tab.locator("h1:visible").all_inner_texts() == ["Waiting for another participant"]
    assert tab.inner_text("#lobby-here") == "You are the first of 2"
    shows(tab, "#lobby-clock", "You have waited for 4")
    shows(tab, "#lobby-then", "If nobody else comes in the next 4 min ")
    assert tab.inner_text("#lobby-then").endswith("you go on to the next part of the study without this game.")
    assert tab.locator(".stages:visible, .clock:visible").count() == 1
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-lobby")
    together.state = {**LOBBY, "here": 2, "seconds": 44, "proposed": True}
    shows(tab, "#lobby-here", "Found: another participant is here. One moment, please…")
    assert tab.inner_text("#lobby-then") == ""
    assert tab.title().startswith("Found \u2013 ")
    shot(tab, f"{width}-lobby-found")


def test_a_lobby_of_many_counts_them(together: World, tab: Any) -> None:
    together.more = {"players": 16}
    together.state = {**LOBBY, "players": 16, "here": 11, "then": "policies"}
    tab.goto(together.url)
    assert tab.inner_text("h1:visible") == "Waiting for other participants"
    assert tab.inner_text("#lobby-here") == "11 of 16 are here, you included"
    assert tab.locator("#lobby-places i").count() == 16
    assert tab.locator("#lobby-places .taken").count() == 11
    assert "computer players take the empty places" in tab.inner_text("#lobby-then")
    assert tab.evaluate("document.documentElement.scrollWidth") <= 360
    shot(tab, "360-lobby-16")
    together.state = {**together.state, "here": 23}
    shows(tab, "#lobby-here", "16 of 16")


def test_what_changes_is_announced_once_and_not_every_second(together: World, tab: Any) -> None:
    together.more, together.state = {"players": 3}, {**LOBBY, "players": 3}
    tab.goto(together.url)
    tab.evaluate(
        """() => {
            window.said = [];
            new MutationObserver(() => window.said.push(document.getElementById("announce").textContent))
                .observe(document.getElementById("announce"), { childList: true, characterData: true, subtree: true });
        }"""
    )
    waited_for(together, 2)
    assert tab.evaluate("window.said") == []
    together.state = {**together.state, "here": 2}
    shows(tab, "#lobby-here", "2 of 3 are here")
    assert tab.evaluate("window.said") == ["2 of 3 are here, you included"]


def test_at_the_end_of_the_patience_the_page_says_what_happens(together: World, tab: Any) -> None:
    together.state = {**LOBBY, "seconds": 297, "then": "policies"}
    tab.goto(together.url)
    shows(tab, "#lobby-then", "If nobody else comes in the next 3 seconds, you play with a computer player instead.")
    together.state = {**together.state, "seconds": 300}
    shows(tab, "#lobby-then", "Nobody else has come, so you play with a computer player instead. One moment, please…")


@pytest.mark.parametrize(
    ("players", "here", "then", "said"),
    [
        (2, 1, "policies", "Nobody else has come: you play with a computer player. One moment, please…"),
        (3, 1, "policies", "Nobody else has come: you play with computer players. One moment, please…"),
        (
            3,
            2,
            "policies",
            "2 of 3 are here, you included: a computer player takes the empty place. One moment, please…",
        ),
        (
            4,
            2,
            "policies",
            "2 of 4 are here, you included: computer players take the empty places. One moment, please…",
        ),
        (3, 3, "policies", "Found: enough participants are here. One moment, please…"),
        (2, 1, "unmatched", "You are the first of 2"),
    ],
)
def test_where_too_few_are_there_the_page_does_not_say_that_others_are_found(
    together: World, tab: Any, players: int, here: int, then: str, said: str
) -> None:
    together.more = {"players": players}
    together.state = {**LOBBY, "players": players, "here": here, "then": then, "seconds": 300, "proposed": True}
    tab.goto(together.url)
    shows(tab, "#lobby-here", said)
    assert tab.inner_text("#lobby-here") == said
    assert tab.title().startswith("Found") is (here == players)
    assert tab.evaluate("document.documentElement.scrollWidth") <= tab.viewport_size["width"]
    assert tab.evaluate(FLAWS) == []


def test_the_lobby_asks_every_two_seconds_and_sooner_when_it_has_found_others(together: World, standing: Any) -> None:
    standing.goto(together.url)
    found = {"here": 2, "proposed": True}
    for seconds, after, answer in ((50, 2_000, {}), (60, 2_000, found), (70, 500, found), (80, 500, found)):
        before, together.state = len(together.polled), {**LOBBY, "seconds": seconds, **answer}
        standing.clock.run_for(after - 100)
        standing.wait_for_timeout(100)
        assert len(together.polled) == before
        standing.clock.run_for(200)
        shows(standing, "#lobby-clock", f"{seconds} seconds")
        assert len(together.polled) == before + 1


def test_a_slow_site_is_asked_less_often(together: World, tab: Any) -> None:
    tab.goto(together.url)
    together.slow = 3
    waited_for(together, 3)
    assert together.polled[-1] - together.polled[-2] > 7.5  # 3 s until it answers, as long a pause, and 2 s


def test_once_matched_the_game_is_prepared_and_played_without_a_reload(together: World, tab: Any) -> None:
    tab.goto(together.url)
    tab.evaluate("window.same = true")
    together.state = dict(MATCHED)
    tab.wait_for_selector("h1:visible:text('Your game is being prepared')")
    assert tab.is_hidden("#lobby")
    assert tab.inner_text("#company") == "You play with another participant."
    assert tab.inner_text("[aria-current=step]") == "Your request has been received"
    assert tab.title().startswith("Your game is being prepared \u2013 ")
    assert tab.evaluate(FLAWS) == []
    shot(tab, "360-prepared")
    together.ready()
    tab.wait_for_selector("#play:visible")
    assert tab.evaluate("window.same") is True
    assert tab.title() == "Ready \u2013 Demo \u00b7 step 3 of 4"
    tell(together, state="playing", **people(red="here"))
    tab.wait_for_selector("#overlay", state="hidden")
    assert tab.title() == "Demo \u00b7 step 3 of 4"
    assert together.posts == [], "who is matched does not leave the lobby"


@pytest.mark.parametrize(
    ("players", "members", "says"),
    [
        (2, 1, "You play with a computer player."),
        (4, 2, "You play with another participant and 2 computer players."),
        (4, 4, "You play with 3 other participants."),
    ],
)
def test_the_page_says_who_plays_when_it_is_opened_anew(
    together: World, tab: Any, players: int, members: int, says: str
) -> None:
    together.more = {"players": players}
    together.state = {**MATCHED, "players": players, "members": members}
    tab.goto(together.url)
    assert tab.inner_text("#company") == says


def test_the_page_is_made_anew_for_another_number_of_players_and_does_not_leave_the_lobby(
    together: World, tab: Any
) -> None:
    """The study was registered again. What a page says of the others, and its modules, are those of one number."""
    tab.goto(together.url)
    assert tab.inner_text("#lobby-here") == "You are the first of 2"
    together.more = {"players": 3}
    together.state = {**LOBBY, "players": 3, "here": 2}
    shows(tab, "#lobby-here", "2 of 3 are here, you included")
    assert "3 people play this game together." in tab.inner_text("#lobby")
    together.more = {"players": 4}
    together.state = {**MATCHED, "players": 4, "members": 4}
    shows(tab, "#company", "You play with 3 other participants.")
    assert together.posts == []


@pytest.mark.parametrize("state", ["unmatched", "ended"])
def test_who_could_not_be_matched_gets_the_next_page(together: World, tab: Any, state: str) -> None:
    tab.goto(together.url)
    together.step, together.source = 3, "<h1>Next page</h1>"
    together.state = {"state": state, "again": False, "reason": None}
    tab.wait_for_selector("h1:text('Next page')")


def test_a_page_that_is_closed_leaves_the_lobby_at_once(together: World, tab: Any) -> None:
    tab.goto(together.url)
    waited_for(together, 1)
    tab.goto("about:blank")
    left(together)
    assert together.posts == [{"hippodrome-step": "3", "hippodrome-ticket": "T", "hippodrome-action": "leave"}]


def left(world: World, times: int = 1) -> None:
    until = time.monotonic() + PATIENCE / 1000
    while len(world.posts) < times:
        assert time.monotonic() < until
        time.sleep(0.02)


def test_a_game_that_is_left_sends_no_beacon(together: World, tab: Any) -> None:
    together.state = dict(MATCHED)
    tab.goto(together.url)
    waited_for(together, 1)
    tab.goto("about:blank")
    tab.wait_for_timeout(500)
    assert together.posts == []


def test_a_clock_that_begins_anew_is_explained(together: World, tab: Any) -> None:
    tab.goto(together.url)
    together.state = {**LOBBY, "seconds": 2}
    shows(tab, "#announce", "You were away for a while, so your waiting time has begun again.")
    shows(tab, "#lobby-note", "You were away for a while, so your waiting time has begun again.")


def test_airplane_mode_in_the_lobby_is_told_and_ends_by_itself(together: World, lone_tab: Any) -> None:
    lone_tab.goto(together.url)
    lone_tab.context.set_offline(True)
    lone_tab.wait_for_selector("#wait-status:text('No connection'):visible")
    shot(lone_tab, "360-lobby-offline")
    lone_tab.context.set_offline(False)
    lone_tab.wait_for_selector("#wait-status:empty", state="attached")
    shows(lone_tab, "#lobby-here", "You are the first of 2")


def test_who_waits_in_the_lobby_of_a_study_that_is_closed_is_told_so(together: World, tab: Any) -> None:
    tab.goto(together.url)
    waited_for(together, 1)
    together.closed = True
    tab.wait_for_selector("text=There is no such study")


def test_without_javascript_the_lobby_says_so_and_asks_for_nothing(together: World, chromium: Any) -> None:
    page = chromium.new_context(java_script_enabled=False).new_page()
    page.goto(together.url)
    assert page.locator("h1:visible").all_inner_texts() == ["Waiting for another participant"]
    assert "The game needs JavaScript" in page.inner_text("noscript:visible")
    assert "http-equiv" not in page.content()
    page.context.close()


# In the game


def names(page: Any) -> list[str]:
    found: list[str] = page.eval_on_selector_all("#people b", "all => all.map((each) => each.textContent)")
    return found


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_game_of_two_from_the_first_connection_to_the_countdown(
    together: World, standing: Any, width: int, height: int
) -> None:
    tab = standing
    tab.set_viewport_size({"width": width, "height": height})
    together.controls |= people(red="awaited")
    together.ready()
    tab.goto(together.url)
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    assert tab.is_hidden("#overlay-button")
    assert tab.inner_text("#overlay-hint") == "The game begins as soon as everybody is here."
    assert names(tab) == ["You: Blue", "Red (not here yet)"]
    shot(tab, f"{width}-gathering")
    tab.keyboard.press("ArrowLeft")
    together.wait_for({"action": "left", "held": False})
    assert together.given() == [], "nobody presses start"
    tell(together, state="ready", beginsIn=3, **people(red="here"))
    shows(tab, "#overlay-score", "3")
    assert tab.inner_text("#overlay-title") == "The game begins"
    assert names(tab) == ["You: Blue", "Red"]
    shot(tab, f"{width}-begins")
    tab.clock.run_for(1_000)
    assert tab.inner_text("#overlay-score") == "2"
    tell(together, state="playing", **people(red="here"))
    tab.wait_for_selector("#overlay", state="hidden")
    assert tab.evaluate("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]") == [
        width,
        height,
    ]
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-together")
    box = tab.locator("#screen").bounding_box()
    assert min(box["width"], box["height"]) >= 200


@pytest.mark.parametrize(("width", "height"), [(360, 640), (320, 568), (740, 360), (1280, 800)])
@pytest.mark.parametrize(
    ("after", "next"),
    [("end", "the game ends for everybody"), ("policy", "a computer player takes their place")],
)
def test_a_game_that_is_held_says_for_whom_for_how_long_and_what_follows(
    together: World, standing: Any, width: int, height: int, after: str, next: str
) -> None:
    tab = standing
    tab.set_viewport_size({"width": width, "height": height})
    together.trial = {"afterAbsent": after}
    running(together, tab)
    tell(together, state="paused", heldFor=23, **people(red="away"))
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    assert tab.inner_text("#overlay-hint") == f"If they are not here in 23 seconds, {next}."
    assert tab.is_hidden("#overlay-button")
    assert names(tab) == ["You: Blue", "Red (away)"]
    fits(tab)
    shot(tab, f"{width}-held")
    tab.clock.run_for(1_000)
    assert tab.inner_text("#overlay-hint") == f"If they are not here in 22 seconds, {next}."
    tell(together, state="playing", **people(red="here"))
    tab.wait_for_selector("#overlay", state="hidden")
    shows(tab, "#trouble", "The other participant is back.")


def running(world: World, page: Any) -> None:
    world.ready()
    page.goto(world.url)
    page.wait_for_selector("#play:visible")
    until = time.monotonic() + PATIENCE / 1000
    while not world.connections:
        assert time.monotonic() < until
        time.sleep(0.02)
    page.wait_for_selector("#people b")
    tell(world, state="playing", **people(red="here"))
    page.wait_for_selector("#overlay", state="hidden")


def test_a_computer_player_in_a_place_is_told_and_stays_named(together: World, tab: Any) -> None:
    running(together, tab)
    tell(together, state="playing", **people(red="policy"))
    shows(tab, "#trouble", "A computer player has taken the place of the other participant.")
    assert names(tab) == ["You: Blue", "Red (computer)"]
    shot(tab, "360-policy")
    tell(together, state="playing", **people(red="here"))
    shows(tab, "#trouble", "The other participant is back.")


def test_turn_by_turn_the_page_says_whose_turn_it_is(together: World, tab: Any) -> None:
    together.trial = {"pace": "turns"}
    together.controls |= {"pace": "turns", "toAct": False, "players": ["blue", "red", "green"]}
    running(together, tab)
    there = people(red="here", green="here")
    tell(together, state="playing", toAct=False, turnOf=["green"], **there)
    tab.wait_for_selector("#turn:text-is('Green: their turn')")
    tell(together, state="playing", toAct=True, turnOf=["blue"], **there)
    tab.wait_for_selector("#turn:text-is('Your turn')")


def test_the_button_that_ends_the_game_says_that_it_ends_for_everybody(together: World, tab: Any) -> None:
    together.controls |= {"UI": ["start", "stop"]}
    running(together, tab)
    tell(together, state="playing", **people(red="here"))
    tab.wait_for_selector("[data-command=stop]:text-is('End the game for everybody')", state="attached")


def test_of_many_players_the_page_says_how_many_are_there(together: World, tab: Any) -> None:
    together.more, together.state = {"players": 16}, {**together.state, "players": 16}
    running(together, tab)
    there = {f"player_{number}": "here" for number in range(16)}
    tell(together, state="paused", heldFor=5, you="player_3", people={**there, "player_5": "away", "player_9": "away"})
    shows(tab, "#people", "14 of 16 are here")
    assert names(tab)[0] == "You: Player 3"
    shows(tab, "#overlay-title", "Waiting for Player 5, Player 9")
    assert tab.evaluate("document.documentElement.scrollWidth") <= 360
    shot(tab, "360-held-16")


@pytest.mark.parametrize(("width", "height"), [(360, 640), (640, 360), (1280, 800)])
def test_whoever_was_away_is_told_so_and_not_that_the_others_are_missing(
    together: World, standing: Any, width: int, height: int
) -> None:
    tab = standing
    tab.set_viewport_size({"width": width, "height": height})
    running(together, tab)
    held = {"state": "paused", "episode": 1, "heldFor": 8, "you": "blue"}
    together.stands = {**held, "people": {"blue": "away", "red": "here"}}
    together.connections[0].send(json.dumps(together.stands))
    tab.wait_for_selector("#overlay-title:text('You were away for a moment')")
    assert tab.inner_text("#overlay-hint") == "The game goes on as soon as everybody is here."
    fits(tab)
    shot(tab, f"{width}-was-away")
    together.stands = {**held, "people": {"blue": "here", "red": "away"}}
    together.connections[0].send(json.dumps(together.stands))
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    shows(tab, "#overlay-hint", "If they are not here in 8 seconds")


def test_whoever_is_still_measured_is_not_told_that_they_were_away(together: World, tab: Any) -> None:
    running(together, tab)
    together.stands = {"state": "ready", "heldFor": 8, "you": "blue", "people": {"blue": "awaited", "red": "here"}}
    together.connections[0].send(json.dumps(together.stands))
    tab.wait_for_selector("#overlay-title:text-is('Waiting for the other participant')")
    assert tab.inner_text("#overlay-hint") == "The game begins as soon as everybody is here."
    assert tab.get_attribute("#people b:first-child", "class") == "awaited"
    tell(together, state="playing", **people(red="here"))
    tab.wait_for_selector("#people b.here:first-child")


@pytest.mark.parametrize(("width", "height"), [*SIZES, (640, 360)])
def test_what_stands_on_a_low_picture_is_seen_whole(together: World, tab: Any, width: int, height: int) -> None:
    hold_timers(tab, MESSAGE)
    tab.set_viewport_size({"width": width, "height": height})
    low = {"width": 600, "height": 60}
    together.trial, together.spoken = {"scene": low}, "hippodrome.3"
    together.controls |= {"scene": low, "assets": []}
    running(together, tab)
    drawn = json.dumps({"new": True, "set": {}, "hud": "nothing yet"})
    together.connections[0].send(struct.pack("!BI", 4, 3) + drawn.encode())
    tab.wait_for_function("() => document.getElementById('screen').getBoundingClientRect().height < 80")
    tell(together, state="paused", heldFor=8, **people(red="away"))
    shows(tab, "#overlay-hint", "If they are not here in")
    assert tab.evaluate(SEEN_WHOLE, "overlay")
    shot(tab, f"{width}-low-picture")
    tell(together, state="playing", **people(red="here"))
    shows(tab, "#trouble", "The other participant is back.")
    assert tab.evaluate(SEEN_WHOLE, "trouble")


MESSAGE = 8_000  # ms for which the page shows one, as web/game/overlay.js has it
SEEN_WHOLE = """id => {
    const found = document.getElementById(id), box = found.getBoundingClientRect(), x = (box.left + box.right) / 2;
    found.style.pointerEvents = "auto";
    const seen = (y) => found.contains(document.elementFromPoint(x, y));
    return found.scrollHeight <= found.clientHeight && seen(box.top + 2) && seen(box.bottom - 2);
}"""


def test_players_have_the_names_that_the_researcher_gives_them(together: World, tab: Any) -> None:
    together.trial = {"afterAbsent": "end", "playerNames": {"blue": "The left slime"}}
    running(together, tab)
    assert names(tab) == ["You: The left slime", "Red"]


def with_an_image(together: World, tab: Any, size: int, stands: dict[str, Any]) -> None:
    """A game drawn by objects, whose one image has so many bytes and has not come yet."""
    together.spoken = "hippodrome.3"
    together.trial = {"scene": WIDE}
    image = {"name": "cat", "bytes": size, "hash": "0" * 32}
    together.controls |= {"scene": WIDE, "assets": [image], **stands}
    together.ready()
    tab.goto(together.url)


def test_while_it_counts_down_the_page_says_so_and_not_that_pictures_come(together: World, tab: Any) -> None:
    with_an_image(together, tab, 80_000, {"beginsIn": 30, **people(red="here")})
    tab.wait_for_selector("#overlay-title:text-is('The game begins')")
    together.connections[0].send(struct.pack("!BHI", 6, 0, 0) + bytes(4_000))
    tab.wait_for_function("() => document.querySelector('#overlay progress').value > 0")
    assert tab.inner_text("#overlay-title") == "The game begins"
    assert tab.inner_text("#overlay-score").isdecimal()


def test_where_nobody_has_to_press_start_nothing_offers_it(together: World, tab: Any) -> None:
    together.controls |= {"UI": ["left", "right", "start"]}
    together.controls |= people(red="awaited")
    together.ready()
    tab.goto(together.url)
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    assert tab.is_hidden("[data-command=toggle]")
    assert "start" not in tab.inner_text("#legend").lower()


def test_where_a_pause_is_offered_it_is_offered_in_the_game_alone(together: World, tab: Any) -> None:
    together.controls |= people(red="awaited")
    together.ready()
    tab.goto(together.url)
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    assert tab.is_hidden("[data-command=toggle]")
    assert "pause and go on" in tab.inner_text("#legend")
    tell(together, state="playing", **people(red="here"))
    tab.wait_for_selector("[data-command=toggle]:text-is('Pause')")


def test_players_that_are_numbers_are_named_as_players(together: World, tab: Any) -> None:
    together.controls = {"player": "0", "players": ["0", "1"], "you": "0", "people": {"0": "here", "1": "here"}}
    running(together, tab)
    tell(together, state="playing", you="0", people={"0": "here", "1": "policy"})
    tab.wait_for_function("() => document.getElementById('people').textContent.includes('computer')")
    assert names(tab) == ["You: Player 0", "Player 1 (computer)"]


def test_whoever_else_goes_away_meanwhile_is_named_too(together: World, tab: Any) -> None:
    together.more, together.state = {"players": 3}, {**together.state, "players": 3}
    running(together, tab)
    tell(together, state="paused", heldFor=9, **people(red="away", green="here"))
    shows(tab, "#overlay-title", "Waiting for Red")
    tell(together, state="paused", heldFor=8, **people(red="away", green="away"))
    shows(tab, "#overlay-title", "Waiting for Red, Green")
    tell(together, state="paused", heldFor=7, **people(red="here", green="away"))
    tab.wait_for_selector("#overlay-title:text-is('Waiting for Green')")


def test_being_offline_oneself_is_another_thing_than_the_absence_of_the_other(together: World, tab: Any) -> None:
    running(together, tab)
    tell(together, state="paused", heldFor=9, **people(red="away"))
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    together.state["url"] = "ws://127.0.0.1:9/"
    together.connections[0].socket.close()
    together.connections[0].close()
    tab.wait_for_selector("#overlay-title:text('Connection lost')")
    tab.wait_for_timeout(600)  # a countdown that goes on would show by now
    assert "The other participant can see that you are away" in tab.inner_text("#overlay-hint")
    shot(tab, "360-offline")
    together.ready()
    tab.wait_for_selector("#overlay-title:text('Ready?')")


@pytest.mark.parametrize(("width", "height"), [(360, 640), (1280, 800)])
@pytest.mark.parametrize(
    ("outcome", "reason", "says"),
    [
        ("partnerLeft", "", "The other participant is not there any more, so the game has ended."),
        ("left", "", "You were away for too long"),
        ("ping", "", "Your connection to the game is too slow"),
        ("partnerLeft", PARTNER_MISSING, PARTNER_MISSING),
        ("ping", PING, PING),
    ],
)
def test_an_early_end_has_a_fair_page_that_stays_until_the_participant_goes_on(
    together: World, tab: Any, width: int, height: int, outcome: str, reason: str, says: str
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    running(together, tab)
    together.step, together.source = 3, "<h1>Next page</h1>"
    together.connections[0].send(json.dumps({"error": "That move is not possible now"}))
    tell(together, state="playing", **people(red="here"))
    if reason:
        together.connections[0].send(json.dumps({"error": reason}))
    tell(together, state="ended", **people(red="away"))
    played = outcome != "ping"
    together.connections[0].send(json.dumps({"done": True, "outcome": outcome, "score": 7, "episodes": int(played)}))
    tab.wait_for_selector("#overlay-title:text('The game has ended')")
    hint = tab.inner_text("#overlay-hint")
    assert says in hint
    assert "not possible" not in hint
    assert tab.inner_text("#overlay-score") == ("Your score: 7" if played else "")
    shows(tab, "#announce", says)
    fits(tab)
    shot(tab, f"{width}-{outcome}")
    tab.wait_for_timeout(4_500)  # other ends go on by themselves after four seconds
    assert tab.is_visible("#overlay-button")
    tab.click("#overlay-button")
    tab.wait_for_selector("h1:text('Next page')")


WIDE = {"width": 960, "height": 500, "coordinates": "pixels"}


@pytest.mark.parametrize(("width", "height"), [(360, 640), (320, 568), (640, 360), (568, 320)])
def test_above_a_low_picture_everything_is_said_whole_too(
    together: World, chromium: Any, width: int, height: int
) -> None:
    context = chromium.new_context(viewport={"width": width, "height": height}, has_touch=True, is_mobile=True)
    page = context.new_page()
    ui = ["up", "down", "left", "right", "start"]
    together.trial = {"scene": WIDE, "ui": dict.fromkeys(ui, True)}
    together.spoken = "hippodrome.3"
    together.controls |= {"UI": ui, "actionSpace": ["noop", *ui[:4]], "scene": WIDE, "assets": []}
    running(together, page)
    drawn = json.dumps({"new": True, "set": {}, "hud": "0 of 8 acorns, 36 turns left"})
    together.connections[0].send(struct.pack("!BI", 4, 3) + drawn.encode())
    page.wait_for_selector("#scene-hud:visible")
    tell(together, state="paused", heldFor=23, **people(red="away"))
    page.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    fits(page)
    overflow = (
        "[document.documentElement.scrollWidth - innerWidth, document.documentElement.scrollHeight - innerHeight]"
    )
    assert page.evaluate(overflow) == [0, 0]
    for each in page.locator(".hud > :visible, #people b").all():
        box = each.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width
    shot(page, f"{width}-low-held")
    together.connections[0].send(json.dumps({"done": True, "outcome": "partnerLeft", "score": 7, "episodes": 1}))
    page.wait_for_selector("#overlay-title:text('The game has ended')")
    fits(page)
    top = "() => document.elementFromPoint(innerWidth - 40, innerHeight - 40).id"
    assert page.evaluate(top) == "overlay", "no button shows through"
    assert page.evaluate(FLAWS) == []
    shot(page, f"{width}-low-end")
    context.close()


def test_a_game_that_is_finished_ends_as_any_other(together: World, tab: Any) -> None:
    hold_timers(tab, LAST_PICTURE)
    running(together, tab)
    together.connections[0].send(json.dumps({"done": True, "outcome": "finished", "score": 7, "episodes": 1}))
    tab.wait_for_selector("#overlay-title:text('The game is over')")
    assert tab.inner_text("#overlay-hint") == ""


# Pages to read


def test_the_game_is_told_when_the_instructions_are_read(together: World, standing: Any) -> None:
    tab = standing
    together.texts = {"instructions": "<h2>How to play</h2>"}
    together.trial = {"instructions": "how"}
    together.controls |= {"you": "blue", "people": {"blue": "reads", "red": "reads"}}
    together.ready()
    tab.goto(together.url)
    tab.wait_for_selector("h2:text('How to play'):visible")
    assert together.given() == []
    tell(together, state="ready", heldFor=20, you="blue", people={"blue": "reads", "red": "here"})
    shows(tab, "#reading", "The other participant waits for you. Please go on within 20 seconds.")
    assert tab.is_visible("h2:text('How to play')")
    shot(tab, "360-reading")
    together.started = {"state": "ready", "episode": 1, "heldFor": 18, **people(red="reads")}
    tab.click("#reading-button")
    together.wait_for({"command": "start"})
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant'):visible")
    assert names(tab) == ["You: Blue", "Red (reading)"]
    assert "They have not gone on yet. The game begins in 18 seconds at the latest." in tab.inner_text("#overlay-hint")


def test_instructions_that_were_read_before_a_reload_are_not_shown_again(together: World, standing: Any) -> None:
    test_the_game_is_told_when_the_instructions_are_read(together, standing)
    together.heard.clear()
    standing.reload()
    together.wait_for({"command": "start"})


def test_between_two_games_the_page_says_whom_it_waits_for(together: World, tab: Any) -> None:
    together.texts = {"betweenEpisodes": "<h2>How was it?</h2>"}
    together.trial = {"betweenEpisodes": "how"}
    running(together, tab)
    tell(together, state="break", you="blue", people={"blue": "reads", "red": "reads"})
    tab.wait_for_selector("h2:text('How was it?'):visible")
    together.started = {"state": "break", "episode": 1, "heldFor": 20, **people(red="reads")}
    tab.click("#reading-button")
    together.wait_for({"command": "start"})
    shows(tab, "#reading", "Waiting for the other participant…")
    assert tab.is_visible("h2:text('How was it?')")
    tell(together, state="playing", episode=2, **people(red="here"))
    tab.wait_for_selector("#screen:visible")


# A phone that sleeps, a hidden tab


@contextlib.contextmanager
def asleep(page: Any) -> Iterator[None]:
    """Its script stands still, as on a phone whose screen is locked. (Chromium without window cannot freeze a page.)"""
    devtools = page.context.new_cdp_session(page)
    devtools.send("Debugger.enable")
    devtools.send("Debugger.pause")
    time.sleep(0.5)
    yield
    devtools.send("Debugger.resume")
    devtools.send("Debugger.disable")


def test_a_phone_that_sleeps_in_the_lobby_asks_again_when_it_wakes(together: World, tab: Any) -> None:
    tab.goto(together.url)
    waited_for(together, 1)
    with asleep(tab):
        before = len(together.polled)
        time.sleep(4.5)
        assert len(together.polled) <= before + 1, "so its participant is taken for gone, and is not matched"
        together.state = {**LOBBY, "seconds": 1}
    shows(tab, "#lobby-note", "You were away for a while")
    waited_for(together, 2)


def test_a_phone_that_sleeps_in_the_game_finds_what_has_become_of_it(together: World, tab: Any) -> None:
    running(together, tab)
    together.controls |= {"state": "paused", "beginsIn": 9}  # if the page connects anew
    with asleep(tab):
        tell(together, state="paused", heldFor=4, **people(red="away"))
        tell(together, state="paused", beginsIn=9, **people(red="here"))
    tab.wait_for_selector("#overlay-title:text('The game goes on')")
    assert names(tab) == ["You: Blue", "Red"]


def test_a_page_that_learns_that_it_was_away_says_that_it_is_there(together: World, tab: Any) -> None:
    running(together, tab)
    note_texts(tab, "#overlay-score")
    together.stands = {"state": "paused", "episode": 1, "beginsIn": 3, **people(red="here")}
    away = {"state": "paused", "episode": 1, "heldFor": 8, "you": "blue", "people": {"blue": "away", "red": "here"}}
    together.connections[0].send(json.dumps(away))
    together.wait_for({"command": "requestUI"})
    noted(tab, "#overlay-score", "3")


def test_a_page_that_comes_back_from_the_browsers_cache_is_back_in_the_lobby(together: World, chromium: Any) -> None:
    browser = chromium.browser_type.launch(
        executable_path=chromium_path(), args=list(ARGUMENTS), ignore_default_args=["--disable-back-forward-cache"]
    )
    page = browser.new_page()
    page.goto(together.url)
    page.evaluate("window.same = true")
    waited_for(together, 1)
    with html_page("<p>elsewhere</p>") as elsewhere:
        page.goto(elsewhere)
        left(together)
        gone = len(together.polled)
        page.wait_for_timeout(4_000)
        assert len(together.polled) <= gone + 1
        page.go_back(wait_until="commit")
    waited_for(together, 2)
    assert page.evaluate("window.same") is True, "it came from the cache"
    page.goto("about:blank")
    left(together, 2)
    browser.close()
    assert [post["hippodrome-action"] for post in together.posts] == ["leave", "leave"]


def test_the_title_of_a_hidden_tab_changes_once_its_participant_is_matched(together: World, tab: Any) -> None:
    tab.add_init_script("Object.defineProperty(document, 'hidden', { get: () => window.unseen ?? false })")
    tab.goto(together.url)
    assert tab.title().startswith("1 of 2 \u2013 ")
    tab.evaluate("window.unseen = true")
    together.state = dict(MATCHED)
    tab.wait_for_function("() => document.title.startsWith('● Your game is being prepared \u2013 ')")
    tab.wait_for_function("() => document.title.startsWith('Your game')")
    tab.evaluate("window.unseen = false")
    tab.wait_for_function("() => document.title.startsWith('Your game')")
    tab.wait_for_timeout(1_500)
    assert tab.title().startswith("Your game is being prepared \u2013 ")


def test_a_second_tab_takes_the_game_and_the_first_one_says_so(together: World, tab: Any) -> None:
    running(together, tab)
    together.connections[0].close(4409, "opened elsewhere")
    tab.wait_for_selector("text=Play here instead")
    assert names(tab) == ["You: Blue", "Red"]
    assert tab.inner_text("#overlay-hint") == "If you have closed it there, go on here."
    fits(tab)
    shot(tab, "360-elsewhere")


def test_when_the_pictures_have_come_the_page_says_again_what_the_game_waits_for(together: World, tab: Any) -> None:
    with_an_image(together, tab, 8, {"heldFor": 20, **people(red="awaited")})
    tab.wait_for_selector("#overlay-title:text('Loading the pictures')")
    together.connections[0].send(struct.pack("!BHI", 6, 0, 0) + struct.pack("!I", 2) + b"{}" + b"no")
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    assert tab.is_hidden("#overlay-button")


def test_what_comes_right_behind_the_first_message_is_shown(together: World, tab: Any) -> None:
    """As a server sends it: the controls, and at once where the trial stands."""

    def speak(connection: Any) -> None:
        together.connections.append(connection)
        for text in connection:
            if "token" in json.loads(text):
                said = {"UI": ["left"], "actionSpace": ["noop", "left"], "state": "ready", "episode": 1, "score": 0}
                connection.send(json.dumps({**said, **people(red="here")}))
                connection.send(json.dumps({"state": "ready", "episode": 1, "beginsIn": 30, **people(red="here")}))

    together.play = speak  # type: ignore[method-assign]
    together.trial = {"episodeSeconds": 60}
    tab.goto(together.url)
    note_texts(tab, "#overlay-score")
    together.state = dict(MATCHED)
    together.ready()
    tab.wait_for_selector("#overlay-title:text('The game begins')")
    noted(tab, "#overlay-score", "30")
