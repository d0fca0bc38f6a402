"""The panel in which participants talk, in a real Chromium beside a fake trial server: lines, keys, an unsteady network."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest

from hippodrome.control.model.texts import ENGLISH
from testing.waiting import until
from tests.browser.conftest import hold_timers
from tests.browser.world import FLAWS, NOWHERE, World, play, shot, tell, wait_for_reconnection

pytestmark = pytest.mark.browser
SIZES = pytest.mark.parametrize(("width", "height"), [(360, 740), (1280, 800)])
CHAT = {
    "me": "red",
    "with": ["ai"],
    "names": {"ai": "Robo"},
    "maxLength": 100,
    "turns": "free",
    "typing": True,
    "phrases": [],
}
BETWEEN = 2_500  # ms for which the last picture is shown before the page between two games, as hippodrome/web/game/reading.js has it
SIZE = "[document.documentElement.scrollWidth, document.documentElement.scrollHeight]"
LINES = "all => all.map(each => [each.classList.contains('mine'), each.querySelector('p').textContent])"


class TalkingWorld:
    """A fake trial server that talks: it sends the lines so far to each connection, and otherwise what a test says."""

    def __init__(self, world: World) -> None:
        self.world, self.history = world, list[dict[str, Any]]()
        self.chat = dict(CHAT)
        world.trial = {"chat": {"with": ["ai"]}}
        world.before_pictures = self._greet

    def _greet(self) -> None:
        self.say(lines=self.history, **({"turn": "red"} if self.chat["turns"] == "alternate" else {}))

    def say(self, **message: Any) -> None:
        """Send a message to the page that is connected."""
        self.world.connections[-1].send(json.dumps(message))

    def open(self, tab: Any) -> None:
        """Open the game's page, and wait until the participant may talk."""
        self.world.controls = {"chat": self.chat, **self.world.controls}
        play(self.world, tab)
        tab.wait_for_selector("#chat:visible")

    def said(self, number: int = 1) -> list[dict[str, Any]]:
        """Return the lines that the page has sent, once there are so many."""
        until(lambda: len(self.world.commands("say")) >= number)
        return self.world.commands("say")

    def echo(self, said: dict[str, Any], n: int, **more: Any) -> None:
        """Let the participant's line be heard."""
        self.say(lines=[{"n": n, "by": "red", "text": said["text"], "id": said["id"]}], **more)


@pytest.fixture
def talking(world: World) -> TalkingWorld:
    return TalkingWorld(world)


def shown(tab: Any) -> list[Any]:
    """Return the lines in the panel, each as whether it is the participant's, and its text."""
    found: list[Any] = tab.eval_on_selector_all("#chat-log .line", LINES)
    return found


def write(tab: Any, text: str) -> None:
    tab.fill("#chat-field", text)
    tab.press("#chat-field", "Enter")


@SIZES
def test_lines_of_both_sides_stand_in_their_order(talking: TalkingWorld, tab: Any, width: int, height: int) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    talking.open(tab)
    tab.wait_for_selector(f"#overlay-title:text('{ENGLISH['ready']}')")
    shot(tab, f"{width}-chat-ready")
    tell(talking.world, state="playing")
    talking.say(lines=[{"n": 1, "by": "ai", "text": "Hello! Shall I take the left half?"}])
    tab.wait_for_selector("text=Shall I take the left half?")
    write(tab, "Yes, please.")
    tab.wait_for_selector(".line.waiting small:text('Sending…')")
    (said,) = talking.said()
    assert said["text"] == "Yes, please."
    talking.say(lines=[{"n": 2, "by": "ai", "text": "And what about the middle?\nIt is far away from both of us."}])
    tab.wait_for_selector("text=what about the middle")
    talking.echo(said, 3)
    tab.wait_for_selector(".line:not(.waiting) >> text=Yes, please.")
    talking.say(typing={"ai": True})
    tab.wait_for_selector("#chat-doing:text('Robo is typing…')")
    assert shown(tab) == [
        [False, "Hello! Shall I take the left half?"],
        [False, "And what about the middle?\nIt is far away from both of us."],
        [True, "Yes, please."],
    ]
    assert tab.input_value("#chat-field") == ""
    assert tab.evaluate(FLAWS) == []
    assert tab.evaluate(SIZE) == [width, height]
    shot(tab, f"{width}-chat")


