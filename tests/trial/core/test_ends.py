"""How episodes and trials end, fail, are closed, and go on after an earlier server, event by event."""

import pytest

from hippodrome.trial.core.effects import (
    AgentTimeout,
    Call,
    CloseRecording,
    FeedbackCall,
    LogAgentError,
    OpenRecording,
    RecordLine,
    ReplayCall,
    Replayed,
    ResetCall,
    SaveAnswer,
    SendDone,
    SendPicture,
    SendState,
    StepTaken,
    TellAgent,
    WriteLine,
    WriteLog,
)
from hippodrome.trial.core.history import Break, Episode, RecordedTrial, UnfinishedEpisode, Word
from hippodrome.trial.core.players import PLAYER, alone
from hippodrome.trial.core.trial import TRIAL_FAILED, Phase
from tests.trial.core.trial_driver import FRAME, SPACE, STEPS, Driver, recorded, sent

# ---- episodes and the end


def test_the_last_episode_ends_the_trial_and_its_answer_is_stored_after_the_recording():
    driver = Driver(maxEpisodes=1).playing()
    driver.now += 0.5
    effects = driver.step(reward=2.5, terminated=True)
    kinds = [type(effect) for effect in effects]
    assert kinds == [WriteLine, SendPicture, RecordLine, CloseRecording, SaveAnswer, SendState]
    assert driver.of(SaveAnswer)[0].answers == {
        "episodes": 1,
        "score": 2.5,
        "frames": 1,
        "seconds": 0.1,
        "trial": "the-trial",
        "outcome": "finished",
    }
    assert driver.trial.saving
    assert not Driver().playing().trial.saving
    assert driver.event("answer_saved", driver.now)[-1] == SendDone("tab", 1, 2.5)
    assert driver.trial.finished


def test_a_break_begins_the_next_episode_by_itself():
    driver = Driver(betweenEpisodes=3).playing()
    driver.step(terminated=True)
    (state,) = sent(driver.effects, SendState)
    assert (state["state"], state["nextIn"]) == ("break", 3.0)
    assert driver.trial.wake_at == driver.now + 3
    assert driver.wait(2.9) == []
    driver.wait(0.2)
    assert isinstance(driver.call, ResetCall)
    assert driver.call.episode == 2
    assert [over["why"] for over in driver.records("break")] == ["over"]
    driver.reset()
    driver.step(terminated=True)
    assert sent(driver.effects, SendState)[-1]["nextIn"] == 3.0, "each break has its own time"


def test_each_episode_has_its_file_and_a_break_belongs_to_the_one_before():
    driver = Driver(betweenEpisodes=3, dataFile="episode").playing()
    driver.step(terminated=True)
    assert driver.of(CloseRecording) == []
    driver.say(command="start")
    kinds = [type(effect) for effect in driver.effects if not isinstance(effect, SendState)]
    assert kinds == [RecordLine, CloseRecording, OpenRecording, ResetCall]


def test_all_episodes_of_a_trial_may_have_one_file():
    driver = Driver(dataFile="trial", maxEpisodes=2, betweenEpisodes=3).playing()
    driver.step(terminated=True)
    driver.wait(3)
    driver.reset()
    driver.step(terminated=True)
    kinds = [type(effect) for effect in driver.all]
    assert (kinds.count(OpenRecording), kinds.count(CloseRecording)) == (1, 1)
    assert kinds.index(CloseRecording) == kinds.index(SaveAnswer) - 1


def test_what_is_said_while_the_agent_hears_the_last_feedback_belongs_to_the_next_episode():
    driver = Driver().playing()
    driver.say(command="good")
    driver.step(terminated=True)
    driver.say(command="bad")
    driver.returns()
    (end,) = driver.records("end")
    assert [message["command"] for message in end["messages"]] == ["good"]
    driver.reset()
    driver.wait(0.1)
    assert [message["command"] for message in driver.call.fields["messages"]] == ["bad"]
    assert driver.call.feedback == (Word("bad"),)


