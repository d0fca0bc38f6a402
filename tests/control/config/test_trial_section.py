"""The `trial` section is checked by one function, when a study is registered and when its servers start."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.config import ConfigErrors, parse_registration, remarks
from hippodrome.control.config.config import Config, StepFiles
from hippodrome.control.config.consistency import check
from hippodrome.protocol import section_keys, trial, trial_check
from hippodrome.protocol.values import Plain
from hippodrome.trial.settings import SettingsError, trial_section

STEPS = [{"key": "1", "page": "game"}, {"key": "2", "page": "bye"}]
NUMBERS = st.sampled_from([-1, 0, 1, 2, 0.5, 30, 90, 240, 241, 600, 601, 10_000, 10_001, 10**6, 10**6 + 1, 10**9])
NAMES = st.lists(st.sampled_from(["up", "Up", " up", "noop", "left", "a" * 64, "a" * 65, "İ" * 64, "ß", 3]), max_size=4)
FLAGS = st.sampled_from([True, False, None, "", "yes", "off", "maybe", 1])
ACTIONS = st.sampled_from(["up", "Up", 3, "", None, {"a": "up"}, {"Esc": "up"}, {"a": {}}])
ODD = st.sampled_from(
    [None, "", "x", " 3 ", "0.5", True, [], {}, ["up"], {"left": True}, float("nan"), float("inf"), 10**400]
)
PLAYERS = st.sampled_from(["player_0", "player_1", "a" * 65])
WHO = st.dictionaries(
    PLAYERS,
    st.sampled_from(
        ["human", "random", "idle", "agent:Partner", "agent:2", "policies/x.onnx", "../x.onnx", "gym://x", "gym://", 3]
    ),
    max_size=3,
)


def by_schema(schema: Mapping[str, Any]) -> st.SearchStrategy[Any] | None:
    """Values for a flag, a number or a word, right and wrong ones; None for another kind of value."""
    match schema:
        case {"type": "boolean"}:
            return FLAGS
        case {"minimum": _}:
            return NUMBERS
        case {"enum": [*words]}:
            return st.sampled_from([*words, "other"])
    return None


KEYS: dict[str, st.SearchStrategy[Any]] = {
    **{
        key.name: values
        for key in section_keys.keys(trial.TrialSection)
        if (values := by_schema(key.schema)) is not None
    },
    trial.RATE_CHANGE_MISSPELT: FLAGS,
    "betweenEpisodes": NUMBERS | st.sampled_from(["pause", "pause.html", "../pause", "game"]),
    "until": st.dictionaries(st.sampled_from(["success", "reached"]), NUMBERS, max_size=2),
    "answers": st.lists(st.sampled_from(["1", "2", "../1", "", 1]), max_size=2),
    "instructions": st.sampled_from(["rules", "rules.html", "a/b", "game", "é", 3]),
    "keys": st.dictionaries(st.sampled_from(["a", "A", "Space", "a+b", "Left", "Tab", "p"]), NAMES.map(str) | ACTIONS),
    "labels": st.dictionaries(st.sampled_from(["up", "Up", "left", ""]), st.sampled_from(["Go", "", 3, "x" * 65])),
    **dict.fromkeys(("minFrameRate", "startingFrameRate", "maxFrameRate"), st.integers(1, 241)),
    "actionSpace": NAMES,
    "substitute": st.sampled_from(["random", "human", "agent:Partner", "../x.onnx", "gym://x", 3]),
    "playerNames": st.dictionaries(PLAYERS, st.sampled_from(["Red", "", 3, "x" * 65]), max_size=2),
    "idleAction": st.sampled_from(["noop", "up", 3, "a" * 65]) | st.dictionaries(PLAYERS, st.just("up"), max_size=2),
    "players": WHO | st.dictionaries(st.sampled_from(["0", "1", "x"]), WHO, max_size=2),
    "ui": st.dictionaries(st.sampled_from(["left", "stop", "fpsUp"]), FLAGS),
    "scene": st.fixed_dictionaries(
        {},
        optional={
            "width": st.integers(0, 9),
            "background": st.sampled_from(["#FFF", "#00FF00"]),
            "coordinates": st.sampled_from(["relative", "pixels", "world"]),
            "pixelArt": FLAGS,
            "assets": st.sampled_from(["assets", "./images/", "../other"]),
        },
    ),
    "llm": st.fixed_dictionaries(
        {},
        optional={
            "url": st.sampled_from(
                ["https://x.example/v1/", "http://x.example", "http://127.0.0.1:1/v1", "x", "https://a:b@x.example"]
            ),
            "model": st.sampled_from(["small", "", 3])
            | st.lists(st.sampled_from(["small", "", "a" * 201]), max_size=2),
            "system": st.sampled_from(["Be\nkind", "prompts/a.txt", "../a.txt", "/a.md", "", "\x00", "a" * 2001, 3]),
            "parameters": st.sampled_from([{"temperature": 0.5}, {}, [], "x"]),
            "maxCalls": NUMBERS,
            "maxTokens": NUMBERS,
            "seconds": NUMBERS,
            "fallback": st.sampled_from(["Sorry", "", "a" * 501]),
            "record": st.sampled_from(["requests", "hashes", "all"]),
            "price": st.sampled_from([{"input": 1, "output": 0.5}, {"input": 1}, {"input": -1, "output": 1}, 3]),
        },
    ),
    "chat": FLAGS
    | st.fixed_dictionaries(
        {},
        optional={
            "with": st.lists(st.sampled_from(["ai", "player_0", "", 3]), max_size=2),
            "maxLength": st.sampled_from([0, 1, 1000, 1001]),
            "typing": FLAGS,
            "phrases": NAMES,
            "first": st.sampled_from(["ai", "player_0", "x", 3]),
            "names": st.dictionaries(PLAYERS, st.sampled_from(["Red", "", 3, "x" * 65]), max_size=2),
        },
    ),
    "options": st.dictionaries(st.sampled_from(["a", "b"]), st.integers() | st.text(max_size=3)),
}
SECTIONS = st.fixed_dictionaries({"game": st.just("x/Y-v0")}, optional={key: each | ODD for key, each in KEYS.items()})


def registered(section: dict[str, Any]) -> dict[str, Any] | list[str]:
    """Return the section that the study's servers get after registration, or the list of problems."""
    try:
        return dict(parse_registration({"id": "p", "steps": STEPS, "trial": section})["trial"])
    except ConfigErrors as errors:
        return [f"{problem.where}: {problem.message}" for problem in errors.diagnostics]


