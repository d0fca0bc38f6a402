"""A session's trial, event by event: for whom it waits, when the game begins, is held and ends, and what each member is told."""

from __future__ import annotations

import logging

import pytest

from hippodrome.trial.core import messages
from hippodrome.trial.core.effects import AskPolicy, RecordLine, ResetCall, ResetPolicy, SaveMember, SendDone, WriteLog
from hippodrome.trial.core.history import MESSAGES_KEPT, RecordedTrial
from hippodrome.trial.core.players import policy_seed
from hippodrome.trial.core.session import LEFT, PARTNER_LEFT, PARTNER_MISSING, PARTNER_STOPPED, PING
from hippodrome.trial.core.timing import Window
from hippodrome.trial.core.trial import TRIAL_FAILED, Trial
from hippodrome.trial.recordings.resume import add_lines
from hippodrome.trial.settings import STALLED_SECONDS
from tests.trial.session_driver import SessionDriver

POLICY = {"afterAbsent": "policy", "substitute": "random"}

# ---- the beginning


def test_the_game_begins_by_itself_when_all_are_here_and_have_counted_down():
    driver = SessionDriver().come(0)
    told = driver.state_seen_by(0)
    assert (told["you"], told["people"]) == ("left", {"left": "here", "right": "awaited"})
    assert (told["state"], told["heldFor"]) == ("ready", 60)
    assert "beginsIn" not in told
    driver.wait(10)
    assert driver.taken == []
    driver.come(1)
    assert driver.state_seen_by(0)["people"] == {"left": "here", "right": "here"}
    assert driver.state_seen_by(1)["beginsIn"] == 3
    assert driver.state_seen_by(0).keys().isdisjoint({"heldFor", "turnOf"})
    driver.wait(2.9)
    assert driver.taken == []
    driver.wait(0.1)
    assert len(driver.taken) == 1
    assert [driver.state_seen_by(number)["state"] for number in (0, 1)] == ["playing", "playing"]
    assert "turnOf" not in driver.state_seen_by(0), "in real time it is the turn of all players"


def test_the_start_of_one_member_does_not_begin_the_game_without_the_other():
    driver = SessionDriver().come(0).say(0, command="start").wait(5)
    assert driver.taken == []


def test_a_member_who_leaves_in_the_countdown_ends_it():
    driver = SessionDriver().come(0, 1).wait(2).go(1).wait(2)
    assert driver.taken == []
    driver.come(1).wait(2.9)
    assert driver.taken == []
    assert len(driver.wait(0.2).taken) >= 1


def test_a_member_who_does_not_come_ends_the_game_for_all():
    driver = SessionDriver().come(0).wait(59.9)
    assert not driver.trial.progress.over
    driver.wait(0.2)
    assert driver.outcomes == {"P0": "partnerLeft", "P1": "left"}
    assert driver.errors(0) == [PARTNER_MISSING]
    assert driver.done(0).outcome == "partnerLeft"
    driver.come(1)
    assert driver.done(1).outcome == "left", "who comes too late is sent on"


def test_a_policy_plays_for_a_member_who_does_not_come():
    driver = SessionDriver(**POLICY).come(0).wait(64)
    (ask,) = driver.calls(AskPolicy)
    driver.event("policy_acted", "right", ask.ask_id, 2, driver.now)
    driver.wait(0.1)
    action = driver.taken[-1].actions["right"]
    assert (ask.player, action.index, action.by) == ("right", 2, "policy")
    assert driver.state_seen_by(0)["people"] == {"left": "here", "right": "policy"}
    assert driver.presence() == [("left", "joined"), ("right", "replaced")]


def test_in_a_seat_without_a_member_a_policy_plays_from_the_start():
    driver = SessionDriver(vacant=("right",), **POLICY).come(0)
    assert driver.state_seen_by(0)["people"] == {"left": "here", "right": "policy"}
    assert driver.state_seen_by(0)["beginsIn"] == 3
    driver.wait(4)
    assert len(driver.taken) > 5
    assert [ask.player for ask in driver.calls(AskPolicy)] == ["right"]
    driver.say(0, command="stop").take()
    assert list(driver.outcomes) == ["P0"], "a seat without a member gets no answer"


def test_the_game_begins_when_all_have_gone_on_from_the_instructions():
    driver = SessionDriver(instructions="rules.html").come(0, 1).wait(60)
    assert driver.state_seen_by(0)["people"] == {"left": "reads", "right": "reads"}
    assert driver.taken == []
    driver.say(0, command="start")
    assert driver.state_seen_by(1)["people"] == {"left": "here", "right": "reads"}
    assert driver.state_seen_by(0)["heldFor"] == 60
    driver.wait(50)
    assert driver.taken == []
    driver.say(1, command="start").wait(3)
    assert driver.taken


def test_a_member_who_reads_for_ever_holds_the_others_only_for_gather_seconds():
    driver = SessionDriver(instructions="rules.html").come(0, 1).say(0, command="start").wait(59.9)
    assert "beginsIn" not in driver.state_seen_by(0)
    driver.wait(0.1)
    assert driver.state_seen_by(1)["beginsIn"] == 3
    assert driver.wait(3.1).taken


def test_without_a_substitute_the_game_ends_at_once_if_the_data_of_a_member_were_erased():
    driver = SessionDriver(erased=("right",))
    assert driver.outcomes == {"P0": "partnerLeft"}
    assert driver.lines("end")[-1]["outcomes"] == {"left": "partnerLeft", "right": "left"}
    assert driver.taken == []


def test_the_game_asks_to_be_woken_when_a_countdown_a_wait_or_a_measurement_is_over():
    driver = SessionDriver(maxPing=100, pingSamples=1)
    assert driver.trial.wake_at is None, "nobody waits"
    driver.come(0)
    assert driver.trial.wake_at == 120, "the measurement"
    driver.round_trip(0, 0.02)
    assert driver.trial.wake_at == 160, "the wait for the other"
    driver.come(1).round_trip(1, 0.02)
    assert driver.trial.wake_at == 103, "the countdown"
    driver.wait(3)
    assert driver.trial.wake_at == pytest.approx(103.1), "the next step"
    driver.go(1)
    assert driver.trial.wake_at == pytest.approx(133), "the wait for who has left"
    driver.come(1).say(1, command="pause")
    assert driver.trial.wake_at is None, "a pause has no end"


