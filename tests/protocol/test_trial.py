"""The section `trial`: what its values mean together, and the rules between its keys."""

from __future__ import annotations

import math
from typing import Any

import pytest

from hippodrome.protocol.trial import SESSION_KEYS, TrialSection
from hippodrome.protocol.trial_check import check
from hippodrome.protocol.trial_sections import MAX_OWN_CONTROLS
from hippodrome.protocol.values import path_text

PLAYERS = {"red": "human", "blue": "policies/blue.onnx", "green": "human"}
BY_GROUP = {"1": {"red": "human", "blue": "sample:policies/a.onnx"}, "2": {"red": "random", "blue": "human"}}


def accepted(**section: Any) -> TrialSection:
    found, problems = check(section)
    assert problems == []
    return found


def problems_of(**section: Any) -> list[str]:
    return [f"{path_text(path)}: {sentence}" for path, sentence, _ in check(section)[1]]


def test_an_episode_has_as_many_steps_as_the_smaller_of_its_two_limits_allows() -> None:
    assert accepted().most_steps == math.inf
    assert accepted(maxSteps=50).most_steps == 50
    assert accepted(episodeSeconds=2).most_steps == 60
    assert accepted(episodeSeconds=0.01).most_steps == 1
    assert accepted(episodeSeconds=2, maxSteps=50).most_steps == 50
    assert accepted(episodeSeconds=1, startingFrameRate=10, maxSteps=50).most_steps == 10


def test_a_break_has_seconds_or_a_page() -> None:
    assert [accepted(betweenEpisodes=given).between_seconds for given in (0, "2.5", "pause")] == [0, 2.5, math.inf]
    assert accepted(betweenEpisodes=2).pages == {}
    assert accepted(betweenEpisodes="pause", instructions="rules.html").pages == {
        "instructions": "rules",
        "betweenEpisodes": "pause",
    }
    either = "must be a number from 0 to 600, not {}; or the name of a file in the steps folder"
    assert problems_of(betweenEpisodes=601) == [f"betweenEpisodes: {either.format(601)}"]
    assert problems_of(betweenEpisodes=" ") == [f"betweenEpisodes: {either.format(chr(34) + ' ' + chr(34))}"]
    assert problems_of(betweenEpisodes="game") == ["betweenEpisodes: a page cannot be called game.html; rename it"]


def test_one_map_says_who_plays_in_all_groups() -> None:
    section = accepted(players=PLAYERS)
    assert section.players_of(None) == section.players_of(7) == PLAYERS
    assert section.groups() == ()
    assert section.named_players() == ("red", "blue", "green")
    assert list(section.humans()) == [((), ["red", "green"])]
    assert list(section.policy_files()) == [(("players", "blue"), "policies/blue.onnx")]


def test_a_map_for_each_group_says_who_plays_in_it() -> None:
    section = accepted(players=BY_GROUP, substitute="policies/b.onnx")
    assert section.players_of(2) == BY_GROUP["2"]
    assert section.players_of(None) == section.players_of(1) == BY_GROUP["1"]
    assert section.players_of(3) == {}
    assert section.groups() == (1, 2)
    assert section.named_players() == ("red", "blue")
    assert list(section.humans()) == [(("1",), ["red"]), (("2",), ["blue"])]
    assert list(section.policy_files()) == [
        (("players", "1", "blue"), "policies/a.onnx"),
        (("substitute",), "policies/b.onnx"),
    ]


def test_without_players_the_environment_says_who_plays() -> None:
    section = accepted()
    assert (section.players_of(None), section.groups(), section.named_players()) == ({}, (), ())
    assert list(section.humans()) == [((), [])]
    assert list(section.policy_files()) == []