def started(section: dict[str, Any]) -> trial.TrialSection | str:
    """Return the settings that a server reads from it, or the first problem."""
    try:
        return trial_section(section)
    except SettingsError as error:
        return str(error)


def test_these_tests_try_every_key() -> None:
    assert set(KEYS) | {"game"} == section_keys.names(trial.TrialSection) | {trial.RATE_CHANGE_MISSPELT}


@given(SECTIONS)
def test_registration_and_server_read_the_same_from_a_section(section: dict[str, Any]) -> None:
    told, made = registered(section), started(section)
    if isinstance(told, list):
        assert made == told[0] or told[0].startswith("trial.answers item"), "a server does not know the steps"
    else:
        assert started(told) == made
        assert registered(told) == told


@given(SECTIONS)
def test_a_wrong_value_is_replaced_by_its_default(section: dict[str, Any]) -> None:
    found, problems = trial_check.check(section)
    wrong = {str(problem.path[0]) for problem in problems if not problem.compared}
    defaults = trial.TrialSection().document()
    document = found.document()
    assert {key: document[key] for key in wrong - {trial.RATE_CHANGE_MISSPELT}} == {
        key: defaults[key] for key in wrong - {trial.RATE_CHANGE_MISSPELT}
    }


def test_registration_and_server_refuse_a_rate_beyond_a_default() -> None:
    expected = "trial.minFrameRate: must be at most startingFrameRate, which is 30 by default, not 50; set startingFrameRate too"
    assert registered({"game": "x/Y-v0", "minFrameRate": 50}) == [expected]
    assert started({"minFrameRate": 50}) == expected


def test_registration_and_server_refuse_both_spellings_at_once() -> None:
    section = {"game": "x/Y-v0", trial.RATE_CHANGE: True, trial.RATE_CHANGE_MISSPELT: False}
    expected = "trial.allowFramRateChange: allowFrameRateChange is given too; keep that one"
    assert registered(section) == [expected]
    assert started(section) == expected


