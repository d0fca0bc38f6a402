"""The decisions of a trial, event by event: the test gives the core events and times, and checks the effects it returns."""

import json
from pathlib import Path

import numpy as np
import pytest

from hippodrome.trial.core.effects import (
    Begun,
    Call,
    Close,
    FeedbackCall,
    OpenRecording,
    ReplayCall,
    ResetCall,
    SaveAnswer,
    SendDone,
    SendPicture,
    SendState,
    StepCall,
    StepTaken,
    WriteLine,
    WriteLog,
)
from hippodrome.trial.core.history import Word
from hippodrome.trial.core.players import PLAYER, alone
from hippodrome.trial.core.progress import PlayState
from hippodrome.trial.core.timing import Window
from hippodrome.trial.core.trial import TRIAL_FAILED, Phase
from hippodrome.trial.settings import STALLED_SECONDS
from testing.imports import imported
from tests.trial.core.trial_driver import FRAME, SPACE, STEPS, UI, Driver, recorded, sent

ROOT = Path(__file__).parents[3]

CORE = [
    *sorted((ROOT / "hippodrome/trial/core").glob("*.py")),
    *(ROOT / f"hippodrome/trial/{name}.py" for name in ("pictures/encoder", "pictures/frames", "wire/inbound")),
]


def test_the_core_imports_nothing_that_waits_or_tells_the_time():
    allowed = {"__future__", "base64", "collections", "dataclasses", "enum", "functools", "hashlib", "io", "itertools", "json",
               "logging", "math", "numpy", "operator", "re", "struct", "traceback", "typing", "zlib", "hippodrome",
               "isal", "PIL"}  # fmt: skip
    for module in CORE:
        names = {name.partition(".")[0] for name in imported(module)}
        assert names <= allowed, module


def test_a_trial_begins_with_its_step_and_its_id_and_is_neither_ready_nor_over():
    trial = Driver().trial
    assert (trial.step, trial.id, trial.phase) == ("3", "the-trial", Phase.STARTING)
    assert (trial.ready, trial.done, trial.saving, trial.broken, trial.wake_at) == (False, False, False, False, None)
    assert not trial.callbacks


@pytest.mark.parametrize(("section", "names"), [({"actionSpace": ["left", "Up"]}, ("left", "up")), ({}, ("noop",))])
def test_before_the_agent_has_started_a_program_is_told_the_actions_that_the_project_names(section, names):
    assert Driver(**section).trial.progress.choices.action_space_of(None) == names


# ---- the first frame


def test_a_recording_is_opened_before_the_environment_is_reset():
    driver = Driver()
    first = driver.trial.start(alone(SPACE), None, 100.0)
    assert first == [OpenRecording(episode=1, seed=7, frame_rate=10, action_space=SPACE)]
    assert not driver.trial.ready
    (call,) = driver.trial.recording_opened(100.0)
    assert isinstance(call, ResetCall)
    assert (call.episode, call.seed) == (1, 7)
    assert driver.trial.call_returned(call, Begun(b"reset", FRAME), 100.1) == [WriteLine(b"reset")]
    assert driver.trial.ready
    assert driver.trial.wake_at is None, "nothing happens until the player starts"


def test_a_recording_that_cannot_be_opened_ends_the_trial_before_anything_is_played():
    driver = Driver()
    driver.trial.start(alone(SPACE), None, 100.0)
    effects = driver.trial.recording_failed(100.0)
    assert not [effect for effect in effects if isinstance(effect, Call)]
    assert effects[-1] == SaveAnswer(None)
    assert driver.trial.broken


def test_an_agent_that_does_not_start_leaves_no_answer():
    driver = Driver()
    assert driver.event("agent_failed", driver.now)[-1] == SaveAnswer(None)
    assert driver.trial.broken
    assert driver.trial.ready
    driver.event("answer_saved", driver.now)
    assert driver.trial.phase is Phase.CLOSED