@pytest.mark.parametrize(("absent", "until"), [(30, 20), (10, 10)])
def test_in_a_break_the_game_asks_to_be_woken_at_the_end_of_the_break_or_of_a_wait(absent, until):
    driver = SessionDriver(betweenEpisodes=20, maxEpisodes=2, absent=absent).begin().take(terminated=True).go(1)
    assert driver.trial.wake_at == pytest.approx(driver.now + until)


def test_a_server_that_ends_waits_for_no_member_any_more():
    driver = SessionDriver().come(0)
    driver.event("close", driver.now)
    assert driver.trial.wake_at is None
    assert driver.answers == []


def test_the_recording_says_at_which_step_a_member_came_or_a_policy_replaced_them():
    driver = SessionDriver(**POLICY).begin().take().go(1).wait(30)
    where = {"episode": 1, "step": 1, "player": "right"}
    assert driver.lines("presence")[0] == {"episode": 1, "step": 0, "player": "left", "what": "joined"}
    assert driver.lines("presence")[-2:] == [
        {**where, "what": "left"},
        {**where, "what": "replaced", "seed": policy_seed(7, "right")},
    ]
    assert driver.calls(WriteLog)[-1] == WriteLog(logging.INFO, "random plays in the place of right")


def test_a_refusal_is_recorded_once():
    driver = SessionDriver(maxPing=100, pingSamples=1, **POLICY).come(0, 1).round_trip(0, 0.02).round_trip(1, 0.2)
    driver.wait(5).go(1).wait(5)
    assert driver.presence().count(("right", "refused")) == 1


def test_players_and_members_that_are_not_there_any_more_are_ignored():
    outcomes = {"gone": "ping", "away": "left", "done": "stopped"}
    driver = SessionDriver(recorded=RecordedTrial(outcomes=outcomes), answered={"P9": {"outcome": "ping"}}).begin()
    assert driver.wait(0.2).taken


def test_a_member_may_come_late_although_absent_is_zero():
    driver = SessionDriver(absent=0).come(0).wait(50).come(1).wait(3.2)
    assert driver.taken
    driver.go(1)
    assert driver.outcomes == {"P0": "partnerLeft", "P1": "left"}


def test_members_who_have_read_the_instructions_also_read_the_page_between_episodes():
    driver = SessionDriver(instructions="rules.html", betweenEpisodes="between.html", maxEpisodes=2).come(0, 1)
    driver.say(0, command="start").say(1, command="start").wait(3.05)
    driver.trial.progress.stepped({}, True, False)
    taken = len(driver.wait(0.2).taken)
    assert driver.state_seen_by(0)["people"] == {"left": "reads", "right": "reads"}
    assert len(driver.wait(30).taken) == taken


def test_members_are_told_times_in_thousandths_of_a_second():
    driver = SessionDriver().come(0).wait(59.4996).say(0, command="requestUI")
    assert driver.state_seen_by(0)["heldFor"] == 0.5, "thousandths, no more"
    driver.come(1).wait(2.5).say(1, command="requestUI")
    assert driver.state_seen_by(1)["beginsIn"] == 0.5


def test_a_substitute_of_an_empty_place_does_not_play_for_members_who_leave():
    driver = SessionDriver(3, vacant=("third",), substitute="random").begin().go(1).wait(30)
    assert driver.outcomes == {"P0": "partnerLeft", "P1": "left"}
    assert driver.state_seen_by(0)["people"] == {"left": "here", "right": "away", "third": "policy"}


# ---- away and back


def test_the_game_is_held_while_a_member_is_away_and_goes_on_with_a_countdown():
    driver = SessionDriver().begin().wait(1)
    driver.go(1)
    held = len(driver.taken)
    told = driver.state_seen_by(0)
    assert (told["state"], told["people"], told["heldFor"]) == ("paused", {"left": "here", "right": "away"}, 30)
    driver.wait(12).come(1)
    assert driver.state_seen_by(0)["beginsIn"] == 3
    driver.wait(2.9)
    assert len(driver.taken) == held
    assert len(driver.wait(0.2).taken) > held
    assert driver.presence()[2:] == [("right", "left"), ("right", "returned")]


def test_the_game_ends_for_all_when_a_member_stays_away():
    driver = SessionDriver().begin().wait(1).go(1).wait(30)
    assert driver.outcomes == {"P0": "partnerLeft", "P1": "left"}
    assert driver.errors(0) == [PARTNER_LEFT]
    assert (driver.done(0).outcome, driver.lines("end")[-1]["why"]) == ("partnerLeft", "partnerLeft")
    assert driver.lines("end")[-1]["outcomes"] == {"left": "partnerLeft", "right": "left"}


def test_a_member_who_returns_too_late_is_told_why_the_game_ended():
    driver = SessionDriver().begin().wait(1).go(1)
    driver.now += 30
    driver.event("advance", driver.now)  # the answers are not stored yet
    driver.event("connect", "P1", "tab1", Window(), driver.now)
    assert driver.errors(1) == [LEFT]


def test_a_policy_takes_an_absent_members_place_and_gives_it_back_at_the_next_step():
    driver = SessionDriver(**POLICY).begin().wait(1).go(1).wait(30)
    assert driver.state_seen_by(0)["people"]["right"] == "policy"
    assert driver.state_seen_by(0)["beginsIn"] == 3
    (ask,) = driver.calls(AskPolicy)
    assert (ask.player, ask.observation) == ("right", driver.steps)
    driver.event("policy_acted", "right", ask.ask_id, 2, driver.now)
    driver.wait(3.05)
    action = driver.taken[-1].actions["right"]
    assert (action.index, action.by) == (2, "policy")
    driver.come(1).say(1, action="up", held=True)
    assert driver.state_seen_by(0)["state"] == "playing", "nobody waits for who comes back"
    driver.wait(0.2)
    action = driver.taken[-1].actions["right"]
    assert (action.index, action.by) == (1, "human")
    assert driver.presence()[-2:] == [("right", "replaced"), ("right", "returned")]