def test_feedback_after_the_last_step_is_heard_before_the_episode_ends():
    driver = Driver(maxEpisodes=1).playing()
    driver.say(command="good")  # the step is under way
    driver.step(terminated=True)
    assert isinstance(driver.call, FeedbackCall)
    assert driver.call.feedback == (Word("good"),)
    assert driver.records("end") == []
    driver.returns()
    (end,) = driver.records("end")
    assert [message.get("command") for message in end["messages"]] == ["good"]


def test_a_trial_is_played_when_its_last_line_is_written_and_finished_when_its_answer_is_stored():
    driver = Driver(maxEpisodes=1).playing()
    trial = driver.trial
    driver.say(command="good")
    assert (trial.played, trial.saving, trial.finished) == (False, False, False)
    driver.step(terminated=True)
    assert (trial.played, trial.saving, trial.finished) == (False, True, False), "the agent hears the last feedback"
    driver.returns()
    assert (trial.played, trial.saving, trial.finished) == (True, True, False)
    driver.event("answer_saved", driver.now)
    assert (trial.played, trial.saving, trial.finished) == (True, False, True)
    assert trial.done
    driver = Driver()
    driver.event("already_played", {})
    assert driver.trial.played


def test_a_trial_that_is_closed_is_not_played():
    driver = Driver().playing()
    driver.step()
    driver.event("close", driver.now)
    assert not driver.trial.played


def test_the_log_says_how_a_trial_has_ended():
    driver = Driver(maxEpisodes=1).playing()
    driver.step(terminated=True)
    log = driver.event("answer_saved", driver.now)[0]
    assert isinstance(log, WriteLog)
    assert "finished" in log.text


def test_a_game_that_is_over_refuses_feedback_and_ignores_commands():
    driver = Driver(maxEpisodes=1).playing()
    driver.step(terminated=True)
    words = "the game is over, and no command has an effect any more"
    assert sent(driver.say(command="good")) == [{"error": words}]
    assert driver.say(command="stop") == driver.say(command="start") == []


def test_a_client_that_comes_after_the_end_is_sent_on_at_once():
    driver = Driver(maxEpisodes=1).playing()
    driver.step(reward=3.0, terminated=True)
    driver.event("answer_saved", driver.now)
    assert driver.connect("phone", player="P2") == [SendDone("phone", 1, 3.0)]


# ---- the agent's callbacks


def with_callbacks(**section):
    driver = Driver(**section).begin()
    driver.trial.callbacks = True
    driver.reset()
    return driver


def test_callbacks_hear_that_a_participant_comes_leaves_and_returns():
    driver = with_callbacks()
    driver.connect()
    assert driver.of(TellAgent) == [TellAgent("on_join", PLAYER)]
    driver.connect("other tab")
    assert driver.of(TellAgent) == [TellAgent("on_leave", PLAYER), TellAgent("on_return", PLAYER)]
    driver.event("disconnect", "other tab", driver.now)
    assert driver.of(TellAgent) == [TellAgent("on_leave", PLAYER)]
    driver.trial.callbacks = False
    driver.connect()
    assert driver.of(TellAgent) == []


def test_a_form_is_recorded_and_told_and_refused_if_the_game_has_no_such_page():
    driver = with_callbacks(betweenEpisodes="beliefs", maxEpisodes=2)
    driver.connect()
    driver.say(command="start")
    driver.step(terminated=True)
    driver.returns()
    driver.say(form={"page": "betweenEpisodes", "fields": {"belief": "7", "why": ["a", "b"]}})
    assert driver.of(TellAgent) == [TellAgent("on_form", PLAYER, {"belief": "7", "why": ["a", "b"]})]
    driver.say(form={"page": "instructions", "fields": {"belief": "8"}})
    assert driver.of(TellAgent) == []
    driver.say(command="start")
    driver.returns()
    lines = [effect.fields for effect in driver.all if isinstance(effect, RecordLine)]
    assert [message["form"] for line in lines for message in line.get("messages", ()) if "form" in message] == [
        {"page": "betweenEpisodes", "fields": {"belief": "7", "why": ["a", "b"]}}
    ]