def test_a_registration_leaves_out_what_only_games_of_several_need_if_it_has_its_default_value() -> None:
    assert accepted().registered() == {
        key: value for key, value in accepted().document().items() if key not in (*SESSION_KEYS, "chat", "llm")
    }
    given = {"substitute": "random", "absent": 31, "gather": 121, "afterAbsent": "policy", "countdown": 4}
    given |= {"maxPing": 1, "pingSamples": 6, "playerNames": {"red": "The red one"}}
    assert set(given) == set(SESSION_KEYS)
    registered = accepted(**given).registered()
    assert {key: registered[key] for key in given} == given
    assert set(registered) == set(accepted().document()) - {"chat", "llm"}


# Controls


def test_a_section_of_controls_shows_those_that_it_names_and_an_empty_one_shows_the_default_ones() -> None:
    assert accepted(ui={"left": True, "stop": "yes", "up": False, "wait": True, "more": None}).ui.shown() == (
        "left",
        "stop",
        "wait",
    )
    assert accepted(ui={}).ui == accepted().ui == TrialSection().ui
    assert accepted().ui.shown() == ("left", "right", "up", "down", "start", "pause")
    assert accepted(ui={"left": False}).ui.shown() == ()


@pytest.mark.parametrize("word", ["toggle", "faster", "slower", "requestUI"])
def test_a_control_cannot_have_the_name_of_a_word_that_the_server_knows(word: str) -> None:
    said = "the game's server knows this word already; give the control another name"
    assert problems_of(ui={word: True}) == [f"ui.{word}: {said}"]
    assert accepted(ui={word: False}).ui.own == ()


def test_a_wrong_control_is_reported_and_the_section_takes_its_default() -> None:
    found, problems = check({"ui": {"wait": "perhaps", "x" * 65: True, "left": 3, "more": True}})
    assert [path_text(problem.path) for problem in problems] == ["ui.left", "ui.wait", f"ui.{'x' * 59}…"]
    assert found.ui == TrialSection().ui


def test_a_section_has_at_most_32_controls_of_its_own() -> None:
    assert MAX_OWN_CONTROLS == 32
    names = [f"word{number}" for number in range(33)]
    assert accepted(ui=dict.fromkeys(names[:32], True)).ui.own == tuple(names[:32])
    many = {**dict.fromkeys(names, True), "wait": "perhaps"}
    assert problems_of(ui=many) == [
        "ui: must have at most 32 controls of your own, not 33",
        'ui.wait: must be true or false, not "perhaps"',
    ]


# Sections and lists


def test_a_mistake_in_a_section_or_a_list_has_its_place() -> None:
    assert problems_of(actionSpace=["up", [], "down", {}], scene={"width": 0, "height": 5}) == [
        "actionSpace item 2: must be the name of an action, not a list",
        "actionSpace item 4: must be the name of an action, not a map",
        "scene.width: must be a whole number from 1 to 4096, not 0",
    ]
    assert accepted(actionSpace=["up", 3]).action_space == ("up", "3")
    many = [f"a{number}" for number in range(1001)]
    assert accepted(actionSpace=many[:1000]).action_space == tuple(many[:1000])
    assert problems_of(actionSpace=many) == ["actionSpace: must have at most 1000 items, not 1001"]
    scene = accepted(scene={"height": 5}).scene
    assert scene is not None
    assert (scene.width, scene.height) == (600, 5)
    assert problems_of(scene=[]) == [
        'scene: must be a section: indented lines such as "width: 600" below it, not a list'
    ]


def test_the_key_whose_spelling_differs_in_hippos_documentation_counts_in_both() -> None:
    assert accepted(allowFramRateChange="yes").allow_frame_rate_change
    assert accepted(allowFrameRateChange="", allowFramRateChange="yes").allow_frame_rate_change
    found, problems = check({"allowFrameRateChange": "yes", "allowFramRateChange": "no"})
    assert found.allow_frame_rate_change
    assert [problem.path for problem in problems] == [("allowFramRateChange",)]


@pytest.mark.parametrize("section", [None, "", {}])
def test_an_empty_section_has_the_default_values(section: object) -> None:
    assert check(section) == (TrialSection(), [])


# Rules