def test_a_failure_of_a_policy_that_plays_for_a_member_is_recorded_with_its_name():
    driver = SessionDriver(**POLICY).begin().wait(1).go(1).wait(30)
    (ask,) = driver.calls(AskPolicy)
    driver.event("policy_failed", "right", ask.ask_id, ValueError("no idea"), driver.now)
    (line,) = driver.lines("error")
    assert line["error"] == "the policy of right (random) failed: ValueError: no idea"


def test_a_policys_answer_that_comes_after_the_return_changes_nothing():
    driver = SessionDriver(**POLICY).begin().wait(1).go(1).wait(30)
    (ask,) = driver.calls(AskPolicy)
    driver.come(1).event("policy_acted", "right", ask.ask_id, 2, driver.now)
    driver.wait(4)
    assert {step.actions["right"].index for step in driver.taken} == {0}


def test_a_policy_that_plays_for_a_member_begins_each_episode_anew():
    driver = SessionDriver(maxEpisodes=3, **POLICY).begin().wait(1).go(1).wait(33.05)
    resets = [effect for effect in driver.all if isinstance(effect, ResetPolicy)]
    assert [(reset.player, reset.seed) for reset in resets] == [("right", driver.lines("presence")[-1]["seed"])]
    driver.trial.progress.stepped({}, True, False)
    driver.wait(0.2)
    resets = [effect for effect in driver.all if isinstance(effect, ResetPolicy)]
    assert len(resets) == 2


def test_no_time_runs_while_all_members_are_gone():
    driver = SessionDriver().begin().wait(1).go(0).wait(10).go(1).wait(3600)
    assert not driver.trial.progress.over
    assert driver.trial.wake_at is None
    driver.come(1)
    assert driver.state_seen_by(1)["heldFor"] == pytest.approx(20, abs=0.01)
    driver.wait(20.1)
    assert driver.outcomes == {"P0": "left", "P1": "partnerLeft"}


def test_a_page_that_stops_answering_is_away_until_it_answers():
    driver = SessionDriver()
    window = Window()
    driver.come(0)
    driver.event("connect", "P1", "tab1", window, driver.now)
    window.sent(1, driver.now)
    window.acknowledged(1, driver.now + 0.05)
    driver.wait(3.05)
    window.sent(2, driver.now)
    driver.wait(STALLED_SECONDS + 0.5)
    assert driver.state_seen_by(0)["people"]["right"] == "away"
    held = len(driver.taken)
    driver.wait(5)
    assert len(driver.taken) == held
    window.acknowledged(2, driver.now)
    driver.say(1, ack=2)
    assert driver.state_seen_by(0)["people"]["right"] == "here"
    assert len(driver.wait(3.1).taken) > held
    assert driver.presence()[2:] == [("right", "left"), ("right", "returned")]
    said = [message for step in driver.taken for message in step.fields.get("messages", ()) if "event" in message]
    assert [each["event"] for each in said if each["player"] == "right"] == ["connected", "stopped answering"]


def test_another_tab_of_a_member_takes_their_own_place():
    driver = SessionDriver().begin().wait(1)
    driver.event("connect", "P1", "tab9", Window(), driver.now)
    taken = len(driver.taken)
    assert len(driver.wait(0.3).taken) > taken, "the others do not wait"
    driver.event("disconnect", "tab1", driver.now)
    assert driver.state_seen_by(0)["people"] == {"left": "here", "right": "here"}


# ---- each member's own actions


def test_a_members_keys_move_their_own_player_alone():
    driver = SessionDriver().begin()
    driver.say(0, action="up", held=True).say(1, action="right", held=True).wait(0.2)
    step = driver.taken[-1].actions
    assert (step["left"].name, step["right"].name) == ("up", "right")
    driver.go(0).come(0).wait(4)
    step = driver.taken[-1].actions
    assert (step["left"].name, step["right"].name) == ("noop", "right"), "only the keys of who left are let go"


def test_a_members_own_keys_of_the_project_move_their_own_player():
    driver = SessionDriver(keys={"x": "up"}).begin().say(1, key="x", held=True).wait(0.2)
    assert {name: action.name for name, action in driver.taken[-1].actions.items()} == {"left": "noop", "right": "up"}


def test_only_the_last_line_says_how_the_trial_has_ended_for_each_member():
    driver = SessionDriver(maxEpisodes=2).begin().take(terminated=True)
    driver.now += 0.1
    driver.event("advance", driver.now)
    driver.take(terminated=True)
    finished = {"left": "finished", "right": "finished"}
    assert [end.get("outcomes") for end in driver.lines("end")] == [None, finished]


def test_an_action_says_when_its_key_was_pressed():
    driver = SessionDriver().begin()
    driver.now += 0.03
    driver.say(1, action="up", held=True)
    pressed = int(driver.now * 1e9)
    driver.wait(0.3)
    assert [step.actions["right"].pressed_at for step in driver.taken[1:3]] == [pressed, pressed]
    assert {step.actions["left"].pressed_at for step in driver.taken} == {None}


def test_messages_and_feedback_name_their_player():
    driver = SessionDriver().begin().say(1, command="good").say(0, command="bad").wait(0.2)
    step = next(step for step in driver.taken if step.feedback)
    assert step.feedback == (("good", "right"), ("bad", "left"))
    said = [(message["player"], message["command"]) for message in step.fields["messages"] if "command" in message]
    assert said == [("right", "good"), ("left", "bad")]