def test_callbacks_hear_of_each_episode_and_break_that_is_over_and_which_is_the_last():
    driver = with_callbacks(betweenEpisodes=3, maxEpisodes=2)
    driver.connect()
    driver.say(command="start")
    told = []
    for _ in range(2):
        driver.step(terminated=True)
        told.append((driver.call.over, driver.call.last))
        driver.returns()
        if not driver.trial.progress.over:
            driver.wait(3)
            told.append((driver.call.over, driver.call.last))
            driver.returns()
            driver.reset()
    episodes = [Episode(number, 1, 1.0, "terminated") for number in (1, 2)]
    assert told == [(episodes[0], False), (Break(1, "over"), False), (episodes[1], True)]
    assert driver.of(SaveAnswer)


def test_callbacks_hear_nothing_any_more_of_a_game_that_is_over_or_an_agent_that_hangs():
    driver = with_callbacks()
    driver.connect()
    driver.say(command="start")
    driver.fails(AgentTimeout("no answer within 30 s"))
    driver.connect("other tab")
    assert driver.of(TellAgent) == []
    driver = with_callbacks(maxEpisodes=1)
    driver.connect()
    driver.say(command="start")
    driver.step(terminated=True)
    driver.returns()
    driver.connect("other tab")
    assert driver.of(TellAgent) == []


# ---- what fails


def test_an_error_in_the_last_feedback_is_recorded_with_its_episode_and_the_game_goes_on():
    driver = Driver().playing()
    driver.say(command="good")
    driver.step(terminated=True)
    error = ValueError("no ears")
    effects = driver.fails(error)
    assert LogAgentError(error) in effects
    assert driver.records("error") == [{"episode": 1, "step": 0, "error": "ValueError: no ears"}]
    assert [over["why"] for over in driver.records("end")] == ["terminated"]
    assert sent(effects) == []
    assert isinstance(driver.call, ResetCall)


def test_a_reset_that_fails_is_tried_again_and_the_third_failure_ends_the_trial():
    driver = Driver().begin()
    driver.connect()
    for _ in range(2):
        driver.fails(ValueError("no level"))
        assert isinstance(driver.call, ResetCall)
        assert not driver.trial.progress.over
    driver.fails(ValueError("no level"))
    assert driver.trial.progress.outcome == "failed"
    assert driver.of(SaveAnswer) == [SaveAnswer(None)], "no one has seen a picture"
    assert [error["step"] for error in driver.records("error")] == [0, 0, 0]


def test_an_error_is_recorded_with_its_notes():
    driver = Driver().playing()
    error = ValueError("oops")
    error.add_note("in level 3")
    driver.fails(error)
    assert driver.records("error")[0]["error"] == "ValueError: oops\nin level 3"


def test_an_error_is_recorded_with_two_thousand_characters_at_most():
    driver = Driver().playing()
    driver.fails(ValueError("x" * 5000))
    (error,) = driver.records("error")
    assert error["error"] == "ValueError: " + "x" * (2000 - len("ValueError: "))


def test_an_error_of_the_agent_ends_the_episode_and_the_next_begins():
    driver = Driver().playing()
    driver.step()
    driver.wait(0.1)
    error = ValueError("oops")
    effects = driver.fails(error)
    assert LogAgentError(error) in effects
    assert "this game has ended" in sent(effects)[0]["error"]
    assert driver.records("error") == [{"episode": 1, "step": 1, "error": "ValueError: oops"}]
    assert driver.records("end")[0]["why"] == "failed"
    assert isinstance(driver.call, ResetCall)


def test_an_agent_that_hangs_ends_the_trial_and_is_called_no_more():
    driver = Driver().playing()
    driver.say(command="good")
    effects = driver.fails(AgentTimeout("no answer within 30 s"))
    assert "the game ends here" in sent(effects)[0]["error"]
    assert not driver.of(Call), "not even for the feedback"
    assert driver.of(SaveAnswer)[0].answers["outcome"] == "failed"
    assert sent(driver.connect("tab again"))[1] == sent(effects)[0], (
        "a client that connects after the failure gets the same message"
    )
    done = driver.event("answer_saved", driver.now)[-1]
    assert done == SendDone("tab again", 0, 0, words=TRIAL_FAILED), "the end says so as well"


