"""What the participant has chosen, what came of it, and the score can be seen: nothing covers them at the end."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.browser.conftest import hold_timers
from tests.browser.test_phone_browser import box, overflow, phone, phone_context
from tests.browser.test_phone_browser import play as play_on
from tests.browser.world import LAST_PICTURE, World, play, shot, tell

__all__ = ["phone", "phone_context"]  # fixtures
pytestmark = pytest.mark.browser
ALL = ["up", "down", "left", "right", "start", "pause"]
SIZES = [(320, 568), (360, 740), (740, 360), (768, 1024), (1280, 800)]
TIMED_OUT = "Time ran out, so “Defect” was chosen for you."


def apart(page: Any, one: str, other: str) -> bool:
    a, b = box(page, one), box(page, other)
    beside = a["x"] + a["width"] <= b["x"] + 1 or b["x"] + b["width"] <= a["x"] + 1
    return beside or a["y"] + a["height"] <= b["y"] + 1 or b["y"] + b["height"] <= a["y"] + 1


def check_panel(page: Any, size: tuple[int, int]) -> None:
    """Check that the panel covers neither picture nor score, is opaque, shows all its words, and is in the window."""
    assert apart(page, "#overlay", ".stage")
    assert apart(page, "#overlay", "#score")
    assert overflow(page) == [0, 0]
    panel = box(page, "#overlay")
    assert panel["y"] + panel["height"] <= size[1]
    assert page.evaluate(
        "(each => each.scrollHeight <= each.clientHeight && each.scrollWidth <= each.clientWidth)(document.getElementById('overlay'))"
    )
    assert page.evaluate("getComputedStyle(document.getElementById('overlay')).backgroundColor") == "rgb(255, 255, 255)"
    assert page.locator("#controls button:visible").count() == 0


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}")
@pytest.mark.parametrize(
    ("scene", "ui"),
    [({"height": 640}, ALL), ({"height": 1260}, ALL), ({}, ["up", "left", "right", "start"]), ({}, [])],
    ids=["landscape", "portrait", "thumbs", "no buttons"],
)
def test_at_the_end_of_a_game_its_last_picture_and_score_are_seen_whole(
    world: World, phone: Any, size: tuple[int, int], scene: dict[str, Any], ui: list[str]
) -> None:
    hold_timers(phone, LAST_PICTURE)
    play_on(world, phone, size, {"scene": scene}, ui)
    before = box(phone, ".stage")
    tell(world, state="break", nextIn=9)
    phone.wait_for_selector("#overlay-hint:text('The next game starts')")
    check_panel(phone, size)
    name = f"{size[0]}-{scene.get('height', 'low')}-{len(ui)}"
    shot(phone, f"{name}-break")
    tell(world, state="ended")
    phone.wait_for_selector("#overlay-title:text('Saving')")
    check_panel(phone, size)
    world.connections[0].send(json.dumps({"done": True, "score": 21, "episodes": 3}))
    phone.wait_for_selector("#overlay-title:text('The game is over')")
    check_panel(phone, size)
    shot(phone, f"{name}-over")
    assert box(phone, ".stage") == pytest.approx(before), "the picture stays where it is"


@pytest.mark.parametrize("size", [(1280, 800), (1920, 1080), (2560, 1440)], ids=lambda size: f"{size[0]}")
@pytest.mark.parametrize("scene", [{"height": 640}, {"height": 1260}], ids=["landscape", "portrait"])
def test_header_status_picture_and_controls_are_one_grid(
    world: World, tab: Any, size: tuple[int, int], scene: dict[str, Any]
) -> None:
    play_on(world, tab, size, {"scene": scene}, ALL)
    name, progress, status, picture, controls, keys = (
        box(tab, each) for each in (".study", ".progress", ".hud", ".stage", "#controls", "#legend")
    )
    assert name["x"] == pytest.approx(status["x"], abs=1)
    assert progress["x"] + progress["width"] == pytest.approx(controls["x"] + controls["width"], abs=1)
    assert 2 * picture["x"] + picture["width"] == pytest.approx(size[0], abs=2), "the picture is in the middle"
    hands = controls["y"] + keys["y"] + keys["height"]
    assert 2 * picture["y"] + picture["height"] == pytest.approx(hands, abs=2), "controls are beside its middle"
    assert max(picture["width"] / size[0], picture["height"] / size[1]) > 0.6


CHOICES = ["cooperate", "defect"]


@pytest.fixture
def dilemma(world: World) -> World:
    """A game of two with two choices, turn by turn."""
    world.trial = {"pace": "turns", "labels": {"cooperate": "Cooperate", "defect": "Defect"}}
    world.controls = {
        "UI": ["start"], "actionSpace": CHOICES, "labels": world.trial["labels"], "pace": "turns", "toAct": False,
        "player": "left", "players": ["left", "right"],
    }  # fmt: skip
    return world


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}")
def test_choices_are_equally_large_and_a_choice_is_shown(dilemma: World, phone: Any, size: tuple[int, int]) -> None:
    phone.set_viewport_size({"width": size[0], "height": size[1]})
    play(dilemma, phone)
    tell(dilemma, state="playing", toAct=True)
    phone.wait_for_selector("#turn:text('Your turn')")
    one, two = (box(phone, f"[data-action={each}]") for each in CHOICES)
    assert (one["width"], one["height"]) == (two["width"], two["height"])
    column = box(phone, "#controls")
    ends = (one["x"] - column["x"], column["x"] + column["width"] - two["x"] - two["width"])
    assert abs(ends[0] - ends[1]) < 2, "they stand in the middle"
    picture = box(phone, ".stage")
    tell(dilemma, state="playing", toAct=False, chosen="defect")
    phone.wait_for_selector("[data-action=defect][aria-pressed=true]")
    assert phone.locator("[aria-pressed]").count() == 1
    assert box(phone, ".stage") == picture
    shot(phone, f"{size[0]}-chosen")
    tell(dilemma, state="playing", toAct=True, timeUp="defect")
    phone.wait_for_selector(f"#choice:text-is('{TIMED_OUT}')")
    assert phone.inner_text("#announce") == f"{TIMED_OUT} Your turn"
    assert phone.locator("[aria-pressed]").count() == 0
    assert overflow(phone) == [0, 0]
    shot(phone, f"{size[0]}-time-up")
    tell(dilemma, state="break", nextIn=9, toAct=False, timeUp="")
    phone.wait_for_selector("#choice:text-is('Time ran out, so this game has ended.')")
    check_panel(phone, size)
    tell(dilemma, state="playing", toAct=True)
    phone.wait_for_selector("#choice:empty", state="attached")


def test_a_choice_without_a_button_is_said_in_words(dilemma: World, phone: Any) -> None:
    play(dilemma, phone)
    tell(dilemma, state="playing", toAct=False, chosen="doNothing")
    phone.wait_for_selector("#choice:text-is('You chose “Do nothing”.')")


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        ({}, ("Time ran out before you made a choice.")),
        ({"noop": "Stay"}, "Time ran out, so “Stay” was chosen for you."),
    ],
    ids=["no label", "label"],
)
def test_the_idle_action_has_no_name_for_participants_unless_the_study_gives_it_one(
    dilemma: World, phone: Any, labels: dict[str, str], words: str
) -> None:
    dilemma.controls |= {"labels": labels}
    play(dilemma, phone)
    tell(dilemma, state="playing", toAct=True, timeUp="noop")
    phone.wait_for_selector(f"#choice:text-is('{words}')")
    assert phone.inner_text("#announce") == f"{words} Your turn"


def test_who_loses_the_network_at_the_end_stays_in_the_study(world: World, phone: Any) -> None:
    hold_timers(phone, LAST_PICTURE)
    play_on(world, phone, (360, 740), {}, [])
    tell(world, state="ended")
    world.connections[0].send(json.dumps({"done": True, "score": 21, "episodes": 3}))
    phone.wait_for_selector("#overlay-button:text('Continue')")
    phone.context.set_offline(True)
    try:
        phone.click("#overlay-button")
        phone.wait_for_selector("#leave-text:text('No connection')")
        with phone.expect_navigation():
            phone.context.set_offline(False)
    finally:
        phone.context.set_offline(False)