def test_a_member_who_sends_very_many_messages_takes_no_room_from_the_others():
    driver = SessionDriver().begin().wait(0.5).say(0, command="pause")
    for _ in range(MESSAGES_KEPT + 10):
        driver.trial.receive("tab0", messages.Message(command="good"), driver.now)
    driver.say(1, command="bad").say(1, command="start").wait(3.2)
    step = next(step for step in driver.taken if step.fields.get("messagesDropped"))
    said = [message["command"] for message in step.fields["messages"] if message["player"] == "right"]
    assert said == ["bad", "start"]
    assert step.fields["messagesDropped"] > 0


def test_any_member_may_pause_the_game_for_all_and_any_may_go_on():
    driver = SessionDriver().begin().wait(0.5).say(0, command="pause")
    paused = len(driver.taken)
    driver.wait(100)
    assert len(driver.taken) == paused
    assert driver.state_seen_by(1)["state"] == "paused"
    driver.say(1, command="start")
    assert driver.state_seen_by(0)["beginsIn"] == 3
    assert len(driver.wait(3.2).taken) > paused


def test_a_pause_in_a_break_holds_the_next_episode_until_a_member_goes_on():
    driver = SessionDriver(betweenEpisodes=20, maxEpisodes=2).begin()
    driver.take(terminated=True).wait(1).say(0, command="pause")
    assert driver.state_seen_by(1)["state"] == "paused"
    taken = len(driver.taken)
    driver.wait(60)
    assert len(driver.taken) == taken
    assert len(driver.say(1, command="start").wait(3.2).taken) > taken


def test_one_members_stop_ends_the_game_for_all_and_the_answers_say_who_stopped():
    driver = SessionDriver().begin().wait(0.5)
    driver.say(1, command="stop").take()
    assert driver.outcomes == {"P0": "partnerLeft", "P1": "stopped"}
    assert (driver.errors(0), driver.errors(1)) == ([PARTNER_STOPPED], [])
    assert (driver.done(0).outcome, driver.done(1).outcome) == ("partnerLeft", "stopped")
    assert driver.lines("end")[-1]["outcomes"] == {"left": "partnerLeft", "right": "stopped"}


def test_the_next_server_knows_who_has_stopped_the_game():
    first = SessionDriver().begin().wait(0.5)
    first.say(1, command="stop").take()
    second = SessionDriver(recorded=recorded_of(first))
    assert second.outcomes == {"P0": "partnerLeft", "P1": "stopped"}


def test_each_member_has_their_own_score():
    driver = SessionDriver(maxEpisodes=1).begin()
    driver.take(rewards={"left": 3.0, "right": 5.0}, terminated=True)
    answers = dict(driver.answers)
    assert {human: (each["score"], each["player"]) for human, each in answers.items()} == {
        "P0": (3, "left"),
        "P1": (5, "right"),
    }
    assert answers["P1"]["scores"] == {"left": 3, "right": 5}
    assert (driver.done(0).score, driver.done(1).score) == (3, 5)
    assert driver.done(0).outcome == "finished"


def test_a_member_is_told_when_their_own_score_changes():
    driver = SessionDriver().begin().take(rewards={"right": 5.0})
    assert [driver.state_seen_by(number)["score"] for number in (0, 1)] == [0, 5]
    driver.now += 0.1
    driver.event("advance", driver.now)
    driver.take(rewards={"left": -1.0})
    assert [driver.state_seen_by(number)["score"] for number in (0, 1)] == [-1, 5]


def test_a_member_whom_a_policy_replaces_at_the_end_has_left():
    driver = SessionDriver(maxEpisodes=1, **POLICY).begin().wait(1).go(1).wait(33.05)
    driver.trial.progress.stop()
    driver.wait(0.2)
    assert driver.outcomes == {"P0": "stopped", "P1": "left"}


# ---- breaks


def test_a_break_with_a_page_ends_when_all_present_members_have_gone_on():
    driver = SessionDriver(betweenEpisodes="between.html", maxEpisodes=2).begin()
    assert driver.state_seen_by(0)["people"] == {"left": "here", "right": "here"}
    driver.take(terminated=True)
    assert driver.state_seen_by(0)["state"] == "break"
    assert driver.state_seen_by(0)["people"] == {"left": "reads", "right": "reads"}
    taken = len(driver.taken)
    driver.say(0, command="start").wait(10)
    assert driver.state_seen_by(1)["people"] == {"left": "here", "right": "reads"}
    assert driver.state_seen_by(1)["heldFor"] == 60
    assert len(driver.taken) == taken
    driver.say(1, command="start").wait(0.2)
    assert len(driver.taken) > taken


def test_a_page_between_episodes_holds_the_others_for_gather_seconds_at_most():
    driver = SessionDriver(betweenEpisodes="between.html", maxEpisodes=2).begin()
    driver.take(terminated=True).wait(600)
    assert driver.state_seen_by(0)["state"] == "break", "nobody waits yet"
    taken = len(driver.taken)
    driver.say(0, command="start").wait(59.9)
    assert len(driver.taken) == taken
    assert len(driver.wait(0.3).taken) > taken


def test_a_member_who_leaves_in_a_break_does_not_end_it_for_the_others():
    driver = SessionDriver(betweenEpisodes=20, maxEpisodes=2).begin()
    driver.take(terminated=True).wait(5)
    assert driver.state_seen_by(0)["people"] == {"left": "here", "right": "here"}, "there is no page to read"
    driver.go(1)
    assert driver.state_seen_by(0)["state"] == "break"
    driver.wait(16)
    taken = len(driver.taken)
    assert driver.state_seen_by(0)["state"] == "paused"
    driver.come(1).wait(3.2)
    assert len(driver.taken) > taken


# ---- turn by turn