def test_a_page_without_talk_has_neither_the_panel_nor_its_rules(world: World, tab: Any) -> None:
    play(world, tab)
    assert tab.locator("#chat").count() == 0
    assert not re.findall("#chat|chat-", tab.content())


def test_a_server_that_was_started_before_the_study_talked_shows_no_panel(talking: TalkingWorld, tab: Any) -> None:
    talking.world.before_pictures = lambda: None
    play(talking.world, tab)
    tab.wait_for_selector("#chat", state="hidden")


# Keys


def test_keys_of_the_game_are_letters_in_the_panel_and_escape_gives_them_back(talking: TalkingWorld, tab: Any) -> None:
    world = talking.world
    talking.open(tab)
    tab.keyboard.press("Space")
    world.wait_for({"command": "start"})
    tab.keyboard.down("ArrowLeft")
    world.wait_for({"action": "left", "held": True})
    tab.focus("#chat-field")
    world.wait_for({"action": "left", "held": False})
    before = len(world.commands("action")), len(world.player_commands())
    tab.keyboard.type("draw up, wp r")
    tab.keyboard.press("ArrowLeft")
    tab.keyboard.press("Shift+Enter")
    assert tab.input_value("#chat-field") == "draw up, wp \nr"
    tab.keyboard.press("Escape")
    assert tab.evaluate("document.activeElement.id") == "screen"
    tab.keyboard.press("ArrowRight")
    world.wait_for({"action": "right", "held": False})
    assert (len(world.commands("action")), len(world.player_commands())) == (before[0] + 2, before[1])
    assert world.commands("say") == []


def test_a_click_on_the_game_gives_the_keys_back(talking: TalkingWorld, tab: Any) -> None:
    tab.set_viewport_size({"width": 1280, "height": 800})
    talking.open(tab)
    tell(talking.world, state="playing")
    for selector in ("#screen", "[data-action=fire]"):
        tab.focus("#chat-field")
        tab.click(selector)
        assert tab.evaluate("document.activeElement.id") == "screen"


def test_enter_that_ends_a_composition_sends_nothing(talking: TalkingWorld, tab: Any) -> None:
    talking.open(tab)
    tab.fill("#chat-field", "にほん")
    enter = "each => each.dispatchEvent(new KeyboardEvent('keydown', {key: 'Enter', bubbles: true, cancelable: true, isComposing: %s}))"
    tab.eval_on_selector("#chat-field", enter % "true")
    assert tab.input_value("#chat-field") == "にほん"
    tab.eval_on_selector("#chat-field", enter % "false")
    assert [each["text"] for each in talking.said()] == ["にほん"]


def test_the_server_learns_whether_the_participant_types_and_for_how_long(talking: TalkingWorld, tab: Any) -> None:
    talking.open(tab)
    tab.keyboard.press("Tab")
    tab.type("#chat-field", "Hi")
    talking.world.wait_for({"typing": True})
    tab.press("#chat-field", "Backspace")
    tab.press("#chat-field", "Backspace")
    talking.world.wait_for({"typing": False})
    tab.type("#chat-field", "Ho", delay=50)
    tab.press("#chat-field", "Enter")
    (said,) = talking.said()
    assert said["text"] == "Ho"
    assert 50 <= said["typed"] < 30_000
    until(lambda: talking.world.commands("typing") == [True, False, True, False])


# Lines that grow, long lines, many lines, hostile lines


def test_a_line_that_grows_stays_in_its_place_and_is_read_out_once_it_is_complete(
    talking: TalkingWorld, tab: Any
) -> None:
    talking.open(tab)
    talking.say(lines=[{"n": 1, "by": "ai", "text": "Take", "more": True}])
    tab.wait_for_selector(".line[aria-hidden=true] >> text=Take")
    talking.say(lines=[{"n": 2, "by": "blue", "text": "Me too"}])
    talking.say(lines=[{"n": 1, "by": "ai", "text": "Take the left", "more": True}])
    tab.wait_for_selector("text=Take the left")
    assert shown(tab) == [[False, "Take the left"], [False, "Me too"]]
    talking.say(lines=[{"n": 1, "by": "ai", "text": "Take the left half."}])
    tab.wait_for_selector(".line:not([aria-hidden]) >> text=Take the left half.")
    assert shown(tab) == [[False, "Take the left half."], [False, "Me too"]]


