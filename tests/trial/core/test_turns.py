"""The core with several players, event by event: turns and their clock, late policies, masks, and legal actions in
any order of events."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hippodrome.trial.core import messages
from hippodrome.trial.core.effects import (
    Begun,
    Call,
    FeedbackCall,
    OpenRecording,
    RecordLine,
    ReplayCall,
    Replayed,
    ResetCall,
    ResetPolicy,
    SaveAnswer,
    SendDone,
    SendMessage,
    SendState,
    StepCall,
    StepTaken,
    WriteLog,
)
from hippodrome.trial.core.history import RecordedAction, RecordedStep, RecordedTrial, UnfinishedEpisode
from hippodrome.trial.core.messages import CommandRefused
from hippodrome.trial.core.players import PLAYER, Player, PlayersError, View, alone, policy_seed, who_plays
from hippodrome.trial.core.policies import AskPolicy, Observed
from hippodrome.trial.core.timing import Window
from hippodrome.trial.core.trial import Phase, Trial
from hippodrome.trial.settings import TrialSettings, trial_section
from testing.exploration import examples
from tests.trial.core.trial_driver import FRAME, Driver, sent

SPACE = ("noop", "up", "right")
PLAYS = {"me": "human", "it": "agent:Partner"}


class Game:
    """A trial with a human (`me`) and a policy (`it`), an agent that answers when it is told to, and a set clock."""

    def __init__(self, *, plays: dict[str, str] | None = None, **section: Any) -> None:
        section = {"game": "grid", "betweenEpisodes": 0, "startingFrameRate": 10, "players": plays or PLAYS, **section}
        section["ui"] = dict.fromkeys(("start", "pause", "stop", "reset", "up", "right"), True)
        env = {"PROJECT_ID": "study", "USER_ID": "P1", "SERVER": "a-1", "TOKEN": "t", "GAME_STEPS": "3", "STORE": "x"}
        self.settings = TrialSettings.from_env({**env, "TLS": "off", "TRIAL": json.dumps(section)})
        self.trial = Trial(self.settings, "3", trial_id="the-trial", new_seed=lambda: 7)
        self.now = 100.0
        self.all: list[Any] = []
        self.effects: list[Any] = []
        self.asks: list[AskPolicy] = []
        self.open_call: Call | None = None

    def event(self, name: str, *args: Any) -> list[Any]:
        self.effects = []
        self._did(getattr(self.trial, name)(*args))
        return self.effects

    def _did(self, effects: list[Any]) -> None:
        for effect in effects:
            self.effects.append(effect)
            self.all.append(effect)
            if isinstance(effect, OpenRecording):
                self._did(self.trial.recording_opened(self.now))
            elif isinstance(effect, AskPolicy):
                self.asks.append(effect)
            elif isinstance(effect, Call):
                assert self.open_call is None, "one call at a time"
                self.open_call = effect
            elif isinstance(effect, SaveAnswer):
                self._did(self.trial.answer_saved(self.now))

    def returns(self, result: Any = None) -> list[Any]:
        call, self.open_call = self.open_call, None
        return self.event("call_returned", call, result, self.now)

    def playing(self, view: View) -> Game:
        spaces = dict.fromkeys(self.settings.trial.players, SPACE)
        self.event("start", who_plays(self.settings.trial, spaces, None), None, self.now)
        assert isinstance(self.open_call, ResetCall)
        self.returns(Begun(b"reset", FRAME, view))
        self.event("connect", "P1", "tab", Window(), self.now)
        self.say(command="start")
        return self

    def say(self, **message: Any) -> list[Any]:
        return self.event("receive", "tab", messages.parse(json.dumps(message)), self.now)

    def wait(self, seconds: float) -> list[Any]:
        """Let time pass as the event loop does: it wakes the core when the core asked for it."""
        until, done = self.now + seconds, []
        while self.trial.wake_at is not None and self.trial.wake_at <= until:
            self.now = max(self.now, self.trial.wake_at)
            done += self.event("advance", self.now)
            if self.open_call is not None:
                break
        self.now = max(self.now, until)
        return done

    def acts(self, action: Any = 1, ask: AskPolicy | None = None) -> list[Any]:
        """The policy answers the newest question, or this one."""
        ask = ask or self.asks[-1]
        return self.event("policy_acted", ask.player, ask.ask_id, action, self.now)

    @property
    def actions(self) -> dict[str, tuple[int, str]]:
        """The actions of the open step by player: each with who chose it."""
        assert isinstance(self.open_call, StepCall)
        return {name: (one.index, one.by) for name, one in self.open_call.actions.items() if one.acts}

    def stepped(self, view: View, *, over: bool = False) -> list[Any]:
        return self.returns(StepTaken({"me": 1.0, "it": 2.0}, over, False, FRAME, b"step", view))

    @property
    def states(self) -> list[dict[str, Any]]:
        return sent(self.all, SendState)


def view_for(*to_act: str, masks: dict[str, Any] | None = None) -> View:
    return View(frozenset(to_act), dict.fromkeys(to_act, "o"), {name: {} for name in to_act}, masks or {})


def game_in_turns(**section: Any) -> Game:
    return Game(pace="turns", **section)


# ---- turns


def test_nothing_happens_in_a_turn_until_the_human_chooses() -> None:
    game = game_in_turns().playing(view_for("me"))
    assert game.trial.wake_at is None
    game.wait(3600)
    assert game.open_call is None
    game.say(action="up")
    assert game.actions == {"me": (1, "human")}


def test_the_first_choice_in_a_turn_counts() -> None:
    game = game_in_turns().playing(view_for("me", "it"))
    game.say(action="up")
    game.say(action="right")
    game.acts(2)
    assert game.actions == {"me": (1, "human"), "it": (2, "policy")}


def test_a_press_out_of_turn_does_nothing_and_is_recorded() -> None:
    game = game_in_turns().playing(view_for("it"))
    game.say(action="up")
    game.say(action="right", held=True)
    game.acts(2)
    said = game.open_call.fields["messages"]  # type: ignore[union-attr]
    assert [one["action"] for one in said if "action" in one] == ["up", "right"]
    game.stepped(view_for("me"))
    game.wait(5)
    assert game.open_call is None, "neither the press nor the key that is still held is the next turn's"
    game.say(action="right", held=False)
    game.say(action="right", held=True)
    assert game.actions == {"me": (2, "human")}


def test_the_projects_own_keys_choose_too() -> None:
    game = game_in_turns(keys={"a": "up", "ArrowRight": "right"}).playing(view_for("me"))
    game.say(key="ArrowRight", held=True)
    assert game.actions == {"me": (2, "human")}
    game.stepped(view_for("me"))
    game.wait(5)
    assert game.open_call is None
    game.say(key="ArrowRight", held=False)
    game.say(key="a", held=True)
    assert game.actions == {"me": (1, "human")}


def test_a_move_that_the_mask_forbids_is_refused_with_a_sentence() -> None:
    game = game_in_turns().playing(view_for("me", masks={"me": [True, False, True]}))
    said = sent(game.say(action="up"), SendMessage)
    assert said == [{"error": "that move is not possible now"}]
    assert game.open_call is None
    game.say(action="right")
    assert game.actions == {"me": (2, "human")}


def test_a_policys_move_comes_no_sooner_than_a_frame_after_the_humans() -> None:
    game = game_in_turns().playing(view_for("me"))
    game.say(action="up")
    game.stepped(view_for("it"))
    game.acts(1)
    assert game.open_call is None
    assert game.trial.wake_at == pytest.approx(game.now + 0.1)
    game.wait(0.11)
    assert game.actions == {"it": (1, "policy")}


@pytest.mark.parametrize(("ends", "expected"), [("idle", (0, "none")), ("random", (1, "random"))])
def test_when_turn_seconds_are_over_the_action_of_turn_ends_is_taken(ends: str, expected: tuple[int, str]) -> None:
    game = game_in_turns(turnSeconds=5, turnEnds=ends).playing(
        view_for("me", masks={"me": [ends == "idle", True, False]})
    )
    game.wait(4.9)
    assert game.open_call is None
    game.wait(0.2)
    assert game.actions == {"me": expected}


@pytest.mark.parametrize(("ends", "name"), [("idle", "noop"), ("random", "up")])
def test_a_human_is_told_what_was_chosen_for_them_until_they_choose_again(ends: str, name: str) -> None:
    masks = {"me": [ends == "idle", True, False]}
    game = game_in_turns(turnSeconds=5, turnEnds=ends).playing(view_for("me", masks=masks))
    assert not game.states[-1].keys() & {"chosen", "timeUp"}
    game.wait(5.1)
    game.stepped(view_for("me"))
    assert game.states[-1] | {"toAct": True, "timeUp": name} == game.states[-1]
    assert "chosen" not in game.states[-1]
    game.say(action="up")
    assert game.states[-1] | {"toAct": False, "chosen": "up"} == game.states[-1]
    assert "timeUp" not in game.states[-1]
    game.stepped(view_for("me"))
    assert not game.states[-1].keys() & {"chosen", "timeUp"}


def test_when_turn_seconds_are_over_the_episode_may_end() -> None:
    game = game_in_turns(turnSeconds=5, turnEnds="episode", maxEpisodes=1).playing(view_for("me"))
    game.say(action="up")
    game.stepped(view_for("me"))
    game.wait(5.1)
    (end,) = [one.fields for one in game.all if isinstance(one, RecordLine) and one.kind == "end"]
    assert (end["why"], end["scores"]) == ("turnSeconds", {"me": 1, "it": 2})
    assert game.trial.phase is Phase.FINISHED
    assert game.trial.progress.outcome == "finished"
    assert game.states[-1] | {"state": "ended", "timeUp": ""} == game.states[-1]


def test_a_pause_stops_the_clock_of_the_turn() -> None:
    game = game_in_turns(turnSeconds=5).playing(view_for("me"))
    game.wait(3)
    game.say(command="pause")
    game.wait(60)
    game.say(command="start")
    assert game.states[-1]["turnEndsIn"] == pytest.approx(2)
    game.wait(1.9)
    assert game.open_call is None
    game.wait(0.2)
    assert game.actions == {"me": (0, "none")}


def test_the_clock_of_a_turn_does_not_run_while_the_first_picture_is_shown() -> None:
    game = game_in_turns(turnSeconds=5, resetFreeze=2).playing(view_for("me"))
    assert game.trial.wake_at == pytest.approx(102)
    game.say(action="up")
    game.wait(2.1)
    assert game.open_call is None, "a press before does nothing"
    assert game.states[-1]["turnEndsIn"] == pytest.approx(5)
    game.wait(4.8)
    assert game.open_call is None
    game.wait(0.2)
    assert game.actions == {"me": (0, "none")}


def test_the_clock_of_a_turn_does_not_run_while_a_policy_thinks() -> None:
    game = game_in_turns(turnSeconds=5, policySeconds=60).playing(view_for("it"))
    game.wait(30)
    assert game.open_call is None
    game.acts(1)
    game.stepped(view_for("me"))
    assert game.states[-1]["toAct"] is True
    assert game.states[-1]["turnEndsIn"] == pytest.approx(5)


def test_a_policy_that_thinks_too_long_takes_the_idle_action() -> None:
    game = game_in_turns(policySeconds=2).playing(view_for("it"))
    late = game.asks[-1]
    game.wait(2.1)
    assert game.actions == {"it": (0, "late")}
    game.stepped(view_for("it"))
    game.acts(2, late)
    game.wait(0.2)
    assert game.open_call is None, "the answer to an earlier question changes nothing"
    game.acts(1)
    game.wait(0.2)
    assert game.actions == {"it": (1, "policy")}


def test_clients_are_told_whose_turn_it_is() -> None:
    game = game_in_turns().playing(view_for("it"))
    assert (sent(game.all, SendMessage)[0]["pace"], game.states[-1]["toAct"]) == ("turns", False)
    game.acts(1)
    game.stepped(view_for("me"))
    assert game.states[-1]["toAct"] is True
    game.say(action="up")
    assert game.states[-1]["toAct"] is False


def test_advice_counts_when_the_turns_time_is_over_and_not_before() -> None:
    game = game_in_turns(turnSeconds=5, gym="advise").playing(view_for("me"))
    game.event("advise", 2, None, game.now)
    game.wait(1)
    assert game.open_call is None
    game.wait(5)
    assert game.actions == {"me": (2, "advice")}


def test_a_step_in_which_no_player_acts_is_taken_at_the_frame_rate() -> None:
    game = game_in_turns().playing(view_for())
    assert isinstance(game.open_call, StepCall)
    game.stepped(view_for())
    game.wait(0.05)
    assert game.open_call is None
    game.wait(0.1)
    assert game.actions == {}


def test_alone_each_press_is_a_turn() -> None:
    driver = Driver(pace="turns").playing()
    assert driver.trial.wake_at is None
    for action in ("up", "right"):
        driver.say(action=action)
        assert isinstance(driver.call, StepCall)
        assert driver.call.actions[PLAYER].name == action
        driver.step()
        driver.wait(0.1)
        assert driver.trial.wake_at is None


def test_the_game_asks_to_be_woken_when_the_first_time_is_over() -> None:
    for section, until in (
        ({"policySeconds": 2, "turnSeconds": 5, "episodeSeconds": 9}, 102.0),
        ({"policySeconds": 9, "turnSeconds": 2, "episodeSeconds": 5}, 102.0),
        ({"policySeconds": 9, "turnSeconds": 5, "episodeSeconds": 2}, 102.0),
    ):
        assert game_in_turns(**section).playing(view_for("me", "it")).trial.wake_at == pytest.approx(until)
    assert game_in_turns(turnSeconds=5, policySeconds=9).playing(view_for("it")).trial.wake_at == pytest.approx(109.0)


def test_an_episode_whose_time_is_over_in_a_turn_ends_without_a_step() -> None:
    game = game_in_turns(episodeSeconds=2, maxEpisodes=1).playing(view_for("me"))
    game.wait(1.9)
    assert not game.trial.progress.over
    game.wait(0.1)
    (end,) = [one.fields for one in game.all if isinstance(one, RecordLine) and one.kind == "end"]
    assert (end["why"], end["limit"], end["steps"]) == ("truncated", "episodeSeconds", 0)
    assert game.trial.progress.outcome == "finished"


@pytest.mark.parametrize(
    ("mask", "expected"), [([True, True, False], (0, "none")), ([False, False, True], (2, "none"))]
)
def test_illegal_advice_does_not_count_and_an_illegal_idle_action_is_not_taken(
    mask: list[bool], expected: tuple[int, str]
) -> None:
    game = game_in_turns(turnSeconds=5, gym="advise").playing(view_for("me", masks={"me": mask}))
    game.event("advise", mask.index(False), None, game.now)
    game.wait(5)
    assert game.actions == {"me": expected}


def chance(seed: int) -> list[int]:
    """Return the random actions of twenty turns in which the human does not choose."""
    game = game_in_turns(turnSeconds=1, turnEnds="random", seed=seed).playing(view_for("me"))
    chosen = []
    for _ in range(20):
        game.wait(1.1)
        chosen.append(game.actions["me"][0])
        game.stepped(view_for("me"))
    return chosen


def test_random_actions_differ_from_turn_to_turn_and_follow_from_the_episodes_seed() -> None:
    assert set(chance(1)) == {0, 1, 2}
    assert chance(1) == chance(1) != chance(2)


def test_a_program_that_plays_a_player_chooses_in_its_turn_and_has_policy_seconds() -> None:
    game = Game(plays={"me": "human", "it": "gym://learner"}, gym="advise", pace="turns", policySeconds=4)
    game.playing(view_for("it"))
    game.wait(3.9)
    assert game.open_call is None
    game.event("advise", 2, None, game.now)
    assert game.actions == {"it": (2, "advice")}
    game.stepped(view_for("it"))
    game.wait(3.9)
    assert game.open_call is None
    game.wait(0.2)
    assert game.actions == {"it": (0, "late")}


def test_an_unknown_action_is_refused_and_ignored_from_hippos_page() -> None:
    game = game_in_turns().playing(view_for("me"))
    assert sent(game.say(action="jump"), SendMessage) == [{"error": "that action is not in this game's actionSpace"}]
    said = messages.Message(action="jump", lasts=True)
    assert sent(game.event("receive", "tab", said, game.now), SendMessage) == []
    game.event("receive", "tab", messages.Message(action="up", lasts=True), game.now)
    assert game.actions == {"me": (1, "human")}


# ---- in real time


def test_in_real_time_an_action_that_the_mask_forbids_is_replaced_by_the_idle_or_first_legal_one() -> None:
    for mask, expected in (
        ([True, False, True], (0, "none")),
        ([False, False, True], (2, "none")),
        ([True, True, False], (1, "human")),
    ):
        game = Game().playing(view_for("me", masks={"me": mask}))
        game.say(action="up", held=True)
        game.stepped(view_for("me", masks={"me": mask}))
        game.wait(0.1)
        assert game.actions == {"me": expected}


def test_in_real_time_advice_counts_for_one_step_if_it_is_legal_and_no_key_acts() -> None:
    game = Game(gym="advise").playing(view_for("me", "it"))
    view = view_for("me", masks={"me": [True, True, False]})

    def next_action(*advice: int, view: View = view) -> tuple[int, str]:
        game.stepped(view)
        for action in advice:
            assert game.event("advise", action, None, game.now) == [], "it waits for the step"
        game.wait(0.1)
        return game.actions["me"]

    assert next_action(1) == (1, "advice")
    assert next_action() == (0, "none")
    assert next_action(2) == (0, "none"), "it is illegal"
    assert next_action(1, 0) == (0, "advice"), "the last advice counts"
    game.say(action="up", held=True)
    assert next_action(0) == (1, "human")
    game.say(action="up", held=False)
    assert next_action() == (0, "none"), "the advice was for the step before"
    assert next_action(2, view=view_for("me")) == (2, "advice")


def test_advice_for_the_episode_before_does_not_count() -> None:
    game = Game(gym="advise").playing(view_for("me"))
    game.stepped(view_for(), over=True)
    game.event("advise", 2, None, game.now)
    game.returns(Begun(b"reset", FRAME, view_for("me")))
    game.wait(0.1)
    assert game.actions == {"me": (0, "none")}


def test_advice_that_is_not_possible_is_refused_with_the_reason() -> None:
    game = Game(gym="advise")
    with pytest.raises(CommandRefused, match="no game is going on"):
        game.trial.advise(0, None, game.now)
    game.playing(view_for("me", "it"))
    for action, player, words in (
        (3, None, "there is no action 3; there are 0 to 2"),
        (-1, "me", "there is no action -1; there are 0 to 2"),
        (0, "it", "it is played by agent:Partner, not by a program"),
        (0, "she", "there is no such player; there are me, it"),
    ):
        with pytest.raises(CommandRefused) as refused:
            game.trial.advise(action, player, game.now)
        assert str(refused.value) == words
    assert game.trial.progress.choices.action_space_of(None) == SPACE


def test_a_name_that_is_no_action_ends_the_action_of_hippos_page() -> None:
    driver = Driver().playing()

    def next_action(name: str) -> tuple[str, list[Any]]:
        said = driver.event("receive", "tab", messages.Message(action=name, lasts=True), driver.now)
        driver.step()
        driver.wait(0.1)
        assert isinstance(driver.call, StepCall)
        return driver.call.actions[PLAYER].name, [one["error"] for one in sent(said)]

    assert next_action("up") == ("up", [])
    assert next_action("jump") == ("noop", ["that action is not in this game's actionSpace"])
    assert next_action("right") == ("right", [])
    assert next_action("noop") == ("noop", [])


def test_hippos_page_may_send_noop_where_no_action_has_this_name() -> None:
    driver = Driver()
    driver.event("start", alone(("left", "right")), None, driver.now)
    driver.reset()
    driver.connect()
    assert sent(driver.event("receive", "tab", messages.Message(action="noop", lasts=True), driver.now)) == []


def test_a_late_action_of_a_policy_is_taken_at_the_next_step() -> None:
    game = Game().playing(view_for("me", "it"))
    assert game.actions == {"me": (0, "none"), "it": (0, "late")}
    game.acts(2)
    game.stepped(view_for("me", "it"))
    assert len(game.asks) == 1, "what came late is taken first"
    game.wait(0.1)
    assert game.actions["it"] == (2, "policy")
    observed = game.open_call.actions["it"].observed  # type: ignore[union-attr]
    assert observed == 0, "what it looked at"
    game.stepped(view_for("me", "it"))
    assert len(game.asks) == 2


def test_between_two_choices_a_policys_action_is_held_or_single_as_policyActions_or_else_input_says() -> None:
    held, single = (2, "policy"), (0, "none")
    for section, expected in (
        ({"input": "held"}, held),
        ({"input": "single"}, single),
        ({"input": "held", "policyActions": "single"}, single),
        ({"input": "single", "policyActions": "held"}, held),
    ):
        game = Game(frameSkip=2, **section)
        spaces = dict.fromkeys(PLAYS, SPACE)
        game.event("start", who_plays(game.settings.trial, spaces, None), None, game.now)
        game.returns(Begun(b"reset", FRAME, view_for("me", "it")))
        game.acts(2)
        game.event("connect", "P1", "tab", Window(), game.now)
        game.say(command="start")
        assert game.actions["it"] == (2, "policy")
        game.stepped(view_for("me", "it"))
        game.wait(0.1)
        assert (len(game.asks), game.actions["it"]) == (1, expected)
        game.stepped(view_for("me", "it"))
        assert len(game.asks) == 2


def test_a_policy_that_is_not_to_act_when_it_is_due_is_asked_as_soon_as_it_is_to_act() -> None:
    """Otherwise one that acts at odd steps would never be asked with frameSkip: 2."""
    game = Game(frameSkip=2).playing(view_for("me"))
    acted = []
    for to_act in ("it", "me") * 3:
        if game.open_call is None:
            game.wait(0.1)
        acted.append(game.actions)
        game.stepped(view_for(to_act))
        if to_act == "it":
            game.acts(2)
    assert acted == [{"me": (0, "none")}, {"it": (2, "policy")}] * 3
    assert len(game.asks) == 3


def test_the_next_server_goes_on_with_a_policys_last_action() -> None:
    game = Game(frameSkip=4)
    steps = [
        RecordedStep(None, 0, 1.0, players={"me": RecordedAction(0, 1.0), "it": RecordedAction(2, 2.0, observed)})
        for observed in (0, None)
    ]
    recorded = RecordedTrial(unfinished=UnfinishedEpisode(1, 7, steps))
    spaces = dict.fromkeys(PLAYS, SPACE)
    game.event("start", who_plays(game.settings.trial, spaces, None), recorded, game.now)
    game.returns(Replayed(FRAME, view_for("me", "it"), {}))
    game.event("connect", "P1", "tab", Window(), game.now)
    game.say(command="start")
    assert (game.asks, game.actions["it"]) == ([], (2, "policy")), "it is asked after four steps"


def resumed_game(*its: RecordedAction) -> Game:
    """Return a game that goes on after these actions of the policy on an earlier server; the human's were idle."""
    game = Game()
    steps = [RecordedStep(None, 0, 1.0, players={"me": RecordedAction(0, 1.0, None, "none"), "it": it}) for it in its]
    recorded = RecordedTrial(unfinished=UnfinishedEpisode(1, 7, steps))
    game.event("start", who_plays(game.settings.trial, dict.fromkeys(PLAYS, SPACE), None), recorded, game.now)
    game.returns(Replayed(FRAME, view_for("me", "it"), {}))
    game.event("connect", "P1", "tab", Window(), game.now)
    game.say(command="start")
    return game