def test_a_game_step_that_an_earlier_server_has_answered_is_done_at_once():
    driver = Driver()
    driver.event("already_played", {"episodes": 2, "score": 340})
    assert (driver.trial.finished, driver.trial.ready) == (True, True)
    assert driver.connect() == [SendDone("tab", 2, 340)]


def test_a_client_that_comes_after_a_game_has_failed_is_told_so_with_the_end():
    driver = Driver()
    driver.event("already_played", {"episodes": 2, "score": 340, "outcome": "failed"})
    assert driver.connect() == [SendDone("tab", 2, 340, words=TRIAL_FAILED)]


def test_an_agent_that_fails_to_start_a_second_time_changes_nothing():
    driver = Driver().playing()
    assert driver.event("agent_failed", driver.now) == []
    assert driver.trial.progress.playing


def test_a_game_begins_once():
    driver = Driver().playing()
    driver.step()
    assert driver.event("start", alone(SPACE), None, driver.now) == []
    assert driver.trial.progress.steps == 1


def test_the_calls_of_the_agent_may_take_as_long_as_the_settings_say():
    variables = {"STEP_SECONDS": "20", "START_SECONDS": "200"}
    driver = Driver(variables=variables).playing()
    limits = [(type(effect), effect.limit) for effect in driver.all if isinstance(effect, Call)]
    assert limits == [(ResetCall, 20), (StepCall, 20)]
    driver.say(command="good")
    driver.step(terminated=True)
    assert (type(driver.call), driver.call.limit) == (FeedbackCall, 20)
    driver = Driver(variables=variables).begin(recorded(STEPS))
    assert (type(driver.call), driver.call.limit) == (ReplayCall, 200)


def test_each_episode_has_the_seed_after_that_of_the_episode_before():
    driver = Driver(seed=40, maxEpisodes=3).playing()
    for _ in range(2):
        driver.step(terminated=True)
        driver.reset()
    assert [effect.seed for effect in driver.all if isinstance(effect, ResetCall)] == [40, 41, 42]


# ---- clients


def test_a_client_is_told_the_controls_and_shown_the_frame():
    driver = Driver().begin()
    driver.reset()
    controls, frame = driver.connect()
    assert json.loads(controls.text)["state"] == "ready"
    assert (frame.connection, frame.frame_id) == ("tab", 1)
    assert frame.picture is FRAME


def test_a_second_tab_of_a_player_replaces_the_first_and_holds_the_game():
    driver = Driver().playing()
    effects = driver.connect("other tab")
    assert isinstance(effects[0], Close)
    assert (effects[0].connection, effects[0].code) == ("tab", 4409)
    assert json.loads(effects[1].text)["state"] == "paused"
    assert {effect.connection for effect in effects[1:] if not isinstance(effect, Call)} == {"other tab"}
    assert driver.say("tab", command="start") == [], "the first tab is not listened to any more"
    assert driver.event("disconnect", "tab", driver.now) == []
    assert driver.trial.progress.state.value == "paused"


def test_another_participant_is_shown_the_same_frames_and_replaces_no_client():
    driver = Driver().playing()
    driver.connect("phone", player="P2")
    assert driver.of(Close) == []
    driver.step()
    frames = driver.of(SendPicture)
    assert [effect.connection for effect in frames] == ["tab", "phone"]
    assert len({effect.frame_id for effect in frames}) == 1


def test_the_game_is_held_when_its_client_disconnects():
    driver = Driver().playing()
    driver.step()
    driver.event("disconnect", "tab", driver.now)
    assert driver.trial.wake_at is None
    assert driver.wait(10) == []
    driver.connect("tab again")
    assert driver.of(Close) == [], "there is nothing to replace"


def second_frame_under_way():
    """A game whose client has acknowledged the first frame, and not yet the second one; and its window."""
    window = Window()
    driver = Driver().begin()
    driver.reset()
    driver.connect(window=window)
    driver.say(command="start")
    window.sent(1, driver.now)
    window.acknowledged(1, driver.now + 0.01)
    driver.step()
    window.sent(2, driver.now)
    return driver, window