@pytest.mark.parametrize(
    ("section", "problems"),
    [
        ({"minFrameRate": 40, "maxFrameRate": 40, "startingFrameRate": 40}, []),
        (
            {"minFrameRate": 40, "maxFrameRate": 40},
            ["minFrameRate: must be at most startingFrameRate, which is 30 by default, not 40; set startingFrameRate too"],
        ),
        (
            {"minFrameRate": 50, "startingFrameRate": 40},
            ["startingFrameRate: must be at least minFrameRate, which is 50, not 40"],
        ),
        ({"minFrameRate": 20, "maxFrameRate": 10}, ["minFrameRate: must be at most maxFrameRate, which is 10, not 20"]),
        (
            {"minFrameRate": 95},
            ["minFrameRate: must be at most maxFrameRate, which is 90 by default, not 95; set maxFrameRate too"],
        ),
        ({"actionSpace": ["up", "Up", "down", "UP"]}, [
            'actionSpace item 2: "Up" is item 1 already; names must differ',
            'actionSpace item 4: "UP" is item 1 already; names must differ',
        ]),
        ({"actionSpace": ["up"], "keys": {"a": "UP"}, "labels": {"Up": "Go"}}, []),
        ({"players": PLAYERS, "playerNames": {"red": "R"}, "keys": {"red": {"a": "up"}}}, []),
        ({"playerNames": {"pink": "P"}}, []),
        (
            {"players": PLAYERS, "playerNames": {"pink": "P", "red": "R"}, "keys": {"pink": {"a": "up"}}},
            [
                f"{key}.pink: there is no such player in players; there are red, blue, green"
                for key in ("keys", "playerNames")
            ],
        ),
        ({"players": {"red": "human", "blue": "gym://x"}, "gym": "advise"}, []),
        (
            {"players": {"red": "human", "blue": "gym://x", "green": "gym://y"}},
            ["players: blue is gym://x: write gym: advise too"],
        ),
        (
            {"players": {"1": {"red": "human"}, "2": {"red": "human", "blue": "gym://x"}}, "gym": "watch"},
            ["players: blue is gym://x: write gym: advise too"],
        ),
        ({"afterAbsent": "policy", "substitute": "random"}, []),
        ({"afterAbsent": "end"}, []),
        (
            {"afterAbsent": "policy"},
            [
                "substitute: missing; afterAbsent: policy needs a policy that takes the place, such as substitute: "
                "random"
            ],
        ),
    ],
)  # fmt: skip
def test_values_that_do_not_fit_each_other_are_reported(section: dict[str, Any], problems: list[str]) -> None:
    assert problems_of(**section) == problems


@pytest.mark.parametrize(
    ("section", "wrong"),
    [
        ({"minFrameRate": 300, "startingFrameRate": 200}, ["minFrameRate", "startingFrameRate"]),
        ({"maxFrameRate": 300, "startingFrameRate": 200}, ["maxFrameRate"]),
        ({"startingFrameRate": 0, "minFrameRate": 50}, ["startingFrameRate"]),
        ({"minFrameRate": 300, "maxFrameRate": 20}, ["minFrameRate", "maxFrameRate"]),
        ({"actionSpace": ["up", "up", []]}, ["actionSpace item 3"]),
        ({"actionSpace": ["up", []], "keys": {"a": "down"}, "labels": {"down": "D"}}, ["actionSpace item 2"]),
        ({"actionSpace": ["up"], "keys": {"a": "down", "Foo": "up"}}, ["keys.Foo"]),
        ({"actionSpace": ["up"], "labels": {"down": "D", "up": []}}, ["labels.up"]),
        ({"players": PLAYERS, "playerNames": {"pink": "P", "red": []}}, ["playerNames.red"]),
        ({"players": {"red": "human", "blue": "gym://x"}, "gym": "play"}, ["gym"]),
        ({"afterAbsent": "policy", "substitute": "../x.onnx"}, ["substitute"]),
    ],
)
def test_values_are_compared_only_if_each_is_right_by_itself(section: dict[str, Any], wrong: list[str]) -> None:
    assert [problem.partition(":")[0] for problem in problems_of(**section)] == wrong