def test_new_lines_do_not_move_what_is_read(talking: TalkingWorld, tab: Any) -> None:
    talking.history = [{"n": n, "by": "ai", "text": f"Line {n}"} for n in range(1, 41)]
    talking.open(tab)
    tab.wait_for_selector("text=Line 40")
    left = "document.getElementById('chat-log').scrollHeight - document.getElementById('chat-log').clientHeight - document.getElementById('chat-log').scrollTop"
    assert tab.evaluate(left) < 2
    talking.say(lines=[{"n": 41, "by": "ai", "text": "Line 41"}])
    tab.wait_for_selector("text=Line 41")
    assert tab.evaluate(left) < 2
    assert not tab.is_visible("#chat-newest")
    tab.eval_on_selector("#chat-log", "log => { log.scrollTop = 100; }")
    tab.wait_for_timeout(100)
    talking.say(lines=[{"n": 42, "by": "ai", "text": "Line 42"}])
    tab.wait_for_selector("#chat-newest:visible")
    shot(tab, "360-chat-newest")
    assert tab.evaluate("document.getElementById('chat-log').scrollTop") == 100
    tab.click("#chat-newest")
    assert tab.evaluate(left) < 2
    tab.wait_for_selector("#chat-newest", state="hidden")


def test_the_page_keeps_the_last_500_lines(talking: TalkingWorld, tab: Any) -> None:
    talking.open(tab)
    for first in range(1, 1001, 100):
        talking.say(lines=[{"n": n, "by": "ai", "text": f"Line {n}"} for n in range(first, first + 100)])
    tab.wait_for_selector("text='Line 1000'")
    assert [text for _, text in shown(tab)] == [f"Line {n}" for n in range(501, 1001)]


HOSTILE = [
    "<img src=x onerror='window.hurt = 1'><script>window.hurt = 1</script>",
    "</script><style>* { display: none }</style>",
    "a" * 1000,
    "\u202enekorb si siht\u202d \u2066\u2067",
    "Z\u0335\u0322\u0321" + "\u0301\u0302\u0303\u0304\u0305\u0306\u0307\u0308" * 30 + "algo",
    "👩‍👩‍👧‍👦🏳️‍🌈" * 20,
    "שלום, 42 (a) <b>",
    "line\n" * 10,
    "javascript:alert(1) http://example.org",
    "\x00\x07\ufffe",
]


