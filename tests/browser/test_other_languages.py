"""Pages in other languages: words that are longer than the English ones, and text that runs from right to left."""

from __future__ import annotations

import string
from itertools import product
from typing import Any

import pytest

from hippodrome.control.model.texts import ENGLISH, is_right_to_left
from tests.browser.test_together_browser import LOBBY
from tests.browser.world import FLAWS, World, play, shot, tell

pytestmark = pytest.mark.browser
SIZES = [(360, 740), (1280, 800)]
NO_LONGER_WRITTEN = {"ae"}  # Avestan
LONG = {"pause": "Interrompre", "reset": "Recommencer"}
HEBREW = {"language": "he", "start": "התחלה", "pause": "הפסקה", "saidPing": "החיבור איטי מדי."}
TOGGLE = "[data-command=toggle]"
IS_LEFT_OF = "([one, other]) => find(one).right <= find(other).left".replace(
    "find", "(selector => document.querySelector(selector).getBoundingClientRect())"
)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_long_words_on_buttons_stay_in_one_line_and_leave_the_buttons_equally_large(
    world: World, tab: Any, width: int, height: int
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    world.more = {"texts": LONG}
    play(world, tab)
    tell(world, state="playing")
    tab.wait_for_selector(f"{TOGGLE}:text-is('Interrompre')")
    pause, again = (tab.locator(each).bounding_box() for each in (TOGGLE, "[data-command=reset]"))
    assert (pause["width"], pause["height"]) == (again["width"], again["height"])
    assert pause["height"] < 50, "in one line"
    assert tab.evaluate("document.documentElement.scrollWidth") <= width


def test_the_browser_and_hippodrome_agree_which_languages_run_from_right_to_left(tab: Any) -> None:
    names = ["".join(letters) for letters in product(string.ascii_lowercase, repeat=2)]
    names += ["ary", "heb", "prs", "skr", "fil", "ku-Arab", "pa-Arab", "ar-Latn", "he-IL", "ur-Latn-PK", "zh-Hant"]
    tab.goto("about:blank")
    found = tab.evaluate(
        "names => names.filter(name => new Intl.Locale(name).getTextInfo().direction === 'rtl')", names
    )
    assert {name for name in names if is_right_to_left(name)} == set(found) - NO_LONGER_WRITTEN


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_in_hebrew_the_stages_of_waiting_are_marked_at_the_right(
    world: World, tab: Any, width: int, height: int
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    world.more, world.step = {"texts": HEBREW}, 2
    tab.goto(world.url)
    tab.wait_for_selector("#stage-queued[aria-current]")
    mark, line = (
        tab.evaluate(f"parseFloat(getComputedStyle(document.querySelector('#stage-queued'), '{part}').right)")
        for part in ("::before", "::after")
    )
    assert (mark, line) == (0, pytest.approx(9.6))
    assert tab.evaluate("parseFloat(getComputedStyle(document.querySelector('#stage-queued')).paddingRight)") > 30
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-right-to-left-waiting")


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_in_hebrew_the_words_run_from_right_to_left_and_the_game_is_not_mirrored(
    world: World, tab: Any, width: int, height: int
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    world.more = {"texts": HEBREW}
    play(world, tab)
    tell(world, state="playing", episode=2, score=-1234, episodeScore=-3.5)
    tab.wait_for_selector(f"{TOGGLE}:text-is('{HEBREW['pause']}')")
    assert tab.evaluate("document.documentElement.dir") == "rtl"
    directions = {
        name: tab.evaluate("name => getComputedStyle(document.querySelector(name)).direction", name)
        for name in (".hud", ".overlay", ".commands", ".legend", "#screen", ".pad")
    }
    assert {name for name, direction in directions.items() if direction == "ltr"} == {"#screen", ".pad"}
    assert tab.evaluate(IS_LEFT_OF, [".pad .left", ".pad .right"])
    if width > height:
        assert tab.evaluate(IS_LEFT_OF, [".hud", "#screen"])
        assert tab.evaluate(IS_LEFT_OF, ["#screen", ".controls"])
    else:
        assert tab.evaluate(IS_LEFT_OF, ["#episode", "#total"])
    assert tab.inner_text("#score") == "\u200e-3.5"  # U+200E keeps the minus before its number
    assert tab.inner_text("#total") == ENGLISH["total"].replace("{score}", "\u200e-1,234")
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-right-to-left")


def test_the_lobby_shows_the_studys_own_sentence_about_empty_places(world: World, tab: Any) -> None:
    own = "{players} places, {here} prises\u00a0: un joueur automatique prend l'autre."
    world.more, world.step = {"texts": {"takesPlace": own}, "players": 3}, 2
    world.state = {**LOBBY, "players": 3, "here": 2, "then": "policies", "proposed": True}
    tab.goto(world.url)
    sentence = own.replace("{players}", "3").replace("{here}", "2")
    tab.wait_for_function(
        "text => document.getElementById('lobby-here').textContent === text", arg=f"{sentence} {ENGLISH['moment']}"
    )