def failed_steps(*looked_at: int) -> list[RecordedAction]:
    return [RecordedAction(0, 0.0, step, "none") for step in looked_at]


IDLED = RecordedAction(0, 0.0, None, "none")


def test_a_policy_that_idles_for_the_episode_idles_on_the_next_server_too() -> None:
    game = resumed_game(*failed_steps(0, 1, 2), IDLED)
    assert (game.asks, game.actions["it"]) == ([], (0, "none"))
    game.stepped(view_for("me", "it"))
    game.wait(0.1)
    assert game.asks == []
    game.stepped(view_for(), over=True)
    game.returns(Begun(b"reset", FRAME, view_for("me", "it")))
    assert len(game.asks) == 1, "it is asked again in the next episode"


def test_the_next_server_goes_on_counting_a_policys_failures() -> None:
    game = resumed_game(*failed_steps(0, 1, 2))
    game.event("policy_failed", "it", game.asks[-1].ask_id, ValueError("no idea"), game.now)
    game.stepped(view_for("me", "it"))
    game.wait(0.1)
    assert len(game.asks) == 1, "that was its third failure in a row"


@pytest.mark.parametrize(
    "after",
    [
        [RecordedAction(2, 0.0, 3, "policy")],
        [RecordedAction(2, 0.0, None, "human"), IDLED],
        [RecordedAction(1, 0.0, None, "policy"), RecordedAction(2, 0.0, 4, "policy"), IDLED],
    ],
)
def test_the_next_server_counts_only_failures_since_the_last_choice(after: list[RecordedAction]) -> None:
    game = resumed_game(*failed_steps(0, 1, 2), *after)
    for _ in range(2):
        game.event("policy_failed", "it", game.asks[-1].ask_id, ValueError("no idea"), game.now)
        game.stepped(view_for("me", "it"))
        game.wait(0.1)
    assert len(game.asks) == 3


