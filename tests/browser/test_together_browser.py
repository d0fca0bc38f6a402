"""The page of a game of several participants: the lobby, and who is present in the game."""

from __future__ import annotations

import contextlib
import json
import struct
import time
from collections.abc import Iterator
from typing import Any

import pytest

from hippodrome.trial.core.session import PARTNER_MISSING, PING
from testing.browser import ARGUMENTS, chromium_path, html_page
from testing.waiting import until
from tests.browser.conftest import hold_timers, note_texts, wait_for_noted
from tests.browser.world import FLAWS, LAST_PICTURE, PATIENCE, World, shot, tell

pytestmark = pytest.mark.browser
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
def group(world: World) -> World:
    world.more = {"players": 2}
    world.trial = {"afterAbsent": "end"}
    world.step = 2
    world.state = dict(LOBBY)
    world.controls = {"player": "blue", "players": ["blue", "red"], **presence(red="here")}
    return world


def presence(**others: str) -> dict[str, Any]:
    """Return the fields `you` and `people` of a message to the blue player."""
    return {"you": "blue", "people": {"blue": "here", **others}}


def wait_for_text(page: Any, selector: str, text: str) -> None:
    page.wait_for_function(
        "([selector, text]) => document.querySelector(selector).textContent.includes(text)", arg=[selector, text]
    )


def check_overlay_fits(page: Any) -> None:
    """Check that the overlay is no higher than the picture (or the window), and shows all of its words."""
    assert page.evaluate(
        """() => {
            const each = document.getElementById("overlay"), covers = getComputedStyle(each).position === "fixed";
            const most = covers ? innerHeight : each.parentElement.getBoundingClientRect().height;
            return each.scrollHeight <= each.clientHeight && each.getBoundingClientRect().height <= most + .5;
        }"""
    )


def wait_for_polls(world: World, polls: int) -> None:
    """Wait until the page has asked for the state so many times more."""
    wanted = len(world.polls) + polls
    until(lambda: len(world.polls) >= wanted, PATIENCE / 1000)