def test_a_client_that_stops_acknowledging_holds_the_game():
    driver, _ = second_frame_under_way()
    driver.wait(STALLED_SECONDS)
    assert isinstance(driver.of(Call)[0], StepCall), "it may still answer"
    driver.now += 0.15
    driver.step()
    assert driver.trial.progress.state is PlayState.PLAYING, "its acknowledgement may have come, and be read next"
    assert driver.of(Call) == []
    effects = [*driver.wait(0.15), *driver.wait(0.15)]
    assert [type(effect) for effect in effects] == [WriteLog, SendState]
    assert driver.trial.progress.state is PlayState.PAUSED
    assert driver.trial.wake_at is None


def test_a_client_whose_acknowledgement_is_read_late_does_not_hold_the_game():
    driver, window = second_frame_under_way()
    for frame in (2, 3, 4):
        driver.wait(10 * STALLED_SECONDS)  # this process could not run
        assert driver.trial.progress.state is PlayState.PLAYING
        assert driver.of(Call) == [], "no step is taken yet"
        window.acknowledged(frame, driver.now)
        assert isinstance(driver.say(ack=frame)[-1], StepCall)
        window.sent(frame + 1, driver.now)
        driver.step()


def test_an_acknowledgement_between_two_looks_begins_anew():
    driver, window = second_frame_under_way()
    window.sent(3, driver.now)
    driver.wait(STALLED_SECONDS + 0.2)
    window.acknowledged(2, driver.now)
    driver.wait(0.15)
    assert driver.trial.progress.state is PlayState.PLAYING
    driver.wait(0.15)
    assert driver.trial.progress.state is PlayState.PAUSED


def test_a_refused_message_gets_a_sentence():
    driver = Driver(ui={"start": True}).playing()
    assert sent(driver.say(command="stop")) == [{"error": "stop is not offered in this game"}]
    assert sent(driver.say(action="jump")) == [{"error": "that action is not in this game's actionSpace"}]
    assert sent(driver.say(changeFrameRate=20)) == [{"error": "the frame rate of this game is fixed"}]


def test_the_state_is_sent_when_it_changes_and_not_before():
    driver = Driver().begin()
    driver.reset()
    driver.connect()
    (state,) = sent(driver.say(command="start"), SendState)
    assert state["state"] == "playing"
    assert sent(driver.say(command="start"), SendState) == []
    (state,) = sent(driver.say(command="pause"), SendState)
    assert state["state"] == "paused"


def test_the_words_of_the_project_are_told_and_those_that_are_actions_are_not():
    driver = Driver(ui={**UI, "wellDone": True, "hop": True})
    driver.event("start", alone(("noop", "hop")), None, driver.now)
    driver.reset()
    assert sent(driver.connect())[0]["words"] == ["wellDone"]


def test_a_round_trip_of_the_only_participant_changes_nothing():
    driver = Driver()
    assert driver.event("round_trip", "P1", 9.0, driver.now) == []
    driver.playing()
    assert driver.event("round_trip", "P1", 9.0, driver.now) == []
    driver.event("close", driver.now)
    driver.wait(2)
    assert driver.event("round_trip", "P1", 9.0, driver.now) == []


def test_the_controls_of_a_game_that_is_drawn_by_objects_hold_its_scene_and_its_images():
    assets = [{"name": "ball.png", "size": 3}]
    driver = Driver(assets=assets, scene={"width": 3, "height": 2}).begin()
    driver.reset()
    told = sent(driver.connect())[0]
    assert (told["scene"]["width"], told["scene"]["height"], told["assets"]) == (3, 2, assets)
    assert "assets" not in told["scene"]
    plain = Driver(assets=assets).begin()
    plain.reset()
    assert {"scene", "assets"}.isdisjoint(sent(plain.connect())[0])


