"""A recording of several players is enough to repeat the game: the environment's steps and the policies' choices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hippodrome.trial.core.history import RecordedTrial
from hippodrome.trial.core.timing import Window
from testing.exploration import examples
from tests.trial import repeated
from tests.trial.repeated import repeat


class Game(repeated.Game):
    """One participant plays `me`."""

    def begin(self, recorded: RecordedTrial | None) -> None:
        self.event("start", self.players, recorded, self.now)
        self.event("connect", "P1", "tab", Window(), self.now)
        self.says("tab", command="start")

    def does(self, what: tuple[str, Any]) -> None:
        name, value = what
        if name == "tick":
            self.tick()
        elif name == "answers":
            self.answers(value)
        else:
            self.says("tab", action=value, **({} if name == "press" else {"held": name == "down"}))


DEEDS = st.one_of(
    st.just(("tick", None)),
    st.tuples(st.just("answers"), st.sampled_from(["it", "dice"])),
    st.tuples(st.sampled_from(["press", "down", "up"]), st.sampled_from(["up", "right"])),
)
SECTIONS = st.fixed_dictionaries(
    {
        "pace": st.sampled_from(["realtime", "turns"]),
        "frameSkip": st.integers(1, 3),
        "input": st.sampled_from(["held", "single"]),
        "idleAction": st.sampled_from(["noop", "down"]),
        "turnEnds": st.sampled_from(["idle", "random"]),
        "turnSeconds": st.just(0.3),
        "policySeconds": st.just(0.2),
    }
)


@settings(max_examples=examples(120))
@given(section=SECTIONS, deeds=st.lists(DEEDS, min_size=30, max_size=90))
def test_a_game_of_several_can_be_repeated_from_its_recording_alone(
    tmp_path_factory: pytest.TempPathFactory, section: dict[str, Any], deeds: list[Any]
) -> None:
    folder = tmp_path_factory.getbasetemp()
    game = Game(folder, section).plays(deeds)
    repeat(folder, game.settings.trial, game.head, game.lines)


@settings(max_examples=examples(80))
@given(section=SECTIONS, before=st.lists(DEEDS, min_size=10, max_size=40), after=st.lists(DEEDS, min_size=20))
def test_a_game_that_another_server_went_on_with_can_be_repeated_from_its_recording(
    tmp_path_factory: pytest.TempPathFactory, section: dict[str, Any], before: list[Any], after: list[Any]
) -> None:
    folder = tmp_path_factory.getbasetemp()
    first = Game(folder, section).plays(before)
    second = Game(folder, section, earlier=first.lines).plays(after)
    played = {line["episode"] for line in first.steps}
    begun = {line["episode"] for line in second.lines if line["kind"] == "reset"}
    assert not played & begun, "no episode begins again"
    repeat(folder, first.settings.trial, first.head, first.lines + second.lines)


def test_a_recording_says_when_each_player_was_terminated_or_truncated(tmp_path: Path) -> None:
    game = Game(tmp_path, {})
    while len(game.steps) < 14:
        game.tick()
    ends = [
        (line["step"], name, key)
        for line in game.steps
        for name, part in line["players"].items()
        for key in ("terminated", "truncated")
        if part.get(key)
    ]
    assert ends == [(6, "it", "terminated"), (9, "me", "truncated"), (14, "dice", "terminated")]
    assert [line["step"] for line in game.steps if line["terminated"]] == [14], "the line itself says it of the episode"