# The lobby


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_lobby_says_how_many_wait_for_how_long_and_what_happens_then(
    group: World, tab: Any, width: int, height: int
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    tab.goto(group.url)
    assert tab.locator("h1:visible").all_inner_texts() == ["Waiting for another participant"]
    assert tab.inner_text("#lobby-here") == "You are the first of 2 people"
    wait_for_text(tab, "#lobby-clock", "Waiting time: 4")
    wait_for_text(tab, "#lobby-then", "If nobody else joins within 4 min ")
    assert tab.inner_text("#lobby-then").endswith("you will continue without this game.")
    assert tab.locator(".stages:visible, .clock:visible").count() == 1
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-lobby")
    group.state = {**LOBBY, "here": 2, "seconds": 44, "proposed": True}
    wait_for_text(tab, "#lobby-here", "Another participant is here. Just a moment…")
    assert tab.inner_text("#lobby-then") == ""
    assert tab.title().startswith("Match found \u2013 ")
    shot(tab, f"{width}-lobby-found")


def test_a_lobby_for_many_players_counts_the_participants(group: World, tab: Any) -> None:
    group.more = {"players": 16}
    group.state = {**LOBBY, "players": 16, "here": 11, "then": "policies"}
    tab.goto(group.url)
    assert tab.inner_text("h1:visible") == "Waiting for other participants"
    assert tab.inner_text("#lobby-here") == "11 of 16 people are here, including you"
    assert tab.locator("#lobby-places i").count() == 16
    assert tab.locator("#lobby-places .taken").count() == 11
    assert "computer players will fill the empty places" in tab.inner_text("#lobby-then")
    assert tab.evaluate("document.documentElement.scrollWidth") <= 360
    shot(tab, "360-lobby-16")
    group.state = {**group.state, "here": 23}
    wait_for_text(tab, "#lobby-here", "16 of 16")


def test_a_change_in_the_lobby_is_announced_once(group: World, tab: Any) -> None:
    group.more, group.state = {"players": 3}, {**LOBBY, "players": 3}
    tab.goto(group.url)
    tab.evaluate(
        """() => {
            window.said = [];
            new MutationObserver(() => window.said.push(document.getElementById("announce").textContent))
                .observe(document.getElementById("announce"), { childList: true, characterData: true, subtree: true });
        }"""
    )
    wait_for_polls(group, 2)
    assert tab.evaluate("window.said") == []
    group.state = {**group.state, "here": 2}
    wait_for_text(tab, "#lobby-here", "2 of 3 people are here")
    assert tab.evaluate("window.said") == ["2 of 3 people are here, including you"]


def test_when_the_patience_is_over_the_page_says_what_happens(group: World, tab: Any) -> None:
    group.state = {**LOBBY, "seconds": 297, "then": "policies"}
    tab.goto(group.url)
    wait_for_text(
        tab, "#lobby-then", "If nobody else joins within 3 seconds, you will play with a computer player instead."
    )
    group.state = {**group.state, "seconds": 300}
    wait_for_text(
        tab, "#lobby-then", "Nobody else joined, so you will play with a computer player instead. Just a moment…"
    )


@pytest.mark.parametrize(
    ("players", "here", "then", "said"),
    [
        (2, 1, "policies", "Nobody else joined, so you will play with a computer player. Just a moment…"),
        (3, 1, "policies", "Nobody else joined, so you will play with computer players. Just a moment…"),
        (
            3,
            2,
            "policies",
            "2 of 3 people are here, including you. A computer player will fill the empty place. Just a moment…",
        ),
        (
            4,
            2,
            "policies",
            "2 of 4 people are here, including you. Computer players will fill the empty places. Just a moment…",
        ),
        (3, 3, "policies", "Enough participants are here. Just a moment…"),
        (2, 1, "unmatched", "You are the first of 2 people"),
    ],
)
def test_with_too_few_participants_the_page_does_not_say_that_others_are_found(
    group: World, tab: Any, players: int, here: int, then: str, said: str
) -> None:
    group.more = {"players": players}
    group.state = {**LOBBY, "players": players, "here": here, "then": then, "seconds": 300, "proposed": True}
    tab.goto(group.url)
    wait_for_text(tab, "#lobby-here", said)
    assert tab.inner_text("#lobby-here") == said
    assert tab.title().startswith("Match found") is (here == players)
    assert tab.evaluate("document.documentElement.scrollWidth") <= tab.viewport_size["width"]
    assert tab.evaluate(FLAWS) == []


def test_the_lobby_asks_every_two_seconds_and_sooner_when_it_has_found_others(
    group: World, stopped_clock_tab: Any
) -> None:
    stopped_clock_tab.goto(group.url)
    found = {"here": 2, "proposed": True}
    for seconds, after, answer in ((50, 2_000, {}), (60, 2_000, found), (70, 500, found), (80, 500, found)):
        before, group.state = len(group.polls), {**LOBBY, "seconds": seconds, **answer}
        stopped_clock_tab.clock.run_for(after - 100)
        stopped_clock_tab.wait_for_timeout(100)
        assert len(group.polls) == before
        stopped_clock_tab.clock.run_for(200)
        wait_for_text(stopped_clock_tab, "#lobby-clock", f"{seconds} seconds")
        assert len(group.polls) == before + 1


def test_a_slow_site_is_asked_less_often(group: World, tab: Any) -> None:
    tab.goto(group.url)
    group.slow = 3
    wait_for_polls(group, 3)
    assert group.polls[-1] - group.polls[-2] > 7.5  # 3 s until it answers, as long a pause, and 2 s


def test_after_the_match_the_game_is_prepared_and_played_without_a_reload(group: World, tab: Any) -> None:
    tab.goto(group.url)
    tab.evaluate("window.same = true")
    group.state = dict(MATCHED)
    tab.wait_for_selector("h1:visible:text('Your game is being prepared')")
    assert tab.is_hidden("#lobby")
    assert tab.inner_text("#company") == "You will play with another participant."
    assert tab.inner_text("[aria-current=step]") == "Request received"
    assert tab.title().startswith("Your game is being prepared \u2013 ")
    assert tab.evaluate(FLAWS) == []
    shot(tab, "360-prepared")
    group.ready()
    tab.wait_for_selector("#play:visible")
    assert tab.evaluate("window.same") is True
    assert tab.title() == "Ready \u2013 Demo \u00b7 step 3 of 4"
    tell(group, state="playing", **presence(red="here"))
    tab.wait_for_selector("#overlay", state="hidden")
    assert tab.title() == "Demo \u00b7 step 3 of 4"
    assert group.posts == [], "who is matched does not leave the lobby"


@pytest.mark.parametrize(
    ("players", "members", "says"),
    [
        (2, 1, "You will play with a computer player."),
        (4, 2, "You will play with another participant and 2 computer players."),
        (4, 4, "You will play with 3 other participants."),
    ],
)
def test_a_page_that_is_opened_again_says_who_plays(
    group: World, tab: Any, players: int, members: int, says: str
) -> None:
    group.more = {"players": players}
    group.state = {**MATCHED, "players": players, "members": members}
    tab.goto(group.url)
    assert tab.inner_text("#company") == says


def test_the_page_reloads_for_another_number_of_players_without_leaving_the_lobby(group: World, tab: Any) -> None:
    """The study was registered again: the page's sentences and modules depend on the number of players."""
    tab.goto(group.url)
    assert tab.inner_text("#lobby-here") == "You are the first of 2 people"
    group.more = {"players": 3}
    group.state = {**LOBBY, "players": 3, "here": 2}
    wait_for_text(tab, "#lobby-here", "2 of 3 people are here, including you")
    assert "This is a game for 3 people." in tab.inner_text("#lobby")
    group.more = {"players": 4}
    group.state = {**MATCHED, "players": 4, "members": 4}
    wait_for_text(tab, "#company", "You will play with 3 other participants.")
    assert group.posts == []


@pytest.mark.parametrize("state", ["unmatched", "ended"])
def test_a_participant_without_a_match_gets_the_next_page(group: World, tab: Any, state: str) -> None:
    tab.goto(group.url)
    group.step, group.source = 3, "<h1>Next page</h1>"
    group.state = {"state": state, "again": False, "reason": None}
    tab.wait_for_selector("h1:text('Next page')")


def test_a_page_that_is_closed_leaves_the_lobby_at_once(group: World, tab: Any) -> None:
    tab.goto(group.url)
    wait_for_polls(group, 1)
    tab.goto("about:blank")
    wait_for_posts(group)
    assert group.posts == [{"hippodrome-step": "3", "hippodrome-ticket": "T", "hippodrome-action": "leave"}]


def wait_for_posts(world: World, times: int = 1) -> None:
    until(lambda: len(world.posts) >= times, PATIENCE / 1000)


def test_closing_the_page_of_a_game_sends_no_form(group: World, tab: Any) -> None:
    group.state = dict(MATCHED)
    tab.goto(group.url)
    wait_for_polls(group, 1)
    tab.goto("about:blank")
    tab.wait_for_timeout(500)
    assert group.posts == []


def test_the_lobby_explains_why_the_waiting_time_begins_again(group: World, tab: Any) -> None:
    tab.goto(group.url)
    group.state = {**LOBBY, "seconds": 2}
    wait_for_text(tab, "#announce", "You were away for a while, so your waiting time has restarted.")
    wait_for_text(tab, "#lobby-note", "You were away for a while, so your waiting time has restarted.")


def test_the_lobby_says_that_there_is_no_connection_and_goes_on_when_it_is_back(group: World, lone_tab: Any) -> None:
    lone_tab.goto(group.url)
    lone_tab.context.set_offline(True)
    lone_tab.wait_for_selector("#wait-status:text('No connection'):visible")
    shot(lone_tab, "360-lobby-offline")
    lone_tab.context.set_offline(False)
    lone_tab.wait_for_selector("#wait-status:empty", state="attached")
    wait_for_text(lone_tab, "#lobby-here", "You are the first of 2 people")


def test_the_lobby_says_that_the_study_was_closed(group: World, tab: Any) -> None:
    tab.goto(group.url)
    wait_for_polls(group, 1)
    group.closed = True
    tab.wait_for_selector("text=Study not found")


def test_without_javascript_the_lobby_says_that_the_game_needs_it_and_does_not_reload(
    group: World, chromium: Any
) -> None:
    page = chromium.new_context(java_script_enabled=False).new_page()
    page.goto(group.url)
    assert page.locator("h1:visible").all_inner_texts() == ["Waiting for another participant"]
    assert "The game needs JavaScript" in page.inner_text("noscript:visible")
    assert "http-equiv" not in page.content()
    page.context.close()


# In the game


def players_shown(page: Any) -> list[str]:
    found: list[str] = page.eval_on_selector_all("#people b", "all => all.map((each) => each.textContent)")
    return found


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_game_of_two_shows_who_is_missing_then_a_countdown_then_the_game(
    group: World, stopped_clock_tab: Any, width: int, height: int
) -> None:
    tab = stopped_clock_tab
    tab.set_viewport_size({"width": width, "height": height})
    group.controls |= presence(red="awaited")
    group.ready()
    tab.goto(group.url)
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    assert tab.is_hidden("#overlay-button")
    assert tab.inner_text("#overlay-hint") == "The game will start as soon as everyone is here."
    assert players_shown(tab) == ["You: Blue", "Red (not here yet)"]
    shot(tab, f"{width}-gathering")
    tab.keyboard.press("ArrowLeft")
    group.wait_for({"action": "left", "held": False})
    assert group.player_commands() == [], "nobody presses start"
    tell(group, state="ready", beginsIn=3, **presence(red="here"))
    wait_for_text(tab, "#overlay-score", "3")
    assert tab.inner_text("#overlay-title") == "The game is starting"
    assert players_shown(tab) == ["You: Blue", "Red"]
    shot(tab, f"{width}-begins")
    tab.clock.run_for(1_000)
    assert tab.inner_text("#overlay-score") == "2"
    tell(group, state="playing", **presence(red="here"))
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
    [("end", "the game will end for everyone"), ("policy", "a computer player will take their place")],
)
def test_a_held_game_says_for_whom_it_waits_how_long_and_what_follows(
    group: World, stopped_clock_tab: Any, width: int, height: int, after: str, next: str
) -> None:
    tab = stopped_clock_tab
    tab.set_viewport_size({"width": width, "height": height})
    group.trial = {"afterAbsent": after}
    start_game(group, tab)
    tell(group, state="paused", heldFor=23, **presence(red="away"))
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    assert tab.inner_text("#overlay-hint") == f"If they are not here within 23 seconds, {next}."
    assert tab.is_hidden("#overlay-button")
    assert players_shown(tab) == ["You: Blue", "Red (away)"]
    check_overlay_fits(tab)
    shot(tab, f"{width}-held")
    tab.clock.run_for(1_000)
    assert tab.inner_text("#overlay-hint") == f"If they are not here within 22 seconds, {next}."
    tell(group, state="playing", **presence(red="here"))
    tab.wait_for_selector("#overlay", state="hidden")
    wait_for_text(tab, "#trouble", "The other participant is back.")