def test_a_policy_whose_player_left_the_game_is_not_asked_and_does_not_act() -> None:
    game = Game().playing(view_for("me", "it"))
    game.acts(1)
    game.stepped(view_for("me"))
    assert len(game.asks) == 1
    game.wait(0.1)
    assert set(game.actions) == {"me"}


def test_a_human_who_left_the_game_watches_until_it_is_over() -> None:
    game = Game().playing(view_for("me", "it"))
    game.stepped(view_for("it"))
    game.say(action="up", held=True)
    game.wait(0.1)
    assert set(game.actions) == {"it"}
    game.stepped(view_for(), over=True)
    assert game.trial.progress.episode == 2


def test_a_policy_idles_for_the_episode_after_three_failures_in_a_row() -> None:
    game = Game(maxEpisodes=2).playing(view_for("me", "it"))
    for _ in range(3):
        ask = game.asks[-1]
        game.event("policy_failed", "it", ask.ask_id, ValueError("no idea"), game.now)
        game.stepped(view_for("me", "it"))
        game.wait(0.1)
        assert game.actions["it"] == (0, "none")
    asked = len(game.asks)
    game.stepped(view_for("me", "it"))
    game.wait(0.1)
    assert len(game.asks) == asked == 3
    told = [one.text for one in game.all if isinstance(one, WriteLog)]
    assert sum("no idea" in text for text in told) == 1
    assert "the policy of it failed 3 times in a row: it idles until the episode is over" in told
    game.stepped(view_for(), over=True)
    game.returns(Begun(b"reset", FRAME, view_for("me", "it")))
    assert len(game.asks) == 4, "it is asked again in the next episode"