def test_turn_by_turn_all_are_told_whose_turn_it_is():
    driver = SessionDriver(turns=("left", "right"), pace="turns", turnSeconds=20).begin()
    assert [driver.state_seen_by(number)["turnOf"] for number in (0, 1)] == [["left"], ["left"]]
    assert [driver.state_seen_by(number)["toAct"] for number in (0, 1)] == [True, False]
    driver.say(1, action="up")
    assert driver.taken == [], "a press out of turn does nothing"
    driver.say(0, action="right").take()
    assert [driver.state_seen_by(number)["turnOf"] for number in (0, 1)] == [["right"], ["right"]]
    assert driver.state_seen_by(1)["turnEndsIn"] == 20
    assert "turnEndsIn" not in driver.state_seen_by(0)
    driver.say(0, command="pause")
    assert "turnOf" not in driver.state_seen_by(1), "while the game is held it is nobody's"


def test_turn_by_turn_a_policy_chooses_for_a_member_who_stays_away():
    driver = SessionDriver(turns=("left", "right"), pace="turns", **POLICY).begin()
    driver.say(0, action="up").take().go(1).wait(33.5)
    ask = driver.calls(AskPolicy)[-1]
    assert ask.player == "right"
    driver.event("policy_acted", "right", ask.ask_id, 2, driver.now)
    assert driver.taken[-1].actions["right"].index == 2


def test_turn_by_turn_the_choice_of_a_member_who_leaves_stands_and_a_policy_makes_the_next():
    driver = SessionDriver(pace="turns", **POLICY).begin()
    driver.say(0, action="up").go(0).wait(33.5)
    assert driver.calls(AskPolicy) == [], "who has chosen is not asked again"
    driver.say(1, action="right")
    assert {name: action.name for name, action in driver.taken[-1].actions.items()} == {"left": "up", "right": "right"}
    driver.take()
    assert [ask.player for ask in driver.calls(AskPolicy)] == ["left"]


def test_turn_by_turn_a_choice_says_when_it_was_made():
    driver = SessionDriver(pace="turns").begin()
    driver.now += 0.5
    driver.say(0, action="up")
    driver.now += 0.25
    driver.say(1, action="right", held=True)
    pressed = {name: action.pressed_at for name, action in driver.taken[-1].actions.items()}
    assert pressed == {"left": 103_500_000_000, "right": 103_750_000_000}


def test_turn_by_turn_the_game_waits_for_all_who_are_to_act():
    driver = SessionDriver(pace="turns").begin()
    assert driver.state_seen_by(0)["turnOf"] == ["left", "right"]
    driver.say(0, action="up")
    assert (driver.state_seen_by(1)["turnOf"], driver.state_seen_by(1)["toAct"]) == (["right"], True)
    assert (driver.state_seen_by(0)["toAct"], driver.taken) == (False, [])
    assert "turnEndsIn" not in driver.state_seen_by(0)


# ---- a step that was played already


def test_members_who_come_to_a_step_that_an_earlier_server_has_stored_are_sent_on_with_their_own_answer():
    driver = SessionDriver()
    trial = Trial(driver.settings, "3", trial_id="the-trial", new_seed=lambda: 7)
    trial.already_played(
        {
            "P0": {"episodes": 2, "score": 5, "scores": {"left": 5, "right": 8}, "outcome": "finished"},
            "P1": {"outcome": "failed"},
        }
    )
    assert trial.connect("P0", "tab0", Window(), 100.0) == [SendDone("tab0", 2, 5, "finished")]
    assert trial.connect("P1", "tab1", Window(), 100.0) == [SendDone("tab1", 0, 0, "failed", TRIAL_FAILED)]
    assert trial.connect("P2", "tab2", Window(), 100.0) == [SendDone("tab2", 0, 0.0)], "there is none of theirs"


# ---- round trips


def test_coming_and_going_does_not_use_up_the_twenty_seconds():
    driver = SessionDriver(maxPing=100, pingSamples=2, **POLICY).come(0).round_trip(0, 0.02).round_trip(0, 0.02)
    for _ in range(5):
        driver.come(1).go(1)
    driver.come(1).wait(19.9)
    assert driver.state_seen_by(0)["people"]["right"] == "awaited"
    assert driver.wait(0.1).state_seen_by(0)["people"]["right"] == "policy"


def test_a_member_with_too_long_a_round_trip_is_refused_before_the_game():
    driver = SessionDriver(maxPing=100, pingSamples=3).come(0, 1)
    for seconds in (0.02, 0.5, 0.03):
        driver.round_trip(0, seconds)
    assert driver.state_seen_by(1)["people"] == {"left": "here", "right": "awaited"}
    for seconds in (0.3, 0.05, 0.101):
        driver.round_trip(1, seconds)
    assert driver.outcomes == {"P0": "partnerLeft", "P1": "ping"}
    assert (driver.errors(1), driver.errors(0)) == ([PING], [PARTNER_MISSING])
    assert driver.done(1).outcome == "ping"


def test_with_a_substitute_a_refused_member_goes_on_at_once_and_the_others_play():
    driver = SessionDriver(maxPing=100, pingSamples=1, **POLICY).come(0, 1).round_trip(0, 0.02).round_trip(1, 0.2)
    assert driver.answers == [("P1", {**dict(driver.answers)["P1"], "outcome": "ping", "player": "right"})]
    assert (driver.errors(1), driver.errors(0)) == ([PING], [])
    assert [one.later for one in driver.calls(SaveMember)] == [{"outcome": "ping", "player": "right"}]
    assert driver.done(1) is None
    driver.event("member_saved", "P1", driver.now)
    assert driver.done(1).outcome == "ping"
    driver.say(1, command="stop").wait(3.2)
    assert driver.taken, "what the refused says does not count"
    driver.say(0, command="stop").take()
    assert [human for human, _ in driver.answers] == ["P1", "P0"]
    assert (driver.done(0).outcome, driver.done(1).outcome) == ("stopped", "ping")


def test_a_member_goes_on_when_their_own_answer_is_stored_and_hears_so_once():
    driver = SessionDriver().begin()
    driver.stores = False
    driver.say(0, command="stop").take()
    driver.event("member_saved", "P0", driver.now)
    assert (driver.done(0).outcome, driver.done(1)) == ("stopped", None)
    driver.go(0).come(0)
    assert driver.done(0).outcome == "stopped", "also on another page"
    assert driver.trial.saving, "the server must stay"
    driver.event("member_saved", "P1", driver.now)
    assert driver.done(1).outcome == "partnerLeft"
    told = driver.count(SendDone)
    driver.event("answer_saved", driver.now)
    assert driver.trial.finished
    driver.event("member_saved", "P1", driver.now)
    assert driver.count(SendDone) == told