def start_game(world: World, page: Any) -> None:
    world.ready()
    page.goto(world.url)
    page.wait_for_selector("#play:visible")
    until(lambda: world.connections, PATIENCE / 1000)
    page.wait_for_selector("#people b")
    tell(world, state="playing", **presence(red="here"))
    page.wait_for_selector("#overlay", state="hidden")


def test_the_page_says_that_a_computer_player_has_taken_a_place(group: World, tab: Any) -> None:
    start_game(group, tab)
    tell(group, state="playing", **presence(red="policy"))
    wait_for_text(tab, "#trouble", "A computer player has replaced the other participant.")
    assert players_shown(tab) == ["You: Blue", "Red (computer)"]
    shot(tab, "360-policy")
    tell(group, state="playing", **presence(red="here"))
    wait_for_text(tab, "#trouble", "The other participant is back.")


def test_turn_by_turn_the_page_says_whose_turn_it_is(group: World, tab: Any) -> None:
    group.trial = {"pace": "turns"}
    group.controls |= {"pace": "turns", "toAct": False, "players": ["blue", "red", "green"]}
    start_game(group, tab)
    there = presence(red="here", green="here")
    tell(group, state="playing", toAct=False, turnOf=["green"], **there)
    tab.wait_for_selector("#turn:text-is('Turn: Green')")
    tell(group, state="playing", toAct=True, turnOf=["blue"], **there)
    tab.wait_for_selector("#turn:text-is('Your turn')")