def test_the_policies_that_are_asked_begin_the_episode_with_the_environment_and_programs_do_not() -> None:
    for plays, asked in (("agent:Partner", {"it"}), ("gym://learner", set())):
        game = Game(plays={"me": "human", "it": plays}, gym="advise").playing(view_for("me", "it"))
        (call,) = [one for one in game.all if isinstance(one, ResetCall)]
        assert call.asked == asked
        assert {one.player for one in game.all if isinstance(one, ResetPolicy)} == asked


def test_an_episode_is_repeated_with_the_idle_actions_of_all_players() -> None:
    game = Game(idleAction={"it": "right"}, seed=3)
    steps = [RecordedStep(None, 0, 1.0, players={"me": RecordedAction(0, 1.0), "it": RecordedAction(1, 2.0, 0)})]
    recorded = RecordedTrial(unfinished=UnfinishedEpisode(1, 7, steps))
    game.event("start", who_plays(game.settings.trial, dict.fromkeys(PLAYS, SPACE), None), recorded, game.now)
    assert isinstance(game.open_call, ReplayCall)
    assert game.open_call.default_actions == {"me": 0, "it": 2}
    looked_at = Observed("o", {}, None, 1)
    game.returns(Replayed(FRAME, view_for("me", "it"), {"it": [looked_at]}))
    (reset,) = [one for one in game.all if isinstance(one, ResetPolicy)]
    assert (reset.seed, reset.observed) == (policy_seed(7, "it"), [looked_at]), "the seed of the episode"
    assert game.trial.progress.scores == {"me": 1.0, "it": 2.0}