def test_a_round_trip_of_exactly_max_ping_is_short_enough():
    driver = SessionDriver(maxPing=100, pingSamples=1).come(0, 1).round_trip(0, 0.1).round_trip(1, 0.1)
    assert driver.state_seen_by(0)["beginsIn"] == 3


def test_if_all_are_refused_no_policies_play_alone():
    driver = (
        SessionDriver(maxPing=100, pingSamples=1, **POLICY).come(0, 1).round_trip(0, 0.2).round_trip(1, 0.3).wait(10)
    )
    assert driver.outcomes == {"P0": "ping", "P1": "ping"}
    assert driver.taken == []
    assert driver.trial.progress.over


def test_after_a_refusal_no_policy_replaces_the_only_other_member_while_they_are_away():
    driver = (
        SessionDriver(maxPing=100, pingSamples=1, **POLICY).come(0, 1).round_trip(0, 0.02).round_trip(1, 0.2).wait(4)
    )
    driver.go(0).wait(3600)
    assert driver.presence()[-1] == ("left", "left"), "no policy has taken the place"
    assert driver.come(0).state_seen_by(0)["beginsIn"] == 3


def test_policies_do_not_play_while_the_only_member_is_still_measured():
    driver = SessionDriver(maxPing=100, pingSamples=2, gather=10, **POLICY).come(1).round_trip(1, 0.02).wait(19)
    assert driver.taken == []
    assert driver.round_trip(1, 0.02).wait(3.2).taken
    assert driver.state_seen_by(1)["people"] == {"left": "policy", "right": "here"}


@pytest.mark.parametrize("gather", [0, 0.05])
def test_with_little_time_to_gather_each_member_is_measured_and_plays_from_then_on(gather):
    """A policy plays in the place of the second until they come, and never in that of the first."""
    driver = SessionDriver(maxPing=100, pingSamples=3, gather=gather, **POLICY).come(0).wait(0.1)
    assert driver.state_seen_by(0)["people"] == {"left": "awaited", "right": "policy"}
    driver.come(1)
    for number in (0, 1) * 3:
        driver.wait(0.2).round_trip(number, 0.05)
    assert driver.wait(3.2).taken
    assert driver.state_seen_by(0)["people"] == {"left": "here", "right": "here"}
    assert ("left", "replaced") not in driver.presence()


@pytest.mark.parametrize("max_ping", [0, 100])
def test_with_no_time_to_gather_the_game_ends_for_the_first_member_without_their_fault(max_ping):
    """The game does not wait at all for a member who is not connected; `make check` says so."""
    driver = SessionDriver(gather=0, maxPing=max_ping).come(0)
    assert driver.outcomes == {"P0": "partnerLeft", "P1": "left"}
    assert driver.errors(0) == [PARTNER_MISSING]


def test_the_time_of_a_member_does_not_run_while_their_round_trip_is_measured():
    driver = SessionDriver(maxPing=100, pingSamples=2).come(0).round_trip(0, 0.02).round_trip(0, 0.02).wait(59.9)
    driver.come(1).round_trip(1, 0.02).wait(10)
    assert "heldFor" not in driver.state_seen_by(0)
    assert driver.state_seen_by(0)["people"]["right"] == "awaited"
    assert driver.round_trip(1, 0.02).wait(3.2).taken


def test_the_time_of_a_member_runs_on_if_they_leave_while_they_are_measured():
    driver = SessionDriver(maxPing=100, pingSamples=2).come(0).round_trip(0, 0.02).round_trip(0, 0.02).wait(30)
    driver.come(1).round_trip(1, 0.02).wait(19).go(1)
    assert driver.state_seen_by(0)["heldFor"] == 30
    assert driver.wait(30).outcomes == {"P0": "partnerLeft", "P1": "left"}


@pytest.mark.parametrize("section", [{}, {"absent": 0}, {"gather": 3}], ids=str)
def test_a_member_who_reconnects_and_is_never_measured_does_not_hold_the_others_for_ever(section):
    driver = SessionDriver(maxPing=100, pingSamples=2, **section).come(0).round_trip(0, 0.02).round_trip(0, 0.02)
    for _ in range(30):
        driver.come(1).wait(9).go(1)
    assert driver.trial.progress.over


@pytest.mark.parametrize(("samples", "until"), [(1, 1), (2, 2), (3, 2), (5, 3), (100, 51)])
def test_a_member_who_answers_no_ping_is_refused_as_soon_as_the_median_is_certain(samples, until):
    driver = SessionDriver(maxPing=100, pingSamples=samples, **POLICY).come(0, 1)
    for number in range(samples):
        driver.round_trip(0, 0.02)
        if number < until:
            assert driver.state_seen_by(1)["people"]["right"] == "awaited"
            driver.round_trip(1, 10.0)
    assert driver.state_seen_by(0)["people"]["right"] == "policy"
    assert driver.errors(1) == [PING]


@pytest.mark.parametrize("samples", [5, 100])
def test_a_member_who_answers_no_ping_holds_the_others_for_twenty_seconds_whatever_the_samples(samples):
    driver = SessionDriver(maxPing=100, pingSamples=samples, **POLICY).come(0)
    for _ in range(samples):
        driver.round_trip(0, 0.02)
    driver.come(1).wait(10).round_trip(1, 10.0).wait(9.9)
    assert (driver.state_seen_by(0)["people"]["right"], driver.errors(1)) == ("awaited", [])
    driver.wait(0.1)
    assert (driver.state_seen_by(0)["people"]["right"], driver.errors(1)) == ("policy", [PING])