def test_the_button_that_ends_the_game_says_that_it_ends_for_everybody(group: World, tab: Any) -> None:
    group.controls |= {"UI": ["start", "stop"]}
    start_game(group, tab)
    tell(group, state="playing", **presence(red="here"))
    tab.wait_for_selector("[data-command=stop]:text-is('End the game for everyone')", state="attached")


def test_with_many_players_the_page_says_how_many_are_there(group: World, tab: Any) -> None:
    group.more, group.state = {"players": 16}, {**group.state, "players": 16}
    start_game(group, tab)
    there = {f"player_{number}": "here" for number in range(16)}
    tell(group, state="paused", heldFor=5, you="player_3", people={**there, "player_5": "away", "player_9": "away"})
    wait_for_text(tab, "#people", "14 of 16 are here")
    assert players_shown(tab)[0] == "You: Player 3"
    wait_for_text(tab, "#overlay-title", "Waiting for Player 5, Player 9")
    assert tab.evaluate("document.documentElement.scrollWidth") <= 360
    shot(tab, "360-held-16")


@pytest.mark.parametrize(("width", "height"), [(360, 640), (640, 360), (1280, 800)])
def test_a_participant_who_was_away_is_told_so_and_not_that_the_others_are_missing(
    group: World, stopped_clock_tab: Any, width: int, height: int
) -> None:
    tab = stopped_clock_tab
    tab.set_viewport_size({"width": width, "height": height})
    start_game(group, tab)
    held = {"state": "paused", "episode": 1, "heldFor": 8, "you": "blue"}
    group.trial_state = {**held, "people": {"blue": "away", "red": "here"}}
    group.connections[0].send(json.dumps(group.trial_state))
    tab.wait_for_selector("#overlay-title:text('You were away for a moment')")
    assert tab.inner_text("#overlay-hint") == "The game will continue as soon as everyone is here."
    check_overlay_fits(tab)
    shot(tab, f"{width}-was-away")
    group.trial_state = {**held, "people": {"blue": "here", "red": "away"}}
    group.connections[0].send(json.dumps(group.trial_state))
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    wait_for_text(tab, "#overlay-hint", "If they are not here within 8 seconds")