def test_an_answer_of_a_policy_that_is_no_action_is_recorded_and_a_second_time_only_counted() -> None:
    game = Game().playing(view_for("me", "it"))
    for _ in range(2):
        game.acts(7)
        game.stepped(view_for("me", "it"))
        game.wait(0.1)
        assert game.actions["it"] == (0, "none")
    game.acts("up")
    lines = [one.fields for one in game.all if isinstance(one, RecordLine) and one.kind == "error"]
    wrong, failed = "the policy of it (agent:Partner) failed: ", "the policy of it failed 3 times in a row: "
    assert lines == [
        {"episode": 1, "step": 0, "player": "it", "error": wrong + "it chose action 7, but the actions are 0 to 2"},
        {
            "episode": 1,
            "step": 2,
            "player": "it",
            "error": wrong + "its action is of the type str, not a whole number",
        },
        {"episode": 1, "step": 2, "player": "it", "error": failed + "it idles until the episode is over"},
    ]
    assert [one.text for one in game.all if isinstance(one, WriteLog)] == [line["error"] for line in lines]


def test_a_trial_reports_at_most_twenty_different_failures_of_policies() -> None:
    game = Game(maxEpisodes=100).playing(view_for("me", "it"))
    for number in range(30):
        game.event("policy_failed", "it", game.asks[-1].ask_id, ValueError(str(number)), game.now)
        game.stepped(view_for(), over=True)
        game.returns(Begun(b"reset", FRAME, view_for("me", "it")))
        game.wait(0.1)
    lines = [one for one in game.all if isinstance(one, RecordLine) and one.kind == "error"]
    assert len(lines) == 20


