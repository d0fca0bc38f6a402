"""The core with several players, event by event: turns and their clock, late policies, masks, and legal actions in
any order of events."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testing.exploration import examples
from tests.trial.core.test_decisions import FRAME, sent
from trial.core import messages
from trial.core.effects import (
    Begun,
    Call,
    FeedbackCall,
    OpenRecording,
    RecordLine,
    Replayed,
    ResetCall,
    ResetPolicy,
    SaveAnswer,
    SendMessage,
    SendState,
    StepCall,
    StepTaken,
    WriteLog,
)
from trial.core.flow_control import Window
from trial.core.messages import CommandRefused
from trial.core.players import Player, PlayersError, View, who_plays
from trial.core.policies import AskPolicy
from trial.core.trial import Phase, Trial
from trial.core.unfinished import RecordedAction, RecordedStep, RecordedTrial, UnfinishedEpisode
from trial.settings import TrialSettings, trial_section

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


def test_when_turn_seconds_are_over_the_episode_may_end() -> None:
    game = game_in_turns(turnSeconds=5, turnEnds="episode", maxEpisodes=1).playing(view_for("me"))
    game.say(action="up")
    game.stepped(view_for("me"))
    game.wait(5.1)
    (end,) = [one.fields for one in game.all if isinstance(one, RecordLine) and one.kind == "end"]
    assert (end["why"], end["scores"]) == ("turnSeconds", {"me": 1, "it": 2})
    assert game.trial.phase is Phase.FINISHED
    assert game.trial.progress.outcome == "finished"


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


# ---- in real time


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


def test_between_two_choices_a_policys_action_is_held_or_single_as_input_says() -> None:
    for how, expected in (("held", (2, "policy")), ("single", (0, "none"))):
        game = Game(frameSkip=2, input=how)
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
    game.stepped(view_for(), over=True)
    game.returns(Begun(b"reset", FRAME, view_for("me", "it")))
    assert len(game.asks) == 4, "it is asked again in the next episode"


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