def test_a_participant_whose_round_trip_is_being_measured_is_not_told_that_they_were_away(
    group: World, tab: Any
) -> None:
    start_game(group, tab)
    group.trial_state = {"state": "ready", "heldFor": 8, "you": "blue", "people": {"blue": "awaited", "red": "here"}}
    group.connections[0].send(json.dumps(group.trial_state))
    tab.wait_for_selector("#overlay-title:text-is('Waiting for the other participant')")
    assert tab.inner_text("#overlay-hint") == "The game will start as soon as everyone is here."
    assert tab.get_attribute("#people b:first-child", "class") == "awaited"
    tell(group, state="playing", **presence(red="here"))
    tab.wait_for_selector("#people b.here:first-child")


@pytest.mark.parametrize(("width", "height"), [*SIZES, (640, 360)])
def test_words_over_a_low_picture_are_seen_whole(group: World, tab: Any, width: int, height: int) -> None:
    hold_timers(tab, MESSAGE)
    tab.set_viewport_size({"width": width, "height": height})
    low = {"width": 600, "height": 60}
    group.trial = {"scene": low}
    group.controls |= {"scene": low, "assets": []}
    start_game(group, tab)
    drawn = json.dumps({"new": True, "set": {}, "hud": "nothing yet"})
    group.connections[0].send(struct.pack("!BI", 4, 3) + drawn.encode())
    tab.wait_for_function("() => document.getElementById('screen').getBoundingClientRect().height < 80")
    tell(group, state="paused", heldFor=8, **presence(red="away"))
    wait_for_text(tab, "#overlay-hint", "If they are not here within")
    assert tab.evaluate(SEEN_WHOLE, "overlay")
    shot(tab, f"{width}-low-picture")
    tell(group, state="playing", **presence(red="here"))
    wait_for_text(tab, "#trouble", "The other participant is back.")
    assert tab.evaluate(SEEN_WHOLE, "trouble")


MESSAGE = 8_000  # ms for which the page shows one, as hippodrome/web/game/overlay.js has it
SEEN_WHOLE = """id => {
    const found = document.getElementById(id), box = found.getBoundingClientRect(), x = (box.left + box.right) / 2;
    found.style.pointerEvents = "auto";
    const seen = (y) => found.contains(document.elementFromPoint(x, y));
    return found.scrollHeight <= found.clientHeight && seen(box.top + 2) && seen(box.bottom - 2);
}"""


def test_players_have_the_names_that_the_researcher_gives_them(group: World, tab: Any) -> None:
    group.trial = {"afterAbsent": "end", "playerNames": {"blue": "The left slime"}}
    start_game(group, tab)
    assert players_shown(tab) == ["You: The left slime", "Red"]


def open_with_image(group: World, tab: Any, size: int, stands: dict[str, Any]) -> None:
    """Open a game that is drawn by objects, whose one image of `size` bytes has not arrived."""
    group.trial = {"scene": WIDE}
    image = {"name": "cat", "bytes": size, "hash": "0" * 32}
    group.controls |= {"scene": WIDE, "assets": [image], **stands}
    group.ready()
    tab.goto(group.url)


def test_during_the_countdown_the_page_does_not_say_that_images_are_loading(group: World, tab: Any) -> None:
    open_with_image(group, tab, 80_000, {"beginsIn": 30, **presence(red="here")})
    tab.wait_for_selector("#overlay-title:text-is('The game is starting')")
    group.connections[0].send(struct.pack("!BHI", 6, 0, 0) + bytes(4_000))
    tab.wait_for_function("() => document.querySelector('#overlay progress').value > 0")
    assert tab.inner_text("#overlay-title") == "The game is starting"
    assert tab.inner_text("#overlay-score").isdecimal()


def test_a_game_of_several_offers_no_start(group: World, tab: Any) -> None:
    group.controls |= {"UI": ["left", "right", "start"]}
    group.controls |= presence(red="awaited")
    group.ready()
    tab.goto(group.url)
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    assert tab.is_hidden("[data-command=toggle]")
    assert "start" not in tab.inner_text("#legend").lower()


def test_the_pause_button_appears_only_while_the_game_plays(group: World, tab: Any) -> None:
    group.controls |= presence(red="awaited")
    group.ready()
    tab.goto(group.url)
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    assert tab.is_hidden("[data-command=toggle]")
    assert "pause or resume" in tab.inner_text("#legend")
    tell(group, state="playing", **presence(red="here"))
    tab.wait_for_selector("[data-command=toggle]:text-is('Pause')")