def test_registration_and_server_read_an_action_that_is_a_number_as_a_name() -> None:
    told = registered({"game": "x/Y-v0", "actionSpace": [0, "1"]})
    assert isinstance(told, dict)
    assert told["actionSpace"] == ["0", "1"]
    made = started({"actionSpace": [0, "1"]})
    assert isinstance(made, trial.TrialSection)
    assert made.action_space == ("0", "1")


def test_a_number_that_names_an_action_is_the_same_text_in_every_key() -> None:
    one = Plain(1, "01")  # as YAML reads 01
    found, problems = trial_check.check(
        {"actionSpace": [Plain(0, "00"), one], "idleAction": one, "keys": {"a": one}, "labels": {"01": "Go"}}
    )
    assert not problems
    assert (found.action_space[1], found.idle_action, found.keys, found.labels) == (
        "01",
        "01",
        {"a": "01"},
        {"01": "Go"},
    )


@pytest.mark.parametrize("section", ["x", [1], 3, True])
def test_a_section_that_is_no_map_is_one_problem(section: object) -> None:
    found, problems = trial_check.check(section)
    assert found == trial.TrialSection()
    assert [problem.path for problem in problems] == [()]


def test_a_policy_time_of_zero_seconds_is_a_mistake() -> None:
    (problem,) = trial_check.check({"policySeconds": 0})[1]
    assert problem.path == ("policySeconds",)


@pytest.mark.parametrize(("seconds", "fits"), [(-0.5, False), (0, True), (600, True), (600.5, False)])
def test_a_break_has_0_to_600_seconds_both_included(seconds: float, fits: bool) -> None:
    told, made = registered({"game": "x/Y-v0", "betweenEpisodes": seconds}), started({"betweenEpisodes": seconds})
    assert isinstance(told, dict) == isinstance(made, trial.TrialSection) == fits
    if fits:
        assert (told["betweenEpisodes"], made.between_episodes) == (seconds, seconds)


@pytest.mark.parametrize("value", [True, [], {}, float("nan"), None])
def test_a_wrong_length_of_a_break_gets_a_message_and_an_empty_one_is_the_default(value: Any) -> None:
    if value is None:
        assert trial_section({"betweenEpisodes": value}).between_episodes == 3
        return
    with pytest.raises(
        SettingsError,
        match=r"trial.betweenEpisodes: must be a number from 0 to 600, not .*; or the name of a file in the steps folder",
    ):
        trial_section({"betweenEpisodes": value})


# ---- the action that is taken while no key is pressed


def idle_remark(*actions: str, **trial: Any) -> str | None:
    tree = {
        "project": {"id": "p", "steps": {"1": "hello", "2": "game", "finalStep": "bye"}},
        "trial": {"game": "x/Y-v0", "actionSpace": list(actions), **trial},
    }
    checked = check(tree)
    assert checked.mistakes == []
    steps = [StepFiles(key, page) for key, page in checked.project.steps.items()]
    found = remarks.without_a_key(Config.of(checked, steps))
    return None if found is None else found.message


def test_an_action_that_is_taken_while_no_key_is_pressed_is_named() -> None:
    text = idle_remark("left", "right", startingFrameRate=50)
    assert text is not None
    assert text.startswith('while no key is pressed, the game takes "left", 50 times a second')
    assert "name it as idleAction" in text


def test_an_action_that_looks_idle_is_proposed_as_idle_action() -> None:
    text = idle_remark("left", "right", "stay")
    assert text is not None
    assert "write idleAction: stay, and that is taken instead" in text


@pytest.mark.parametrize("given", [{"idleAction": "left"}, {"pace": "turns"}])
def test_a_study_that_sets_the_idle_behaviour_gets_no_remark(given: dict[str, Any]) -> None:
    assert idle_remark("left", "right", **given) is None


@pytest.mark.parametrize("actions", [(), ("noop", "left"), ("left", "NOOP"), ("nothing", "left")])
def test_games_whose_first_action_is_idle_get_no_remark(actions: tuple[str, ...]) -> None:
    assert idle_remark(*actions) is None
