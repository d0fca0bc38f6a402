"""Keys of the keyboard, as config.yml names them."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.protocol import keyboard, trial, trial_check


def accepted(**section: Any) -> trial.TrialSection:
    checked, problems = trial_check.check(section)
    assert problems == []
    return checked


def problems_of(**section: Any) -> list[str]:
    _, problems = trial_check.check(section)
    return [f"{trial.values.path_text(problem.path)}: {problem.sentence}" for problem in problems]


@pytest.mark.parametrize(
    ("written", "key"),
    [
        ("ArrowLeft", "ArrowLeft"),
        ("Space", " "),
        (" ", " "),
        ("A", "a"),
        ("1", "1"),
        ("+", "+"),
        ("ArrowLeft+ArrowUp", "ArrowLeft+ArrowUp"),
        ("ArrowLeft + Space", "ArrowLeft+ "),
        ("a++", "a++"),
        ("a+ ", "a+ "),
        ("++a", "++a"),
        ("a+++b", "a+++b"),
        (" + ", "+"),
        ("  ", " "),
        ("ß", "ß"),
    ],
)
def test_a_key_is_called_as_the_browser_calls_it(written: str, key: str) -> None:
    assert keyboard.combination(written) == key
    assert keyboard.combination(key) == key


def test_a_combination_is_split_into_its_keys() -> None:
    assert keyboard.parts("ArrowLeft+ ") == ("ArrowLeft", " ")
    assert keyboard.parts("a++") == ("a", "+")
    assert keyboard.parts("++ ") == ("+", " ")


@pytest.mark.parametrize(
    ("written", "why"),
    [
        ("Left", 'there is no key "Left"; did you mean ArrowLeft?'),
        ("arrowleft", 'there is no key "arrowleft"; did you mean ArrowLeft?'),
        ("KeyW", 'there is no key "KeyW"; did you mean w?'),
        ("Digit1", 'there is no key "Digit1"; did you mean 1?'),
        ("Spacebar", 'there is no key "Spacebar"; did you mean Space?'),
        ("Foo", 'there is no key "Foo"; names are those of KeyboardEvent.key: ArrowLeft, a, Space'),
        ("Tab", "Tab cannot be a key of the game: it moves the focus to the next button, which people without a mouse need"),
        ("F5", "F5 cannot be a key of the game: browsers have commands of their own for it"),
        ("esc", "Escape cannot be a key of the game: browsers leave the full screen with it"),
        ("ArrowLeft+Ctrl", "Control cannot be a key of the game: browsers take it for their own commands"),
        ("a+A", "names the same key twice; write it once"),
        *((text, "has a + that joins nothing; a++ is a and + together, and + alone is the key +") for text in ("a+", "+a", "++", "a++b", "a + ", " + a")),
        ("", "names no key; write Space for the space key"),
        ("a+b+c+d+e", "joins 5 keys; 4 at most, since few keyboards report more at once"),
    ],
)  # fmt: skip
def test_a_wrong_key_gets_a_sentence_with_the_reason_or_the_right_name(written: str, why: str) -> None:
    assert problems_of(keys={written: "left"}) == [f"keys.{written}: {why}"]


@given(st.text(max_size=12))
def test_any_text_is_a_combination_or_a_sentence(text: str) -> None:
    try:
        once = keyboard.combination(text)
    except ValueError as error:
        assert str(error)
    else:
        assert keyboard.combination(once) == once


def test_keys_are_for_all_players_or_by_player() -> None:
    for_all = accepted(keys={"ArrowLeft": "Left", "a": "left", "ArrowLeft+ArrowUp": "leftup"})
    assert for_all.keys_of("player_1") == {"ArrowLeft": "left", "a": "left", "ArrowLeft+ArrowUp": "leftup"}
    by_player = accepted(keys={"player_0": {"a": "left"}, "player_1": {"Space": 1}})
    assert [by_player.keys_of(f"player_{number}") for number in range(3)] == [{"a": "left"}, {" ": "1"}, {}]


def test_a_player_has_no_label_of_an_action_that_only_keys_of_others_take() -> None:
    labels = {"left": "Go left", "say": "Warm!", "both": "Wait", "touch": "No key"}
    by_player = accepted(
        labels=labels, keys={"seeker": {"a": "left", "w": "both"}, "knower": {"h": "say", "w": "both"}}
    )
    assert list(by_player.labels_of("seeker")) == ["left", "both", "touch"]
    assert list(by_player.labels_of("knower")) == ["say", "both", "touch"]
    assert accepted(labels=labels, keys={"a": "left"}).labels_of("seeker") == labels
    assert accepted(labels=labels).labels_of("seeker") == labels


def test_two_names_of_one_combination_are_refused() -> None:
    assert problems_of(keys={"a+b": "left", "b+A": "right"}) == ["keys.b+A: is the same as a+b; keep one of them"]
    assert problems_of(keys={"Space": "left", " ": "right"}) == ["keys. : is the same as Space; keep one of them"]


def test_keys_and_labels_of_actions_that_do_not_exist_are_reported() -> None:
    assert problems_of(actionSpace=["left", "right"], keys={"a": "lef", "b": "Right"}, labels={"up": "Up"}) == [
        'keys.a: there is no action "lef" in actionSpace; did you mean left?',
        'labels.up: there is no action "up" in actionSpace; the actions are left, right',
    ]
    assert problems_of(actionSpace=["left"], keys={"p": {"a": "down"}}) == [
        'keys.p.a: there is no action "down" in actionSpace; the actions are left'
    ]
    assert problems_of(keys={"a": "anything"}) == []  # the environment may name its actions itself


def test_keys_of_players_that_do_not_exist_are_reported() -> None:
    players = {"player_0": "human", "player_1": "random"}
    assert problems_of(players=players, keys={"player_0": {"a": "left"}, "player_2": {"b": "left"}}) == [
        "keys.player_2: there is no such player in players; there are player_0, player_1"
    ]
    assert problems_of(keys={"player_2": {"b": "left"}}) == []  # the environment says which players there are


def test_keys_must_be_a_map_to_names_of_actions() -> None:
    assert problems_of(keys=["a"]) == [
        'keys: must be a section: indented lines such as "ArrowLeft: left" below it, not a list'
    ]
    assert problems_of(keys={"a": "left", "player_1": {"a": "left"}})[-1] == (
        "keys.player_1: must be the name of an action, not a map"
    )
    many = {chr(0x4E00 + number): "left" for number in range(101)}
    assert problems_of(keys=many) == ["keys: must have at most 100 lines, not 101"]
    assert problems_of(keys=dict(list(many.items())[1:])) == []


def test_of_keys_and_labels_the_valid_ones_are_kept_and_the_others_reported() -> None:
    checked, problems = trial_check.check(
        {
            "keys": {"red": {"Foo": "left", "a": [], "b": "left"}, "blue": {"Tab": "left"}},
            "labels": {"left": [], "": "Go", "right": "Go right"},
            "playerNames": {"red": {}, "blue": "The blue one"},
        }
    )
    assert [problem.path for problem in problems] == [
        ("keys", "red", "Foo"),
        ("keys", "red", "a"),
        ("keys", "blue", "Tab"),
        ("labels", "left"),
        ("labels", ""),
        ("playerNames", "red"),
    ]
    assert (checked.keys, checked.labels, checked.player_names) == ({}, {}, {})
    found = [keyboard.actions_of_keys({"Foo": "left", "a": [], "b": "left"}, ())[0]]
    found += [keyboard.labels({"left": [], "": "Go", "right": "Go right"}, ())[0]]
    found += [keyboard.player_names({"red": {}, "blue": "The blue one"}, ())[0]]
    assert found == [{"b": "left"}, {"right": "Go right"}, {"blue": "The blue one"}]


def test_a_page_of_the_game_is_a_file_in_the_steps_folder() -> None:
    checked = accepted(instructions="rules.html", betweenEpisodes="pause")
    assert checked.pages == {"instructions": "rules", "betweenEpisodes": "pause"}
    assert checked.between_seconds == float("inf")
    assert accepted(betweenEpisodes="2.5").between_seconds == 2.5
    where = "must be the name of a file in the steps folder, without folders"
    assert problems_of(instructions="../rules", betweenEpisodes="a/b") == [
        f'betweenEpisodes: {where}, not "a/b"',
        f'instructions: {where}, not "../rules"',
    ]
    assert problems_of(instructions="game") == ["instructions: a page cannot be called game.html; rename it"]