def test_players_with_numbers_for_names_are_called_player_0_and_player_1(group: World, tab: Any) -> None:
    group.controls = {"player": "0", "players": ["0", "1"], "you": "0", "people": {"0": "here", "1": "here"}}
    start_game(group, tab)
    tell(group, state="playing", you="0", people={"0": "here", "1": "policy"})
    tab.wait_for_function("() => document.getElementById('people').textContent.includes('computer')")
    assert players_shown(tab) == ["You: Player 0", "Player 1 (computer)"]


def test_the_page_names_each_participant_who_is_away(group: World, tab: Any) -> None:
    group.more, group.state = {"players": 3}, {**group.state, "players": 3}
    start_game(group, tab)
    tell(group, state="paused", heldFor=9, **presence(red="away", green="here"))
    wait_for_text(tab, "#overlay-title", "Waiting for Red")
    tell(group, state="paused", heldFor=8, **presence(red="away", green="away"))
    wait_for_text(tab, "#overlay-title", "Waiting for Red, Green")
    tell(group, state="paused", heldFor=7, **presence(red="here", green="away"))
    tab.wait_for_selector("#overlay-title:text-is('Waiting for Green')")


def test_a_lost_connection_of_the_page_is_told_apart_from_the_absence_of_the_other(group: World, tab: Any) -> None:
    start_game(group, tab)
    tell(group, state="paused", heldFor=9, **presence(red="away"))
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    group.state["url"] = "ws://127.0.0.1:9/"
    group.connections[0].socket.close()
    group.connections[0].close()
    tab.wait_for_selector("#overlay-title:text('Connection lost')")
    tab.wait_for_timeout(600)  # a countdown that still ran would have changed the words by now
    assert "The other participant can see that you are away" in tab.inner_text("#overlay-hint")
    shot(tab, "360-offline")
    group.ready()
    tab.wait_for_selector("#overlay-title:text('Ready?')")