def test_the_twenty_seconds_count_over_all_connections_of_a_member_but_not_their_absences():
    driver = SessionDriver(maxPing=100, pingSamples=5, **POLICY).come(0)
    for _ in range(5):
        driver.round_trip(0, 0.02)
    driver.come(1).wait(9).go(1).wait(5).come(1).wait(9).go(1).wait(5).come(1).wait(1.9)
    assert driver.state_seen_by(0)["people"]["right"] == "awaited"
    assert driver.wait(0.1).state_seen_by(0)["people"]["right"] == "policy"
    assert driver.errors(1) == [PING]


@pytest.mark.parametrize("trips", [(10.0, 0.02, 0.03), (0.02, 10.0, 0.05, 9.0), (0.02, 9.9, 0.02, 9.9)], ids=str)
def test_a_phone_that_is_slow_at_times_plays_also_if_the_twenty_seconds_end_before_its_samples(trips):
    """It plays although half of its samples were slow."""
    driver = SessionDriver(maxPing=100, pingSamples=100, **POLICY).come(0)
    for _ in range(100):
        driver.round_trip(0, 0.02)
    driver.come(1)
    began = driver.now
    for seconds in trips:
        driver.wait(seconds).round_trip(1, seconds)
    driver.wait(began + 19.95 - driver.now)
    assert driver.state_seen_by(0)["people"]["right"] == "awaited"
    driver.wait(0.1)
    assert driver.state_seen_by(0)["people"]["right"] == "here"
    assert driver.wait(3.2).taken


def test_a_round_trip_that_comes_after_the_end_changes_no_outcome():
    driver = SessionDriver(maxPing=100, pingSamples=1).come(0).round_trip(0, 0.02).wait(59.9)
    driver.say(0, command="good").now += 1
    driver.event("advance", driver.now)  # the agent hears the last feedback
    driver.event("round_trip", "P1", 9.0, driver.now)
    driver.event("connect", "P1", "tab1", Window(), driver.now)
    assert driver.errors(1)[-1] == LEFT


def test_a_member_who_takes_their_place_back_from_a_policy_plays_at_once_at_any_round_trip():
    driver = SessionDriver(maxPing=100, pingSamples=1, **POLICY).come(0).round_trip(0, 0.02).wait(64)
    driver.come(1)
    assert (driver.state_seen_by(0)["state"], driver.state_seen_by(0)["people"]["right"]) == ("playing", "here")
    driver.round_trip(1, 9.0).wait(0.2)
    assert driver.state_seen_by(0)["people"]["right"] == "here"


@pytest.mark.parametrize("trips", [(0.01, 0.03, 0.02), (0.3, 0.01, 0.03, 0.0)])
def test_the_median_of_the_round_trips_is_recorded_when_the_game_begins(trips):
    driver = SessionDriver(pingSamples=len(trips)).come(0, 1)
    for seconds in trips:
        driver.round_trip(1, seconds)
    driver.wait(3.2)
    assert driver.lines("ping")[0]["roundTrip"] == {"right": 20}


def test_in_the_game_each_round_trip_is_recorded_in_milliseconds():
    driver = SessionDriver().begin().wait(1).round_trip(0, 0.6).wait(0.2)
    (line,) = driver.lines("ping")
    assert line["roundTrip"] == {"left": 600}
    assert line["step"] > 0
    assert driver.presence() == [("left", "joined"), ("right", "joined")], "it moves no one"


def test_an_episode_begins_with_the_latest_round_trips_and_the_replaced_players():
    driver = SessionDriver(maxEpisodes=2, pingSamples=1, **POLICY).come(0, 1).round_trip(0, 0.6).wait(3.2)
    driver.round_trip(0, 0.9).round_trip(1, 0.05).go(1).wait(34)
    driver.trial.progress.stepped({}, True, False)
    driver.wait(0.2)
    first, second = driver.calls(ResetCall)
    assert first.fields == {}
    assert second.fields == {"roundTrip": {"left": 900, "right": 50}, "standIns": ["right"]}


@pytest.mark.parametrize(("why", "goes"), [
    ("their round trip is too long", lambda driver: driver.round_trip(0, 0.02).round_trip(1, 0.2)),
    ("they stay away", lambda driver: driver.round_trip(0, 0.02).go(1).wait(60)),
], ids=["ping", "away"])  # fmt: skip
def test_the_log_says_why_the_game_ends_for_all(why, goes):
    driver = SessionDriver(maxPing=100, pingSamples=1).come(0, 1)
    goes(driver)
    assert driver.calls(WriteLog)[0].text == f"the game ends for all without right: {why}"


def test_a_long_round_trip_during_the_game_changes_nothing():
    driver = SessionDriver(maxPing=100, pingSamples=1).come(0, 1).round_trip(0, 0.02).round_trip(1, 0.02).wait(3.5)
    driver.round_trip(1, 9.0).wait(0.2)
    assert not driver.trial.progress.over


# ---- another server goes on


def recorded_of(driver, *, ended=True):
    """Return the trial that the next server reads from this one's lines; the agent's own lines are made up."""
    lines = [{"kind": "reset", "episode": 1, "seed": 7}]
    part = {"action": 0, "reward": 1.0}
    for number in range(1, driver.steps + 1):
        lines.append({"kind": "step", "episode": 1, "step": number, "human": None, "action": 0, "reward": 1.0,
                      "players": dict.fromkeys(driver.names, part)})  # fmt: skip
    kinds = ("presence", "end", "break") if ended else ("presence",)
    effects = [effect for effect in driver.all if isinstance(effect, RecordLine) and effect.kind in kinds]
    found = RecordedTrial()
    add_lines(found, [*lines, *({"kind": effect.kind, **effect.fields} for effect in effects)])
    return found


def test_the_next_server_waits_for_all_members_again_without_the_instructions():
    first = SessionDriver(instructions="rules.html").come(0, 1)
    first.say(0, command="start").say(1, command="start").wait(5)
    second = SessionDriver(instructions="rules.html", recorded=recorded_of(first, ended=False)).come(0)
    assert second.trial.progress.steps == first.steps
    assert second.state_seen_by(0)["people"] == {"left": "here", "right": "awaited"}
    second.come(1)
    assert second.state_seen_by(1)["beginsIn"] == 3
    assert second.wait(3.1).taken[0].fields["step"] == first.steps + 1