def test_each_player_is_shown_their_own_picture_if_there_is_one():
    driver = Driver().begin()
    other = np.ones((2, 2, 3), np.uint8)
    driver.returns(Begun(b"reset", {PLAYER: other, "player_1": FRAME}))
    (shown,) = [effect for effect in driver.connect() if isinstance(effect, SendPicture)]
    assert np.array_equal(shown.picture, other)
    driver.say(command="start")
    driver.returns(StepTaken({PLAYER: 1.0}, False, False, {"player_1": FRAME}, b"step"))
    assert driver.of(SendPicture) == []


def test_the_ids_of_frames_count_up():
    driver = Driver().playing()
    ids = []
    for _ in range(3):
        driver.step()
        ids += [frame.frame_id for frame in driver.of(SendPicture)]
        driver.wait(0.1)
    assert ids == [2, 3, 4]
    assert [frame.frame_id for frame in driver.connect("other tab") if isinstance(frame, SendPicture)] == [4]


# ---- steps


def test_steps_come_in_the_rhythm_of_the_frame_rate():
    driver = Driver().playing()
    first = driver.call
    assert isinstance(first, StepCall), "the first step is due at once"
    driver.now += 0.03
    driver.step()
    assert driver.trial.wake_at == pytest.approx(100.1)
    assert driver.wait(0.05) == []
    assert driver.wait(0.021) == [driver.call]
    assert driver.call is not first


def test_after_a_pause_the_next_step_is_due_at_once_and_begins_the_rhythm():
    driver = Driver().playing()
    driver.step()
    driver.say(command="pause")
    driver.now += 5.03
    driver.say(command="start")
    assert driver.of(StepCall)
    driver.step()
    assert driver.trial.wake_at == pytest.approx(105.13)
    assert driver.trial._timing.seconds == pytest.approx(0.2), "a pause is not played"


def test_only_one_call_is_under_way():
    driver = Driver().playing()
    call = driver.call
    assert driver.wait(5) == []
    driver.say(action="up")
    assert driver.call is call


def test_a_step_takes_what_the_keys_say_and_its_line_holds_the_messages():
    driver = Driver().playing()
    driver.step()
    driver.now += 0.01
    driver.say(action="right", held=True)
    driver.wait(0.1)
    assert (driver.call.actions[PLAYER].name, driver.call.actions[PLAYER].human) == ("right", True)
    fields = driver.call.fields
    assert (fields["episode"], fields["step"], fields["frame"]) == (1, 2, 3)
    assert fields["messages"] == [{"ns": int(driver.now * 1e9) - 100_000_000, "action": "right", "held": True}]
    driver.returns(StepTaken({PLAYER: 1.0}, False, False, FRAME, b"step"))
    driver.wait(0.1)
    assert "messages" not in driver.call.fields, "each message stands in one line"


def test_feedback_goes_to_the_agent_with_the_next_step_once():
    driver = Driver().playing()
    driver.say(command="good")
    driver.step()
    driver.wait(0.1)
    assert driver.call.feedback == (Word("good"),)
    driver.step()
    driver.wait(0.1)
    assert driver.call.feedback == ()


def test_too_many_messages_between_two_steps_are_counted_and_not_kept(monkeypatch):
    monkeypatch.setattr("hippodrome.trial.core.history.MESSAGES_KEPT", 3)
    driver = Driver().playing()
    driver.step()
    for _ in range(5):
        driver.say(action="up")
    driver.wait(0.1)
    assert len(driver.call.fields["messages"]) == 3
    assert driver.call.fields["messagesDropped"] == 2


def test_reset_waits_for_the_end_of_the_step():
    driver = Driver().playing()
    driver.step()
    driver.wait(0.1)
    assert driver.say(command="reset") == []
    driver.step()
    assert isinstance(driver.call, ResetCall)
    (end,) = driver.records("end")
    assert (end["episode"], end["steps"], end["why"]) == (1, 2, "reset")