@pytest.mark.parametrize(("width", "height"), [(360, 640), (1280, 800)])
@pytest.mark.parametrize(
    ("outcome", "reason", "says"),
    [
        ("partnerLeft", "", "The other participant left, so the game has ended."),
        ("left", "", "You were away for too long"),
        ("ping", "", "Your connection is too slow to play"),
        ("partnerLeft", PARTNER_MISSING, PARTNER_MISSING),
        ("ping", PING, PING),
    ],
)
def test_an_early_end_is_explained_until_the_participant_goes_on(
    group: World, tab: Any, width: int, height: int, outcome: str, reason: str, says: str
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    start_game(group, tab)
    group.step, group.source = 3, "<h1>Next page</h1>"
    group.connections[0].send(json.dumps({"error": "That move is not possible now"}))
    tell(group, state="playing", **presence(red="here"))
    if reason:
        group.connections[0].send(json.dumps({"error": reason}))
    tell(group, state="ended", **presence(red="away"))
    played = outcome != "ping"
    group.connections[0].send(json.dumps({"done": True, "outcome": outcome, "score": 7, "episodes": int(played)}))
    tab.wait_for_selector("#overlay-title:text('The game has ended')")
    hint = tab.inner_text("#overlay-hint")
    assert says in hint
    assert "not possible" not in hint
    assert tab.inner_text("#overlay-score") == ("Your score: 7" if played else "")
    wait_for_text(tab, "#announce", says)
    check_overlay_fits(tab)
    shot(tab, f"{width}-{outcome}")
    tab.wait_for_timeout(4_500)  # after other ends the page goes on by itself after four seconds
    assert tab.is_visible("#overlay-button")
    tab.click("#overlay-button")
    tab.wait_for_selector("h1:text('Next page')")


WIDE = {"width": 960, "height": 500, "coordinates": "pixels"}


@pytest.mark.parametrize(("width", "height"), [(360, 640), (320, 568), (640, 360), (568, 320)])
def test_words_over_and_above_a_low_picture_fit_a_phone(group: World, chromium: Any, width: int, height: int) -> None:
    context = chromium.new_context(viewport={"width": width, "height": height}, has_touch=True, is_mobile=True)
    page = context.new_page()
    ui = ["up", "down", "left", "right", "start"]
    group.trial = {"scene": WIDE, "ui": dict.fromkeys(ui, True)}
    group.controls |= {"UI": ui, "actionSpace": ["noop", *ui[:4]], "scene": WIDE, "assets": []}
    start_game(group, page)
    drawn = json.dumps({"new": True, "set": {}, "hud": "0 of 8 acorns, 36 turns left"})
    group.connections[0].send(struct.pack("!BI", 4, 3) + drawn.encode())
    page.wait_for_selector("#scene-hud:visible")
    tell(group, state="paused", heldFor=23, **presence(red="away"))
    page.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    check_overlay_fits(page)
    overflow = (
        "[document.documentElement.scrollWidth - innerWidth, document.documentElement.scrollHeight - innerHeight]"
    )
    assert page.evaluate(overflow) == [0, 0]
    for each in page.locator(".hud > :visible, #people b").all():
        box = each.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width
    shot(page, f"{width}-low-held")
    group.connections[0].send(json.dumps({"done": True, "outcome": "partnerLeft", "score": 7, "episodes": 1}))
    page.wait_for_selector("#overlay-title:text('The game has ended')")
    check_overlay_fits(page)
    top = "() => document.elementFromPoint(innerWidth - 40, innerHeight - 40).id"
    assert page.evaluate(top) == "overlay", "no button shows through"
    assert page.evaluate(FLAWS) == []
    shot(page, f"{width}-low-end")
    context.close()


def test_a_finished_game_of_several_ends_without_an_explanation(group: World, tab: Any) -> None:
    hold_timers(tab, LAST_PICTURE)
    start_game(group, tab)
    group.connections[0].send(json.dumps({"done": True, "outcome": "finished", "score": 7, "episodes": 1}))
    tab.wait_for_selector("#overlay-title:text('The game is over')")
    assert tab.inner_text("#overlay-hint") == ""


# Pages to read


def test_the_server_is_told_when_the_instructions_are_read(group: World, stopped_clock_tab: Any) -> None:
    tab = stopped_clock_tab
    group.texts = {"instructions": "<h2>How to play</h2>"}
    group.trial = {"instructions": "how"}
    group.controls |= {"you": "blue", "people": {"blue": "reads", "red": "reads"}}
    group.ready()
    tab.goto(group.url)
    tab.wait_for_selector("h2:text('How to play'):visible")
    assert group.player_commands() == []
    tell(group, state="ready", heldFor=20, you="blue", people={"blue": "reads", "red": "here"})
    wait_for_text(tab, "#reading", "The other participant is waiting for you. Please continue within 20 seconds.")
    assert tab.is_visible("h2:text('How to play')")
    shot(tab, "360-reading")
    group.started = {"state": "ready", "episode": 1, "heldFor": 18, **presence(red="reads")}
    tab.click("#reading-button")
    group.wait_for({"command": "start"})
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant'):visible")
    assert players_shown(tab) == ["You: Blue", "Red (reading)"]
    assert "Not everyone has finished reading. The game will start within 18 seconds." in tab.inner_text(
        "#overlay-hint"
    )


def test_instructions_that_were_read_before_a_reload_are_not_shown_again(group: World, stopped_clock_tab: Any) -> None:
    test_the_server_is_told_when_the_instructions_are_read(group, stopped_clock_tab)
    group.received.clear()
    stopped_clock_tab.reload()
    group.wait_for({"command": "start"})


def test_between_two_games_the_page_says_whom_it_waits_for(group: World, tab: Any) -> None:
    group.texts = {"betweenEpisodes": "<h2>How was it?</h2>"}
    group.trial = {"betweenEpisodes": "how"}
    start_game(group, tab)
    tell(group, state="break", you="blue", people={"blue": "reads", "red": "reads"})
    tab.wait_for_selector("h2:text('How was it?'):visible")
    group.started = {"state": "break", "episode": 1, "heldFor": 20, **presence(red="reads")}
    tab.click("#reading-button")
    group.wait_for({"command": "start"})
    wait_for_text(tab, "#reading", "Waiting for the other participant…")
    assert tab.is_visible("h2:text('How was it?')")
    tell(group, state="playing", episode=2, **presence(red="here"))
    tab.wait_for_selector("#screen:visible")


# A phone that sleeps, a hidden tab


@contextlib.contextmanager
def asleep(page: Any) -> Iterator[None]:
    """Stop the page's script, as on a phone whose screen is locked. (Chromium without a window cannot freeze a page.)"""
    devtools = page.context.new_cdp_session(page)
    devtools.send("Debugger.enable")
    devtools.send("Debugger.pause")
    time.sleep(0.5)
    yield
    devtools.send("Debugger.resume")
    devtools.send("Debugger.disable")


def test_a_phone_that_sleeps_in_the_lobby_asks_again_when_it_wakes(group: World, tab: Any) -> None:
    tab.goto(group.url)
    wait_for_polls(group, 1)
    with asleep(tab):
        before = len(group.polls)
        time.sleep(4.5)
        assert len(group.polls) <= before + 1, "so its participant is taken for gone, and is not matched"
        group.state = {**LOBBY, "seconds": 1}
    wait_for_text(tab, "#lobby-note", "You were away for a while")
    wait_for_polls(group, 2)


def test_a_phone_that_wakes_shows_the_present_state_of_the_game(group: World, tab: Any) -> None:
    start_game(group, tab)
    group.controls |= {"state": "paused", "beginsIn": 9}  # in case the page connects again
    with asleep(tab):
        tell(group, state="paused", heldFor=4, **presence(red="away"))
        tell(group, state="paused", beginsIn=9, **presence(red="here"))
    tab.wait_for_selector("#overlay-title:text('The game is about to continue')")
    assert players_shown(tab) == ["You: Blue", "Red"]


def test_a_page_that_learns_that_it_was_away_says_that_it_is_there(group: World, tab: Any) -> None:
    start_game(group, tab)
    note_texts(tab, "#overlay-score")
    group.trial_state = {"state": "paused", "episode": 1, "beginsIn": 3, **presence(red="here")}
    away = {"state": "paused", "episode": 1, "heldFor": 8, "you": "blue", "people": {"blue": "away", "red": "here"}}
    group.connections[0].send(json.dumps(away))
    group.wait_for({"command": "requestUI"})
    wait_for_noted(tab, "#overlay-score", "3")


def test_a_page_that_comes_back_from_the_browsers_cache_is_back_in_the_lobby(group: World, chromium: Any) -> None:
    browser = chromium.browser_type.launch(
        executable_path=chromium_path(), args=list(ARGUMENTS), ignore_default_args=["--disable-back-forward-cache"]
    )
    page = browser.new_page()
    page.goto(group.url)
    page.evaluate("window.same = true")
    wait_for_polls(group, 1)
    with html_page("<p>elsewhere</p>") as elsewhere:
        page.goto(elsewhere)
        wait_for_posts(group)
        gone = len(group.polls)
        page.wait_for_timeout(4_000)
        assert len(group.polls) <= gone + 1
        page.go_back(wait_until="commit")
    wait_for_polls(group, 2)
    assert page.evaluate("window.same") is True, "it came from the cache"
    page.goto("about:blank")
    wait_for_posts(group, 2)
    browser.close()
    assert [post["hippodrome-action"] for post in group.posts] == ["leave", "leave"]


def test_the_title_of_a_hidden_tab_changes_once_its_participant_is_matched(group: World, tab: Any) -> None:
    tab.add_init_script("Object.defineProperty(document, 'hidden', { get: () => window.unseen ?? false })")
    tab.goto(group.url)
    assert tab.title().startswith("1 of 2 \u2013 ")
    tab.evaluate("window.unseen = true")
    group.state = dict(MATCHED)
    tab.wait_for_function("() => document.title.startsWith('● Your game is being prepared \u2013 ')")
    tab.wait_for_function("() => document.title.startsWith('Your game')")
    tab.evaluate("window.unseen = false")
    tab.wait_for_function("() => document.title.startsWith('Your game')")
    tab.wait_for_timeout(1_500)
    assert tab.title().startswith("Your game is being prepared \u2013 ")


def test_a_second_tab_takes_the_game_and_the_first_one_says_so(group: World, tab: Any) -> None:
    start_game(group, tab)
    group.connections[0].close(4409, "opened elsewhere")
    tab.wait_for_selector("text=Play here instead")
    assert players_shown(tab) == ["You: Blue", "Red"]
    assert tab.inner_text("#overlay-hint") == "If you have closed it there, continue here."
    check_overlay_fits(tab)
    shot(tab, "360-elsewhere")


def test_when_the_images_are_loaded_the_page_says_again_what_the_game_waits_for(group: World, tab: Any) -> None:
    open_with_image(group, tab, 8, {"heldFor": 20, **presence(red="awaited")})
    tab.wait_for_selector("#overlay-title:text('Loading the pictures')")
    group.connections[0].send(struct.pack("!BHI", 6, 0, 0) + struct.pack("!I", 2) + b"{}" + b"no")
    tab.wait_for_selector("#overlay-title:text('Waiting for the other participant')")
    assert tab.is_hidden("#overlay-button")


def test_a_message_right_behind_the_first_one_is_shown(group: World, tab: Any) -> None:
    """A server sends the controls, and at once the state of the trial."""

    def speak(connection: Any) -> None:
        group.connections.append(connection)
        for text in connection:
            if "token" in json.loads(text):
                said = {"UI": ["left"], "actionSpace": ["noop", "left"], "state": "ready", "episode": 1, "score": 0}
                connection.send(json.dumps({**said, **presence(red="here")}))
                connection.send(json.dumps({"state": "ready", "episode": 1, "beginsIn": 30, **presence(red="here")}))

    group.play = speak  # type: ignore[method-assign]
    group.trial = {"episodeSeconds": 60}
    tab.goto(group.url)
    note_texts(tab, "#overlay-score")
    group.state = dict(MATCHED)
    group.ready()
    tab.wait_for_selector("#overlay-title:text('The game is starting')")
    wait_for_noted(tab, "#overlay-score", "30")