def test_an_agent_that_hangs_on_feedback_ends_the_trial_after_the_episode():
    driver = Driver().playing()
    driver.say(command="good")
    driver.step(terminated=True)
    driver.fails(AgentTimeout("no answer within 30 s"))
    assert [over["why"] for over in driver.records("end")] == ["terminated", "failed"]
    assert driver.of(SaveAnswer)[0].answers["outcome"] == "failed"
    assert not driver.of(Call)


def test_a_call_that_comes_back_after_its_time_changes_nothing():
    driver = Driver().playing()
    late = driver.call
    driver.fails(AgentTimeout("no answer within 30 s"))
    assert driver.event("call_returned", late, StepTaken({PLAYER: 5.0}, False, False, FRAME, b"late"), driver.now) == []
    assert driver.event("call_failed", late, ValueError("late"), driver.now) == []
    assert driver.trial.progress.score == 0
    assert len(driver.records("error")) == 1


def test_feedback_that_the_agent_has_heard_is_not_told_again_after_an_error():
    driver = Driver().playing()
    driver.say(command="good")
    driver.say(command="bad")
    driver.step()
    driver.wait(0.1)
    driver.call.heard = 1
    driver.fails(ValueError("of the first word"))
    assert isinstance(driver.call, FeedbackCall)
    assert driver.call.feedback == (Word("bad"),)


# ---- an earlier server


def test_an_episode_of_an_earlier_server_is_replayed_and_goes_on():
    driver = Driver().begin(recorded(STEPS, unheard=[Word("good")]))
    assert isinstance(driver.call, ReplayCall)
    assert driver.call.unfinished.seed == 11
    assert not driver.trial.ready
    driver.now += 5
    driver.returns(Replayed(FRAME))
    assert driver.trial.ready
    assert driver.records("resume") == [{"episode": 2, "steps": 2}]
    driver.connect()
    driver.say(command="start")
    assert driver.call.feedback == (Word("good"),), "the earlier agent did not hear it"
    assert driver.call.fields["messages"][0] == {"ns": 105_000_000_000, "command": "good", "again": True}
    assert driver.call.fields["step"] == 3
    assert driver.trial.progress.score == 4.5


def test_an_episode_whose_replay_differs_begins_again_with_its_seed():
    driver = Driver().begin(recorded(STEPS))
    driver.fails(ValueError("it plays differently now"))
    assert isinstance(driver.call, ResetCall)
    assert (driver.call.episode, driver.call.seed) == (2, 11)
    driver.reset()
    controls, words = sent(driver.connect())
    assert controls["episode"] == 2
    assert "starts again" in words["error"]
    assert driver.records("error") == []


def test_the_seconds_that_were_played_on_an_earlier_server_count():
    driver = Driver(maxEpisodes=2).begin(recorded(STEPS))
    driver.returns(Replayed(FRAME))
    driver.connect()
    driver.say(command="start")
    driver.step()
    driver.wait(0.10468)
    driver.step(terminated=True)
    (answer,) = driver.of(SaveAnswer)
    assert (answer.answers["seconds"], answer.answers["frames"], answer.answers["episodes"]) == (4.205, 9, 2)


def test_the_time_of_an_episode_goes_on_after_the_steps_of_an_earlier_server():
    driver = Driver(episodeSeconds=1).begin(recorded(STEPS))
    driver.returns(Replayed(FRAME))
    driver.connect()
    driver.say(command="start")
    assert sent(driver.all, SendState)[-1]["timeLeft"] == pytest.approx(0.8), "two steps, a tenth of a second each"


def test_a_replay_that_hangs_ends_the_trial_and_its_last_line_has_the_feedback_that_was_not_heard():
    driver = Driver().begin(recorded(STEPS, unheard=[Word("good")]))
    driver.connect()
    driver.now += 300
    driver.fails(AgentTimeout("no answer within 300 s"))
    assert driver.trial.progress.outcome == "failed"
    assert driver.records("resume") == []
    (end,) = driver.records("end")
    assert [message for message in end["messages"] if "command" in message] == [
        {"ns": 400_000_000_000, "command": "good", "again": True}
    ]