@SIZES
def test_what_others_write_is_text_and_changes_nothing_beside_it(
    talking: TalkingWorld, tab: Any, width: int, height: int
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    talking.chat["names"] = {"ai": "<b>Robo</b> \u202egnol"}
    talking.open(tab)
    before = tab.locator("#screen").bounding_box()
    for n, text in enumerate(HOSTILE, 1):
        talking.say(lines=[{"n": n, "by": "ai", "text": text}])
    tab.wait_for_function("number => document.querySelectorAll('.line').length === number", arg=len(HOSTILE))
    tab.wait_for_timeout(200)
    assert [text for _, text in shown(tab)] == HOSTILE
    assert tab.evaluate("window.hurt") is None
    assert tab.eval_on_selector_all("#chat-log :is(img, script, style, a)", "all => all.length") == 0
    assert tab.locator("#screen").bounding_box() == before
    assert tab.eval_on_selector("#chat-log", "log => log.scrollWidth - log.clientWidth") == 0
    for n in range(len(HOSTILE)):  # no line is wider than the panel, nor painted beyond its own bubble
        assert tab.eval_on_selector_all(".line p", "(all, n) => getComputedStyle(all[n]).overflowY", n) in (
            "clip",
            "hidden",
        )
    shot(tab, f"{width}-chat-hostile")


# Offline, length, rate, turns


def test_a_line_that_is_written_offline_is_kept_over_a_reload_and_sent_once(talking: TalkingWorld, tab: Any) -> None:
    world = talking.world
    talking.open(tab)
    write(tab, "first")
    (first,) = talking.said()
    # The connection is lost before the echo comes; the server has heard the line.
    world.state = {**world.state, "url": NOWHERE}
    world.connections[-1].close(1011)
    tab.wait_for_selector(f"#overlay-title:text('{ENGLISH['lost']}')")
    write(tab, "second")
    tab.wait_for_selector(f"#chat-note:text('{ENGLISH['messageKept']}')")
    shot(tab, "360-chat-offline")
    tab.fill("#chat-field", "a draft")
    tab.reload()
    talking.history = [{"n": 1, "by": "red", "text": "FIRST", "id": first["id"]}]
    world.state = {**world.state, "url": world.game_url}
    talking.said(2)
    second = world.commands("say")[1]
    assert second["text"] == "second"
    assert second["id"] > first["id"]
    talking.echo(second, 2)
    tab.wait_for_function("() => !document.querySelector('.line.waiting')")
    assert shown(tab) == [[True, "FIRST"], [True, "second"]]
    assert tab.input_value("#chat-field") == "a draft"
    assert len(world.commands("say")) == 2


def test_after_a_reconnection_only_what_was_not_heard_is_sent_again(talking: TalkingWorld, tab: Any) -> None:
    world = talking.world
    talking.open(tab)
    write(tab, "heard")
    write(tab, "lost")
    heard, lost = talking.said(2)
    talking.history = [{"n": 1, "by": "red", "text": "heard", "id": heard["id"]}]
    world.connections[-1].close(1011)
    wait_for_reconnection(world, tab)
    again = talking.said(3)[2]
    assert again == lost
    talking.echo(again, 2)
    tab.wait_for_function("() => !document.querySelector('.line.waiting')")
    assert shown(tab) == [[True, "heard"], [True, "lost"]]
    assert len(world.commands("say")) == 3


def test_lines_that_a_killed_server_lost_make_room_for_others_and_own_ones_are_sent_again(
    talking: TalkingWorld, tab: Any
) -> None:
    world = talking.world
    talking.open(tab)
    talking.say(lines=[{"n": 1, "by": "ai", "text": "Hello"}])
    for n, text in enumerate(["stored", "lost", "lost too"], 2):
        write(tab, text)
        talking.echo(talking.said(n - 1)[-1], n)
    talking.say(lines=[{"n": 5, "by": "ai", "text": "Well", "more": True}])
    tab.wait_for_selector("text=Well")
    stored, *lost = talking.said(3)
    talking.history = [
        {"n": 1, "by": "ai", "text": "Hello"},
        {"n": 2, "by": "red", "text": "stored", "id": stored["id"]},
        {"n": 3, "by": "blue", "text": "from Blue"},
    ]
    world.connections[-1].close(1011)
    wait_for_reconnection(world, tab)
    assert talking.said(5)[3:] == lost
    tab.wait_for_selector(".line:not(.mine) >> text=from Blue")
    before = [[False, "Hello"], [True, "stored"], [False, "from Blue"]]
    assert shown(tab) == [*before, [True, "lost"], [True, "lost too"]]
    for n, said in enumerate(lost, 4):
        talking.echo(said, n)
    tab.wait_for_function("() => !document.querySelector('.line.waiting')")
    assert shown(tab) == [*before, [True, "lost"], [True, "lost too"]]
    assert tab.locator(".line:not(.mine) >> text=from Blue").count() == 1
    assert len(world.commands("say")) == 5


def test_a_lost_line_is_sent_again_also_after_a_reload(talking: TalkingWorld, tab: Any) -> None:
    talking.open(tab)
    write(tab, "lost")
    talking.echo(talking.said()[0], 1)
    tab.wait_for_selector(".line:not(.waiting) >> text=lost")
    tab.reload()
    lost, again = talking.said(2)
    assert again == lost
    talking.echo(again, 1)
    tab.wait_for_selector(".line:not(.waiting) >> text=lost")
    assert shown(tab) == [[True, "lost"]]


def test_two_tabs_of_a_participant_lose_and_double_no_line(talking: TalkingWorld, tab: Any, narrow: Any) -> None:
    world = talking.world
    talking.open(tab)
    write(tab, "from the first tab")
    (first,) = talking.said()
    second = narrow.new_page()
    second.goto(world.url)
    second.wait_for_selector("#chat:visible")
    until(lambda: len(world.connections) == 2)
    world.connections[0].close(4409)
    tab.wait_for_selector(f"#overlay-title:text('{ENGLISH['elsewhere']}')")
    write(second, "from the second tab")
    said = talking.said(2)[1]
    talking.history = [{"n": 1, "by": "red", "text": said["text"], "id": said["id"]}]
    second.close()
    tab.click(f"text={ENGLISH['playHere']}")
    again = talking.said(3)[2]
    assert again == first
    assert first["id"] < said["id"]
    talking.echo(again, 2)
    tab.wait_for_function("() => !document.querySelector('.line.waiting')")
    assert shown(tab) == [[True, "from the second tab"], [True, "from the first tab"]]


def test_length_is_told_in_words_and_counts_characters(talking: TalkingWorld, tab: Any) -> None:
    talking.open(tab)
    tab.fill("#chat-field", "🙂" * 40)
    assert tab.inner_text("#chat-room") == ""
    tab.fill("#chat-field", "🙂" * 60)
    assert tab.inner_text("#chat-room") == "40 characters left"
    write(tab, "🙂" * 103)
    assert tab.inner_text("#chat-room") == "3 characters too many"
    assert tab.inner_text("#chat-note") == "Your message is too long. The limit is 100 characters."
    shot(tab, "360-chat-too-long")
    assert tab.input_value("#chat-field") == "🙂" * 103
    write(tab, "🙂" * 100)
    assert [each["text"] for each in talking.said()] == ["🙂" * 100]
    assert tab.inner_text("#chat-note") == ""
    write(tab, " \n ")
    assert len(talking.world.commands("say")) == 1


def test_lines_go_no_faster_than_the_server_takes_them(talking: TalkingWorld, stopped_clock_tab: Any) -> None:
    tab = stopped_clock_tab
    talking.open(tab)
    for n in range(22):
        write(tab, f"line {n}")
    assert [each["text"] for each in talking.said(5)] == [f"line {n}" for n in range(5)]
    assert tab.inner_text("#chat-note") == ENGLISH["tooManyMessages"]
    assert tab.input_value("#chat-field") == "line 21", "the text stays, to be sent later"
    for n, said in enumerate(talking.said(5)[:5], 1):
        talking.echo(said, n)
    tab.wait_for_function("() => document.querySelectorAll('.line:not(.waiting)').length === 5")
    tab.clock.run_for(5_400)
    assert len(talking.world.commands("say")) == 5
    tab.clock.run_for(200)
    assert len(talking.said(10)) == 10


@pytest.mark.parametrize(
    ("why", "words", "kept"),
    [
        ("tooFast", ENGLISH["tooManyMessages"], "Hi"),
        ("tooLong", "Your message is too long. The limit is 100 characters.", "Hi"),
        ("notYourTurn", ENGLISH["messageRefused"], "Hi"),
        ("held", ENGLISH["messageHeld"], ""),
        ("somethingNew", ENGLISH["messageRefused"], "Hi"),
    ],
)
def test_a_refusal_is_told_in_words_and_the_text_comes_back(
    talking: TalkingWorld, tab: Any, why: str, words: str, kept: str
) -> None:
    talking.open(tab)
    write(tab, "Hi")
    talking.say(refused={"id": talking.said()[0]["id"], "why": why})
    tab.wait_for_function("() => !document.querySelector('.line')")
    assert tab.inner_text("#chat-note") == words
    assert tab.input_value("#chat-field") == kept


def test_if_they_write_by_turns_the_page_says_whose_turn_it_is(talking: TalkingWorld, tab: Any) -> None:
    talking.chat["turns"] = "alternate"
    talking.open(tab)
    tab.wait_for_selector("#chat-doing:text('Your turn')")
    write(tab, "Your offer?")
    (said,) = talking.said()
    tab.fill("#chat-field", "A thought")
    assert tab.is_disabled("#chat-form button")
    tab.press("#chat-field", "Enter")
    talking.echo(said, 1, turn="ai")
    tab.wait_for_selector("#chat-doing:text('Robo writes next.')")
    tab.press("#chat-field", "Enter")
    talking.say(lines=[{"n": 2, "by": "ai", "text": "Three."}], turn="red")
    tab.wait_for_selector("#chat-doing:text('Your turn')")
    assert tab.input_value("#chat-field") == "A thought"
    assert len(talking.world.commands("say")) == 1
    tab.press("#chat-field", "Enter")
    assert talking.said(2)[1]["text"] == "A thought"


# Phrases, and other pages and directions

PHRASES = ["Need onions", "Wait!", "I go to the left", "Please take the dish from the counter in the middle"]


@SIZES
@pytest.mark.parametrize("typing", [True, False])
def test_phrases_are_buttons_that_leave_the_keys_to_the_game(
    talking: TalkingWorld, tab: Any, width: int, height: int, typing: bool
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    talking.chat |= {"phrases": PHRASES, "typing": typing}
    talking.open(tab)
    tell(talking.world, state="playing")
    assert tab.is_visible("#chat-field") is typing
    tab.focus("#screen")
    tab.click("text=Wait!")
    assert [each["text"] for each in talking.said()] == ["Wait!"]
    assert tab.evaluate("document.activeElement.id") == "screen"
    tab.keyboard.press("ArrowLeft")
    talking.world.wait_for({"action": "left", "held": False})
    tab.focus("#chat-phrases button")
    tab.keyboard.press("Enter")
    assert [each["text"] for each in talking.said(2)] == ["Wait!", "Need onions"]
    assert tab.evaluate(FLAWS) == []
    assert tab.evaluate(SIZE) == [width, height]
    shot(tab, f"{width}-chat-phrases-{typing}")


@SIZES
def test_people_talk_while_they_read_a_page_in_the_game(
    talking: TalkingWorld, tab: Any, width: int, height: int
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    world = talking.world
    world.trial |= {"instructions": "rules"}
    world.texts = {"instructions": "<h1>The rules</h1><p>Talk to the other.</p><label>Name <input name=name></label>"}
    world.controls, world.step = {"chat": talking.chat}, 2
    world.ready()
    tab.goto(world.url)
    tab.wait_for_selector("text=Talk to the other.")
    talking.say(lines=[{"n": 1, "by": "ai", "text": "Hello!"}])
    tab.wait_for_selector("#chat >> text=Hello!")
    write(tab, "I still read.")
    assert [each["text"] for each in talking.said()] == ["I still read."]
    assert tab.evaluate(FLAWS) == []
    assert tab.evaluate("document.documentElement.scrollWidth") == width
    shot(tab, f"{width}-chat-reading")


@SIZES
def test_in_hebrew_own_lines_stand_on_the_left(talking: TalkingWorld, tab: Any, width: int, height: int) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    talking.world.more = {"texts": {"language": "he", "writeMessage": "כתיבת הודעה", "sendMessage": "שליחה"}}
    talking.history = [
        {"n": 1, "by": "ai", "text": "שלום! מה שלומך?"},
        {"n": 2, "by": "red", "text": "English, too."},
        {"n": 3, "by": "ai", "text": "Fine (42)."},
    ]
    talking.open(tab)
    tab.wait_for_selector("text=English, too.")
    box = {name: tab.locator(name).first.bounding_box() for name in ("#chat-log", ".line:not(.mine) p", ".mine p")}
    assert box[".mine p"]["x"] - box["#chat-log"]["x"] < 20
    assert box[".line:not(.mine) p"]["x"] > box[".mine p"]["x"] + 20
    directions = tab.eval_on_selector_all(".line p", "all => all.map(each => getComputedStyle(each).direction)")
    assert directions == ["rtl", "ltr", "ltr"]
    assert tab.evaluate(FLAWS) == []
    shot(tab, f"{width}-chat-right-to-left")


KEYBOARD = """height => {
    window.keyboard = (open) => {
        Object.defineProperty(visualViewport, "height", { configurable: true, get: () => innerHeight - (open ? height : 0) });
        visualViewport.dispatchEvent(new Event("resize"));
    };
}"""
"""What a phone's browser says when its keyboard opens: Chromium on a computer has none."""


@pytest.mark.parametrize(("width", "height", "keyboard"), [(360, 640, 290), (740, 360, 200)])
def test_the_keyboard_of_a_phone_does_not_cover_the_field(
    talking: TalkingWorld, chromium: Any, width: int, height: int, keyboard: int
) -> None:
    context = chromium.new_context(viewport={"width": width, "height": height}, has_touch=True, is_mobile=True)
    tab = context.new_page()
    talking.history = [{"n": n, "by": "ai", "text": f"Line {n}"} for n in range(1, 9)]
    talking.open(tab)
    tell(talking.world, state="playing")
    tab.wait_for_selector("#play[data-state=playing]", state="attached")
    shot(tab, f"{width}-chat-no-keyboard")
    assert tab.evaluate(SIZE) == [width, height]
    if width > height:
        tab.evaluate("document.body.classList.add('wide')")
        tab.evaluate("document.body.style.setProperty('--ratio', '1.5')")
        shot(tab, f"{width}-chat-wide")
    tab.evaluate(f"({KEYBOARD})({keyboard})")
    tab.tap("#chat-field")
    tab.evaluate("window.keyboard(true)")
    tab.wait_for_selector("body.types")
    field, newest = tab.locator("#chat-field").bounding_box(), tab.locator(".line p").last.bounding_box()
    for box in (field, newest):
        assert 0 <= box["y"] <= box["y"] + box["height"] <= height - keyboard
    shot(tab, f"{width}-chat-keyboard")
    tab.evaluate("document.activeElement.blur()")
    tab.evaluate("window.keyboard(false)")
    tab.wait_for_selector("body:not(.types)")
    context.close()


# The game is talk


@pytest.fixture
def only_talk(talking: TalkingWorld) -> TalkingWorld:
    world = talking.world
    world.trial = {"game": "talk", "chat": {}, "episodeSeconds": 180, "betweenEpisodes": "offer"}
    world.texts = {
        "betweenEpisodes": "<h2>Your offer</h2><label>Apples <input type=number name=apples min=0 max=9 required></label>"
    }
    world.controls = {"UI": ["start", "reset"], "actionSpace": ["noop"], "maxEpisodes": 3}
    return talking


@SIZES
def test_a_game_of_talk_has_no_picture_and_no_keys(only_talk: TalkingWorld, tab: Any, width: int, height: int) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    only_talk.open(tab)
    shot(tab, f"{width}-talk-ready")
    assert tab.evaluate(SIZE) == [width, height]
    tab.click("#overlay-button")
    only_talk.world.wait_for({"command": "start"})
    tell(only_talk.world, state="playing", timeLeft=179.5)
    tab.wait_for_selector("#overlay", state="hidden")
    assert not tab.is_visible("#screen")
    assert not tab.is_visible("#score")
    assert tab.inner_text("#episode") == "Round 1 of 3"
    tab.wait_for_selector(r"#left:text-matches('3:00|2:5\d')")
    assert tab.inner_text("#controls") == "End this round"
    assert tab.evaluate("document.activeElement.id") == "chat-field", "the participant can write at once"
    tab.keyboard.type("Space and arrows are letters here")
    tab.keyboard.press("Enter")
    until(lambda: only_talk.world.commands("say"))
    assert only_talk.world.commands("action") == []
    only_talk.echo(only_talk.said()[0], 1)
    only_talk.say(
        lines=[
            {"n": 2, "by": "ai", "text": "How many apples do you want? I have nine of them, and you have the bread."}
        ]
    )
    tab.wait_for_selector("text=you have the bread")
    assert tab.evaluate(FLAWS) == []
    assert tab.evaluate(SIZE) == [width, height]
    shot(tab, f"{width}-talk")
    tab.click("text=End this round")
    only_talk.world.wait_for({"command": "reset"})


@SIZES
def test_offers_are_fields_of_the_page_between_two_rounds(
    only_talk: TalkingWorld, tab: Any, width: int, height: int
) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    hold_timers(tab, BETWEEN)
    only_talk.history = [{"n": 1, "by": "ai", "text": "Nine for me."}]
    only_talk.open(tab)
    tab.click("#overlay-button")
    only_talk.world.wait_for({"command": "start"})
    tell(only_talk.world, state="break", episodeScore=0)
    tab.wait_for_selector("#overlay-title:text('Round 1 of 3 is over')")
    assert tab.inner_text("#overlay-score") == ""
    assert tab.inner_text("#announce") == "Round 1 of 3 is over", "what a screen reader says"
    shot(tab, f"{width}-talk-break")
    tab.evaluate("window.letGo()")
    tab.wait_for_selector("text=Your offer")
    assert tab.inner_text("#reading-score").strip() == "Round 1 of 3 is over."
    assert tab.eval_on_selector("#reading", "page => page.offsetWidth") > min(700, width - 60)
    tab.fill("[name=apples]", "4")
    shot(tab, f"{width}-talk-offer")
    assert tab.evaluate(FLAWS) == []
    tab.click("text=Next round")
    only_talk.world.wait_for({"form": {"page": "betweenEpisodes", "fields": {"apples": "4"}}})


def test_who_writes_before_they_press_start_starts_the_round(only_talk: TalkingWorld, tab: Any) -> None:
    only_talk.open(tab)
    write(tab, "Hello?")
    only_talk.world.wait_for({"command": "start"})
    assert only_talk.said()[0]["text"] == "Hello?"
