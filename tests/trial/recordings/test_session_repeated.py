"""A session's recording is enough to repeat the game, also where a policy played for a participant who was away."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hippodrome.protocol.session import Member
from hippodrome.trial.core.effects import ResetPolicy
from hippodrome.trial.core.history import RecordedTrial
from hippodrome.trial.core.timing import Window
from hippodrome.trial.settings import TrialSettings
from testing.exploration import examples
from tests.trial import repeated
from tests.trial.repeated import repeat

PLACES = {"P1": "me", "P2": "it"}


class Game(repeated.Game):
    """Two members play `me` and `it`; a policy plays for a member who is away for half a second."""

    PLAYS: ClassVar[Mapping[str, str]] = {"me": "human", "it": "human", "dice": "random"}
    SECTION: ClassVar[Mapping[str, Any]] = {
        **repeated.Game.SECTION, "maxEpisodes": 3, "substitute": "agent:Partner", "afterAbsent": "policy",
        "absent": 0.5, "countdown": 0.2, "ui": dict.fromkeys(("start", "pause", "reset", "up", "right", "good"), True),
    }  # fmt: skip

    def make_settings(self, section: Mapping[str, Any]) -> TrialSettings:
        members = tuple(Member(human, None, seat) for seat, human in enumerate(PLACES))
        return replace(repeated.settings_of(section, SESSION="s." + "0" * 20), members=members, players=2)

    def begin(self, recorded: RecordedTrial | None) -> None:
        start = self.trial.start
        self.trial.start = lambda *args: start(*args, places=PLACES)
        self.event("start", self.players, recorded, self.now)
        for human in PLACES:
            self.does(("comes", human))

    def does(self, what: tuple[str, Any]) -> None:
        name, value = what
        if name == "comes":
            self.event("connect", value, value, Window(), self.now)
        elif name == "goes":
            self.event("disconnect", value, self.now)
        elif name == "answers":
            self.answers(value)
        elif name == "tick":
            for _ in range(value):
                self.tick()
        else:
            human, message = value
            self.says(human, **message)


HUMANS = st.sampled_from(list(PLACES))
SAID = st.sampled_from(
    [{"action": "up", "held": True}, {"action": "up", "held": False}, {"action": "right"}, {"command": "reset"}]
)
DEEDS = st.one_of(
    st.tuples(st.just("tick"), st.integers(1, 8)),
    st.tuples(st.just("tick"), st.integers(1, 8)),
    st.tuples(st.just("answers"), st.sampled_from(["me", "it", "dice"])),
    st.tuples(st.sampled_from(["goes", "comes"]), HUMANS),
    st.tuples(st.just("says"), st.tuples(HUMANS, SAID)),
)
SECTIONS = st.fixed_dictionaries({"pace": st.sampled_from(["realtime", "turns"]), "frameSkip": st.integers(1, 3),
                                  "turnSeconds": st.just(0.3), "policySeconds": st.just(0.2)})  # fmt: skip


@settings(max_examples=examples(60))
@given(section=SECTIONS, before=st.lists(DEEDS, min_size=20, max_size=60), after=st.lists(DEEDS, max_size=40))
def test_a_sessions_game_can_be_repeated_from_its_recording_alone_also_on_two_servers(
    tmp_path_factory: pytest.TempPathFactory, section: dict[str, Any], before: list[Any], after: list[Any]
) -> None:
    folder = tmp_path_factory.getbasetemp()
    first = Game(folder, section).plays(before)
    repeat(folder, first.settings.trial, first.head, first.lines)
    second = Game(folder, section, earlier=first.lines).plays(after)
    repeat(folder, first.settings.trial, first.head, first.lines + second.lines)


def test_a_policy_is_not_asked_in_a_turn_for_which_the_participant_has_chosen_before_they_left(tmp_path: Path) -> None:
    chooses = ("says", ("P2", {"action": "up", "held": True}))
    game = Game(tmp_path, {"pace": "turns", "turnSeconds": 3, "policySeconds": 2})
    game.plays([("tick", 5), chooses, ("goes", "P2"), ("tick", 10)])
    assert [type(effect) for effect in game.waiting["it"]] == [ResetPolicy]
    game.plays([("tick", 30), *[("answers", "it"), ("tick", 30)] * 3])
    assert [part["by"] for part in (line["players"]["it"] for line in game.steps)][:3] == ["human", None, "policy"]
    repeat(tmp_path, game.settings.trial, game.head, game.lines)


def test_a_policy_that_played_for_a_participant_is_repeated_too(tmp_path: Path) -> None:
    away = [("tick", 3), ("goes", "P2"), ("tick", 10)]
    game = Game(tmp_path, {}).plays([*away, *[("answers", "it"), ("tick", 1)] * 3, ("comes", "P2")])
    parts = [line["players"]["it"] for line in game.steps]
    assert "policy" in {part["by"] for part in parts}
    repeat(tmp_path, game.settings.trial, game.head, game.lines)
    line = next(line for line in game.lines if line.get("what") == "replaced")
    line["seed"] += 1
    with pytest.raises(AssertionError):
        repeat(tmp_path, game.settings.trial, game.head, game.lines)