def test_an_action_of_a_policy_waits_in_real_time_and_a_failure_is_recorded_at_once() -> None:
    game = Game().playing(view_for("me", "it"))
    game.stepped(view_for("me", "it"))
    game.now += 1.0
    assert game.acts(1) == []
    assert game.open_call is None
    game = game_in_turns().playing(view_for("it"))
    assert isinstance(game.acts(1)[-1], StepCall), "turn by turn the game goes on with it"


def test_the_answer_and_the_lines_that_end_have_the_scores_of_all_players() -> None:
    game = Game(maxEpisodes=1).playing(view_for("me", "it"))
    game.stepped(view_for(), over=True)
    (end,) = [one.fields for one in game.all if isinstance(one, RecordLine) and one.kind == "end"]
    assert (end["score"], end["scores"]) == (1, {"me": 1, "it": 2})
    (saved,) = [one.answers for one in game.all if isinstance(one, SaveAnswer)]
    assert (saved["score"], saved["scores"], saved["frames"]) == (1, {"me": 1, "it": 2}, 1)
    again = Game()
    again.event("already_played", saved)
    assert again.event("connect", "P1", "tab", Window(), again.now) == [SendDone("tab", 1, 1)]
    game = Game().playing(view_for("me", "it"))
    game.stepped(view_for("me", "it"))
    game.event("close", game.now)
    (end,) = [one.fields for one in game.all if isinstance(one, RecordLine) and one.kind == "end"]
    assert (end["episode"], end["score"], end["scores"]) == (1, 1, {"me": 1, "it": 2})