def test_a_refused_message_is_not_recorded_and_one_that_is_not_possible_now_is():
    driver = Driver(ui={"start": True}).playing()
    driver.say(command="stop")
    driver.say(changeFrameRate=20)
    driver.say(action="jump")
    driver.step()
    driver.wait(0.1)
    said = [message for message in driver.call.fields["messages"] if "event" not in message]
    assert said == [{"ns": 100_000_000_000, "action": "jump"}]


def test_one_message_may_hold_a_command_a_frame_rate_and_an_action():
    driver = Driver(allowFrameRateChange=True).begin()
    driver.reset()
    driver.connect()
    driver.say(command="start", action="up", held=True, changeFrameRate="faster")
    assert driver.trial.progress.playing
    assert driver.call.actions[PLAYER].name == "up"
    assert sent(driver.effects, SendState)[-1]["frameRate"] == 15
    assert driver.of(SendState)[-1].frame_rate == 15


def test_a_client_that_asks_is_told_the_controls_again():
    driver = Driver(allowFrameRateChange=True).playing()
    driver.step()
    (told,) = sent(driver.say(command="requestUI"))
    assert (told["state"], told["score"], told["episodeScore"]) == ("playing", 1, 1)
    assert (told["frameRate"], told["allowFrameRateChange"], told["actionSpace"]) == (10, True, list(SPACE))
    assert (told["episode"], told["maxEpisodes"], told["UI"]) == (1, 20, list(driver.trial.config.ui.shown()))


def test_a_reset_and_a_stop_are_carried_out_once_after_the_step_and_in_their_order():
    driver = Driver().playing()
    driver.step()
    driver.wait(0.1)
    for command in ("reset", "reset", "stop", "stop"):
        assert driver.say(command=command) == []
    driver.step()
    assert [(end["episode"], end["steps"], end["why"]) for end in driver.records("end")] == [
        (1, 2, "reset"),
        (2, 0, "stopped"),
    ]
    assert driver.of(SaveAnswer)[0].answers["outcome"] == "stopped"


def test_the_first_step_after_a_reset_is_due_one_frame_later_than_the_step_that_was_not_taken():
    driver = Driver().playing()
    driver.step()
    driver.now += 0.05
    driver.say(command="reset")
    driver.reset()
    assert driver.trial.wake_at == pytest.approx(100.2)


def test_the_rhythm_follows_the_frame_rate_that_a_client_chooses():
    driver = Driver(allowFrameRateChange=True).playing()
    driver.say(changeFrameRate="faster")
    driver.step()
    assert driver.trial.wake_at == pytest.approx(100 + 1 / 15)


def test_a_client_that_may_be_stalled_is_looked_at_again_a_tenth_of_a_second_later():
    driver, window = second_frame_under_way()
    driver.wait(STALLED_SECONDS)
    driver.now += 1
    driver.step()
    assert driver.trial.wake_at == pytest.approx(driver.now + 0.1)
    driver.wait(0.11)
    assert driver.trial.progress.state is PlayState.PAUSED
    window.acknowledged(2, driver.now)
    driver.say(command="start")
    (call,) = driver.of(StepCall)
    assert [message.get("event") for message in call.fields["messages"]] == ["stopped answering", None]


def test_the_line_of_the_first_step_says_who_has_connected_and_left():
    driver = Driver().begin()
    driver.reset()
    driver.connect()
    driver.now += 1
    driver.connect("other tab")
    driver.now += 1
    driver.event("disconnect", "other tab", driver.now)
    driver.now += 1
    driver.connect()
    driver.say(command="start")
    assert [(message["ns"] // 10**9, message.get("event")) for message in driver.call.fields["messages"]] == [
        (100, "connected"),
        (101, "disconnected"),
        (101, "connected"),
        (102, "disconnected"),
        (103, "connected"),
        (103, None),
    ]
