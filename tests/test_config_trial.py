"""The `trial` section is checked twice, when a study is registered and when its servers start: both must agree."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.config import ConfigErrors, parse_registration, remarks
from hippodrome.config.checks import check
from hippodrome.config.project import Config, StepFiles
from trial.settings import SettingsError, TrialConfig

STEPS = [{"key": "1", "page": "game"}, {"key": "2", "page": "bye"}]
NUMBERS = st.sampled_from([-1, 0, 1, 2, 0.5, 30, 90, 240, 241, 600, 601, 10_000, 10_001, 10**6, 10**6 + 1, 10**9])
NAMES = st.lists(st.sampled_from(["up", "Up", " up", "noop", "left", "a" * 64, "a" * 65, "İ" * 64, "ß"]), max_size=4)
KEYS: dict[str, st.SearchStrategy[Any]] = {
    **dict.fromkeys(("maxEpisodes", "actionBufferLifespan", "betweenEpisodes", "frameRateStepSize"), NUMBERS),
    **dict.fromkeys(("minFrameRate", "startingFrameRate", "maxFrameRate"), st.integers(1, 241)),
    "actionSpace": NAMES,
    "dataFile": st.sampled_from(["episode", "trial", "both"]),
    "s3upload": st.booleans(),
    "ui": st.dictionaries(st.sampled_from(["left", "stop", "fpsUp"]), st.booleans()),
}
SECTIONS = st.fixed_dictionaries({"game": st.just("x/Y-v0"), **KEYS})


def registered(section: dict[str, Any]) -> dict[str, Any] | None:
    """What the servers of a study with this section are told; None if it is not accepted."""
    try:
        return dict(parse_registration({"id": "p", "steps": STEPS, "trial": section})["trial"])
    except ConfigErrors:
        return None


@given(SECTIONS, st.sets(st.sampled_from(sorted(KEYS)), min_size=1, max_size=2))
def test_what_is_registered_can_be_started(section: dict[str, Any], kept: set[str]) -> None:
    told = registered({key: value for key, value in section.items() if key in kept | {"game"}})
    if told is not None:
        TrialConfig.from_mapping(told)


@given(
    st.sampled_from(["maxEpisodes", "actionBufferLifespan", "betweenEpisodes", "frameRateStepSize", "actionSpace"]),
    NUMBERS,
    NAMES,
)
def test_each_value_is_refused_at_both_ends_or_at_none(key: str, number: float, names: list[str]) -> None:
    section = {"game": "x/Y-v0", key: names if key == "actionSpace" else number}
    try:
        TrialConfig.from_mapping(section)
        started = True
    except SettingsError as error:
        assert f"trial.{key} " in str(error)
        started = False
    assert (registered(section) is not None) == started


@pytest.mark.parametrize("value", ["x", True, [], {}, float("nan"), None])
def test_a_break_of_no_length_is_named(value: Any) -> None:
    if value is None:
        assert TrialConfig.from_mapping({"betweenEpisodes": value}).between_episodes == 3
        return
    with pytest.raises(SettingsError, match=r"trial.betweenEpisodes must be a number from 0 to 600"):
        TrialConfig.from_mapping({"betweenEpisodes": value})


# ---- what happens while no key is pressed


def said(*actions: str, **trial: Any) -> str | None:
    tree = {
        "project": {"id": "p", "steps": {"1": "hello", "2": "game", "finalStep": "bye"}},
        "trial": {"game": "x/Y-v0", "actionSpace": list(actions), **trial},
    }
    checked = check(tree)
    assert checked.findings == []
    steps = [StepFiles(key, page) for key, page in checked.root.project.steps.items()]
    found = remarks.without_a_key(Config.of(checked, steps))
    return None if found is None else found.message


def test_an_action_that_is_taken_without_a_key_is_named() -> None:
    text = said("left", "right", startingFrameRate=50)
    assert text is not None
    assert text.startswith('while no key is pressed, the game takes "left", 50 times a second')
    assert "noop" in text


def test_an_idle_action_of_another_name_is_proposed() -> None:
    text = said("left", "right", "stay")
    assert text is not None
    assert 'call the action "stay" noop' in text


@pytest.mark.parametrize("actions", [(), ("noop", "left"), ("left", "NOOP"), ("nothing", "left")])
def test_games_that_stand_still_without_a_key_are_not_remarked(actions: tuple[str, ...]) -> None:
    assert said(*actions) is None