def test_feedback_that_was_not_heard_before_the_first_step_is_heard_at_it():
    driver = Driver()
    driver.trial.start(alone(SPACE), recorded([], unheard=[Word("good")]), driver.now)
    driver.now += 5
    driver.event("recording_opened", driver.now)
    driver.reset()
    driver.connect()
    driver.say(command="start")
    assert driver.call.feedback == (Word("good"),)
    assert driver.call.fields["messages"][0] == {"ns": 105_000_000_000, "command": "good", "again": True}


def test_an_episode_of_an_earlier_server_without_a_seed_begins_with_a_new_one():
    driver = Driver().begin(RecordedTrial(unfinished=UnfinishedEpisode(1, None)))
    assert isinstance(driver.call, ResetCall)
    assert driver.call.seed == 7


def test_only_who_comes_before_its_first_step_is_told_that_an_episode_begins_again():
    driver = Driver().begin(recorded(STEPS))
    driver.fails(ValueError("it plays differently now"))
    driver.reset()
    assert len(sent(driver.connect())) == 2
    driver.say(command="start")
    driver.step()
    assert len(sent(driver.connect("other tab"))) == 1
    driver = Driver().playing()
    driver.step(terminated=True)
    assert len(sent(driver.connect("other tab"))) == 1, "it has begun here"


# ---- the server must end


def test_closing_records_where_the_game_stands_and_stores_no_answer():
    driver = Driver().playing()
    driver.step()
    effects = driver.event("close", driver.now)
    (end,) = driver.records("end")
    assert (end["why"], end["steps"], end["score"]) == ("shutdown", 1, 1)
    assert effects[-2:] == [CloseRecording(), SaveAnswer(None)]
    driver.event("answer_saved", driver.now)
    assert driver.trial.phase is Phase.CLOSED
    assert driver.trial.done


def test_closing_waits_for_the_step_under_way_but_not_for_long():
    driver = Driver().playing()
    assert driver.event("close", driver.now) == []
    assert driver.trial.wake_at == driver.now + 2
    driver.step()
    assert driver.records("end")[0]["steps"] == 1

    driver = Driver().playing()
    driver.event("close", driver.now)
    effects = driver.wait(2)
    assert driver.records("end")[0]["steps"] == 0
    assert effects[-1] == SaveAnswer(None)


def test_closing_in_a_break_ends_the_break():
    driver = Driver(betweenEpisodes=3).playing()
    driver.step(terminated=True)
    effects = driver.event("close", driver.now)
    assert [over["why"] for over in driver.records("break")] == ["shutdown"]
    assert len(driver.records("end")) == 1
    assert effects[-1] == SaveAnswer(None)


@pytest.mark.parametrize("last", ["disconnect", "start"])
def test_what_a_client_does_while_a_break_is_closed_does_not_end_it_again(last):
    driver = Driver(betweenEpisodes=3).playing()
    driver.step(terminated=True)
    driver.say(command="good")
    driver.event("close", driver.now)
    assert isinstance(driver.call, FeedbackCall), "the agent hears it before the server ends"
    assert driver.call.limit == 2, "if it is quick"
    if last == "start":
        driver.say(command="start")
    else:
        driver.event("disconnect", "tab", driver.now)
    driver.returns()
    assert [over["why"] for over in driver.records("break")] == ["shutdown"]
    assert len(driver.records("end")) == 1


def test_an_agent_that_does_not_hear_the_last_feedback_in_time_is_called_no_more():
    driver = Driver().playing()
    driver.say(command="good")
    driver.step(terminated=True)
    late = driver.call
    driver.event("close", driver.now)
    assert driver.trial.wake_at == driver.now + 2
    effects = driver.wait(2)
    assert driver.of(Call) == []
    assert driver.records("end")[0]["why"] == "terminated"
    assert effects[-1] == SaveAnswer(None)
    assert driver.event("call_returned", late, None, driver.now) == []


def test_closing_while_the_answer_is_stored_changes_nothing():
    driver = Driver(maxEpisodes=1).playing()
    driver.step(terminated=True)
    assert driver.event("close", driver.now) == []
    driver.event("answer_saved", driver.now)
    assert driver.trial.finished


def test_closing_before_the_agent_has_started_ends_at_once():
    driver = Driver()
    driver.event("close", driver.now)
    assert driver.trial.done
    assert driver.event("start", alone(SPACE), None, driver.now) == []