def test_a_policy_that_replaces_a_member_on_the_next_server_has_the_seed_of_the_episode():
    first = SessionDriver(**POLICY).begin().wait(1)
    second = SessionDriver(recorded=recorded_of(first, ended=False), **POLICY).begin().go(1).wait(30)
    assert second.lines("presence")[-1]["seed"] == policy_seed(7, "right")


def test_a_game_that_had_not_begun_begins_on_the_next_server_as_on_the_first():
    """Members gather, read and are measured there. A server that waits for them has begun an episode, without a step."""
    section = {"instructions": "rules.html", "maxPing": 100, "pingSamples": 1, "absent": 5, "gather": 60}
    first = SessionDriver(**section).come(0).round_trip(0, 0.02).wait(50)
    second = SessionDriver(**section, recorded=recorded_of(first, ended=False)).come(0).round_trip(0, 0.02)
    assert second.state_seen_by(0)["heldFor"] == 60
    assert second.state_seen_by(0)["people"] == {"left": "reads", "right": "awaited"}
    second.wait(30).come(1)
    assert second.state_seen_by(1)["people"] == {"left": "reads", "right": "awaited"}, "who is measured"
    second.round_trip(1, 0.2)
    assert second.outcomes == {"P0": "partnerLeft", "P1": "ping"}
    assert second.errors(0) == [PARTNER_MISSING]


def test_a_game_that_has_ended_for_all_is_over_on_the_next_server_too():
    first = SessionDriver().begin().wait(1).go(1).wait(30)
    second = SessionDriver(recorded=recorded_of(first))
    assert second.outcomes == first.outcomes == {"P0": "partnerLeft", "P1": "left"}
    second.come(0, 1)
    assert (second.done(0).outcome, second.done(1).outcome) == ("partnerLeft", "left")
    assert second.taken == []


def test_a_game_that_has_ended_in_a_break_is_over_on_the_next_server_too():
    first = SessionDriver(betweenEpisodes=60, maxEpisodes=2).begin()
    first.take(terminated=True).go(1).wait(31)
    assert first.lines("break")[-1]["why"] == "partnerLeft"
    second = SessionDriver(betweenEpisodes=60, maxEpisodes=2, recorded=recorded_of(first))
    assert second.outcomes == {"P0": "partnerLeft", "P1": "left"}


def test_a_refused_member_is_refused_on_the_next_server_too():
    section = {"maxPing": 100, "pingSamples": 1, **POLICY}
    first = SessionDriver(**section).come(0, 1).round_trip(0, 0.02).round_trip(1, 0.2).wait(4)
    second = SessionDriver(**section, recorded=recorded_of(first, ended=False)).come(0)
    second.wait(3.2)
    assert second.taken, "the others do not wait for them"
    second.event("member_saved", "P1", second.now)
    second.come(1)
    assert (second.errors(1), second.done(1).outcome) == ([PING], "ping")


def test_a_member_who_was_refused_in_an_earlier_game_is_refused_in_this_one_too():
    answered = {"P1": {"outcome": "ping", "player": "right"}}
    driver = (
        SessionDriver(maxPing=100, pingSamples=1, answered=answered, **POLICY).come(0).round_trip(0, 0.02).wait(3.2)
    )
    assert driver.taken, "the others do not wait for them"
    driver.come(1)
    assert (driver.errors(1), driver.done(1).outcome) == ([PING], "ping")
    driver.say(0, command="stop").take()
    assert driver.outcomes == {"P0": "stopped"}, "the answer that is there stays"
    assert ("right", "refused") in driver.presence()


def test_a_member_with_an_answer_that_is_no_refusal_plays():
    driver = SessionDriver(answered={"P1": {"outcome": "finished"}}, **POLICY).begin().wait(0.2)
    assert driver.taken
    assert driver.state_seen_by(0)["people"] == {"left": "here", "right": "here"}


def test_the_next_server_knows_whose_feedback_the_agent_has_not_heard():
    lines = [
        {"kind": "reset", "episode": 1, "seed": 7},
        {"kind": "end", "episode": 1, "why": "shutdown", "messages": [{"command": "good", "player": "right"}]},
    ]
    found = RecordedTrial()
    add_lines(found, lines)
    driver = SessionDriver(recorded=found).begin().wait(0.2)
    assert driver.taken[0].feedback == (("good", "right"),)


@pytest.mark.parametrize("seconds", [0, 70])
def test_each_page_between_episodes_waits_for_all_anew(seconds):
    """Also after an episode that takes longer than `gather`."""
    driver = SessionDriver(betweenEpisodes="between.html", maxEpisodes=3).begin()
    for _ in range(2):
        driver.take(terminated=True)
        assert driver.state_seen_by(0)["people"] == {"left": "reads", "right": "reads"}
        taken = len(driver.taken)
        driver.say(0, command="start").wait(5)
        assert len(driver.taken) == taken
        driver.say(1, command="start").wait(0.15)
        assert len(driver.taken) > taken
        driver.take().wait(seconds).take()
        driver.now = max(driver.now, driver.trial.wake_at or 0.0)
        driver.event("advance", driver.now)


def test_a_pause_in_the_countdown_is_told_at_once():
    driver = SessionDriver().come(0, 1).say(0, command="pause")
    assert "beginsIn" not in driver.state_seen_by(1)


def test_after_a_break_no_step_is_taken_without_a_missing_member():
    driver = SessionDriver(betweenEpisodes="between.html", maxEpisodes=2).begin()
    driver.take(terminated=True).go(1)
    taken = len(driver.taken)
    driver.say(0, command="start").wait(20)
    assert len(driver.taken) == taken
    assert driver.state_seen_by(0)["state"] == "paused"