def test_a_recording_of_several_players_begins_with_all_of_them() -> None:
    game = Game().playing(view_for("me", "it"))
    (opened,) = [one for one in game.all if isinstance(one, OpenRecording)]
    assert [(one.name, one.plays) for one in opened.players] == list(PLAYS.items())
    assert (opened.action_space, opened.frame_rate, opened.seed) == (SPACE, 10, 7)


def test_clients_are_told_the_players_and_which_one_is_theirs() -> None:
    game = Game().playing(view_for("me", "it"))
    told = sent(game.all, SendMessage)[0]
    assert (told["player"], told["players"]) == ("me", ["me", "it"])


def test_a_policys_seed_follows_from_the_episodes_seed() -> None:
    first, second = Game().playing(view_for("me", "it")), Game(seed=8).playing(view_for("me", "it"))
    seeds = [[one.seed for one in game.all if isinstance(one, ResetPolicy)] for game in (first, second)]
    assert seeds[0] != seeds[1]
    assert seeds[0] == [
        one.seed for one in Game(seed=7).playing(view_for("me", "it")).all if isinstance(one, ResetPolicy)
    ]


def test_the_advice_of_a_program_plays_a_player_of_gym() -> None:
    game = Game(plays={"me": "human", "it": "gym://learner"}, gym="advise").playing(view_for("me", "it"))
    assert game.asks == []
    assert game.actions["it"] == (0, "none")
    game.stepped(view_for("me", "it"))
    game.event("advise", 2, None, game.now)
    game.wait(0.1)
    assert game.actions == {"me": (0, "none"), "it": (2, "advice")}
    game.stepped(view_for("me", "it"))
    game.wait(0.1)
    assert game.actions["it"] == (2, "late")
    for player in ("nobody", "me"):
        with pytest.raises(CommandRefused):
            game.trial.advise(3, player, game.now)


def test_the_log_says_how_often_a_policy_was_late_in_an_episode() -> None:
    game = Game().playing(view_for("me", "it"))
    game.stepped(view_for("me", "it"))
    game.acts(1)
    game.wait(0.1)
    game.stepped(view_for(), over=True)
    told = [one.text for one in game.all if isinstance(one, WriteLog)]
    assert "the policy of it was late at 1 of 2 steps" in told


# ---- who plays


def players(section: dict[str, Any], *names: str) -> tuple[Player, ...]:
    return who_plays(trial_section(section), dict.fromkeys(names, SPACE), 1)


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({}, 'must say who plays "b"; the environment has "a", "b"'),
        ({"players": {"a": "human", "c": "random"}}, 'names "c", but the environment has "a", "b"'),
        ({"players": {"a": "human"}}, 'must say who plays "b"'),
        ({"players": {0: {"a": "human", "b": "idle"}}}, 'must say who plays "b"'),
        ({"players": {"a": "human", "b": "idle"}, "idleAction": "fly"}, 'idleAction is "fly", but a has the actions'),
        ({"players": {"a": "human", "b": "idle"}, "idleAction": {"c": "up"}}, 'idleAction names "c"'),
    ],
)
def test_players_that_do_not_fit_the_environment_are_named(section: dict[str, Any], words: str) -> None:
    with pytest.raises(PlayersError, match=words.replace("(", r"\(")):
        players(section, "a", "b")


def test_the_players_are_those_of_the_group_in_the_environments_order() -> None:
    by_group = {"0": {"b": "human", "a": "idle"}, "1": {"b": "random", "a": "human"}}
    found = players({"players": by_group, "idleAction": {"b": "UP"}}, "a", "b")
    assert [(one.name, one.plays, one.idle) for one in found] == [("a", "human", 0), ("b", "random", 1)]


# ---- in any order

EVENTS = st.lists(
    st.one_of(
        st.tuples(st.just("say"), st.sampled_from(["start", "pause", "reset"])),
        st.tuples(st.just("press"), st.sampled_from(SPACE)),
        st.tuples(st.just("act"), st.sampled_from([0, 1, 2])),
        st.tuples(st.just("act"), st.sampled_from([7, -1, None, 1.5, "up"])),
        st.tuples(st.just("old"), st.integers(0, 5)),
        st.tuples(st.just("fail"), st.none()),
        st.tuples(st.just("wait"), st.sampled_from([0.01, 0.1, 1.0, 12.0])),
        st.tuples(st.just("step"), st.sampled_from([("me",), ("it",), ("me", "it"), ()])),
        st.tuples(st.just("step"), st.sampled_from([("me",), ("it",)])),
        st.tuples(st.just("over"), st.none()),
    ),
    max_size=60,
)
SECTIONS = st.fixed_dictionaries(
    {
        "pace": st.sampled_from(["turns", "realtime"]),
        "turnSeconds": st.sampled_from([0, 0.5, 5]),
        "turnEnds": st.sampled_from(["idle", "random", "episode"]),
        "frameSkip": st.sampled_from([1, 3]),
        "policySeconds": st.sampled_from([0.05, 10]),
        "maxEpisodes": st.sampled_from([1, 4]),
    }
)


@settings(max_examples=examples(150), deadline=None)
@given(
    SECTIONS,
    EVENTS,
    st.sampled_from([("me",), ("it",), ("me", "it")]),
    st.sampled_from([None, [False, True, True], [False, False, False], [True]]),
)
def test_whatever_happens_steps_take_legal_actions_of_those_whose_turn_it_is(
    section: dict[str, Any], events: list[tuple[str, Any]], first: tuple[str, ...], mask: list[bool] | None
) -> None:
    masks = {} if mask is None else {"me": mask, "it": mask}
    view = view_for(*first, masks=masks)
    game = Game(**section).playing(view)
    pressed = 0
    for kind, what in events:
        if kind == "say":
            game.say(command=what)
        elif kind == "press":
            pressed += 1
            game.say(action=what)
        elif kind in ("act", "old") and game.asks:
            ask = game.asks[-1] if kind == "act" else game.asks[what % len(game.asks)]
            game.event("policy_acted", "it", ask.ask_id, what if kind == "act" else 1, game.now)
        elif kind == "fail" and game.asks:
            game.event("policy_failed", "it", game.asks[-1].ask_id, ValueError("no"), game.now)
        elif kind == "wait":
            game.wait(what)
        elif kind in ("step", "over"):
            view = _answer(game, view, what or (), masks, over=kind == "over")
        if isinstance(game.open_call, StepCall):
            _check(game, view, mask, pressed)
        if game.trial.done:
            break
    progress = game.trial.progress
    assert progress.scores["it"] == 2 * progress.scores["me"] == 2 * progress.total_steps


def _answer(game: Game, view: View, to_act: tuple[str, ...], masks: dict[str, Any], *, over: bool) -> View:
    """Let the agent's open call return."""
    if isinstance(game.open_call, StepCall):
        view = view_for(*(() if over else to_act), masks=masks)
        game.stepped(view, over=over)
    elif isinstance(game.open_call, FeedbackCall):
        game.returns()
    if isinstance(game.open_call, ResetCall):
        view = view_for("me", "it", masks=masks)
        game.returns(Begun(b"reset", FRAME, view))
    return view


def _check(game: Game, view: View, mask: list[bool] | None, pressed: int) -> None:
    assert set(game.actions) == view.to_act
    for index, by in game.actions.values():
        assert 0 <= index < len(SPACE)
        if mask is not None and any(mask) and index < len(mask):
            assert mask[index]
        if by == "human":
            assert pressed
    human = game.actions.get("me")
    if human is not None and game.trial.progress.turns is not None and not game.settings.trial.turn_seconds:
        assert human[1] == "human", "no action for a participant who pressed nothing"
