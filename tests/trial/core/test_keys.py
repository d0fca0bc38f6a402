"""The project's own keys, `input: single`, how long the first picture stands, and limits of an episode."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.trial.core import messages
from hippodrome.trial.core.controls import KEY, Controls
from hippodrome.trial.core.effects import RecordLine, SendMessage, SendState, StepCall
from hippodrome.trial.core.history import Episode, RecordedTrial
from hippodrome.trial.core.timing import EpisodeTime
from hippodrome.trial.recordings.resume import add_lines
from tests.trial.core.trial_driver import Driver

SPACE = ("noop", "left", "up", "leftup", "jump")
KEYS = {"ArrowLeft": "left", "a": "left", "ArrowUp+ArrowLeft": "leftup", " ": "jump", "x": "nowhere"}


def controls(keys=KEYS, **more):
    return Controls(SPACE, 1, keys=keys, **more)


def actions_of(these, steps=1):
    return [SPACE[these.take()[0]] for _ in range(steps)]


# ---- keys


def test_a_key_takes_the_action_that_the_project_gives_it():
    these = controls()
    these.hold(KEY + "a")
    assert actions_of(these, 2) == ["left", "left"]
    these.release(KEY + "a")
    assert these.take() == (0, False)


def test_keys_that_are_held_together_take_their_action_in_any_order_and_one_of_them_may_have_none():
    these = controls()
    these.hold(KEY + "ArrowUp")
    assert actions_of(these) == ["noop"]
    these.hold(KEY + "ArrowLeft")
    assert actions_of(these) == ["leftup"]
    these.release(KEY + "ArrowUp")
    assert actions_of(these) == ["left"]
    these.hold(KEY + "ArrowUp")
    assert actions_of(these) == ["leftup"]


def test_keys_that_belong_to_no_combination_do_not_keep_others_from_one():
    these = controls()
    for key in ("ArrowUp", " ", "ArrowLeft"):
        these.hold(KEY + key)
    assert actions_of(these) == ["leftup"]


def test_a_key_pressed_and_released_between_two_steps_acts_once():
    these = controls()
    these.hold(KEY + " ")
    these.release(KEY + " ")
    assert actions_of(these, 2) == ["jump", "noop"]


def test_keys_and_actions_of_the_same_name_are_told_apart():
    these = controls({"left": "jump"})
    these.hold("left")
    assert actions_of(these) == ["left"]
    assert not these.knows(KEY + "up")


def test_keys_of_actions_that_do_not_exist_do_nothing():
    assert not controls().knows(KEY + "x")


@given(st.lists(st.tuples(st.sampled_from(sorted({"ArrowLeft", "ArrowUp", "a", " "})), st.booleans()), max_size=12))
def test_the_action_is_one_that_the_held_keys_give(moves):
    these = controls()
    for key, down in moves:
        (these.hold if down else these.release)(KEY + key)
    these.take()
    held = {name.removeprefix(KEY) for name in these.held}
    possible = {action for combined, action in KEYS.items() if set(combined.split("+")) <= held}
    assert actions_of(these)[0] in (possible or {"noop"})


# ---- single presses


def test_with_single_a_press_is_one_action_also_while_the_key_is_held():
    these = controls(single=True)
    these.hold(KEY + "a")
    assert actions_of(these, 3) == ["left", "noop", "noop"]
    these.hold(KEY + "a")  # the keyboard repeats
    assert actions_of(these) == ["noop"]
    these.release(KEY + "a")
    these.hold(KEY + "a")
    assert actions_of(these, 2) == ["left", "noop"]


def test_with_single_no_press_is_lost_up_to_a_few():
    these = controls(single=True)
    for _ in range(7):
        these.press("jump")
    these.press(KEY + "a")
    assert actions_of(these, 6) == ["jump"] * 4 + ["noop"] * 2


def test_with_single_the_action_is_that_of_the_keys_that_are_held_when_a_key_goes_down():
    these = controls(single=True)
    these.hold(KEY + "ArrowUp")
    these.hold(KEY + "ArrowLeft")
    assert actions_of(these, 2) == ["leftup", "noop"]


def test_with_single_presses_before_the_game_goes_on_do_nothing():
    driver = Driver(input="single", keys={"x": "up"}).playing()
    driver.say(command="pause")
    driver.say(key="x", held=True)
    driver.say(command="start")
    driver.wait(0)
    assert driver.call.actions["player_0"].name == "noop"


# ---- messages


def test_a_message_names_its_key():
    assert messages.parse('{"key": "ArrowLeft", "held": true}').record() == {"key": "ArrowLeft", "held": True}
    assert messages.parse('{"key": "A"}').key == "A"


@pytest.mark.parametrize(
    "said", [{"key": 3}, {"key": ""}, {"key": "x" * 33}, {"key": "x", "action": "up"}, {"held": True}]
)
def test_a_message_with_a_wrong_key_is_refused(said):
    with pytest.raises(messages.BadMessage):
        messages.parse(json.dumps(said))


def test_the_client_is_told_keys_labels_and_input_only_if_the_project_gives_them():
    driver = Driver(keys={"Space": "up"}, labels={"up": "Go up"}, input="single").begin()
    driver.reset()
    driver.connect()
    said = json.loads(next(each.text for each in driver.effects if isinstance(each, SendMessage)))
    assert (said["keys"], said["labels"], said["input"]) == ({" ": "up"}, {"up": "Go up"}, "single")
    plain = Driver().begin()
    plain.reset()
    plain.connect()
    said = json.loads(next(each.text for each in plain.effects if isinstance(each, SendMessage)))
    assert not {"keys", "labels", "input", "startsIn", "timeLeft"} & said.keys()


def test_a_key_of_the_project_acts_and_another_key_is_refused():
    driver = Driver(keys={"Space": "up"}).playing()
    driver.say(key=" ", held=True)
    assert played(driver) == "up"
    driver.say(key="q", held=True)
    assert "actionSpace" in driver.effects[0].text


def test_an_action_that_has_a_key_needs_no_button_in_ui():
    driver = Driver(keys={"x": "right"}, ui={"start": True}).playing()
    driver.say(action="right", held=True)
    assert played(driver) == "right"


# ---- the first picture stands


def state(driver):
    return json.loads([each.text for each in driver.all if isinstance(each, SendState)][-1])


def test_the_first_picture_of_each_episode_stands_and_no_step_is_taken():
    driver = Driver(resetFreeze=3, maxEpisodes=2).playing()
    assert state(driver)["startsIn"] == 3
    driver.wait(2.9)
    assert not isinstance(driver.call, StepCall)
    driver.wait(0.1)
    assert isinstance(driver.call, StepCall)
    assert "startsIn" not in state(driver)
    driver.step(terminated=True)
    driver.reset()
    assert (state(driver)["episode"], state(driver)["startsIn"]) == (2, 3)
    driver.wait(3)
    assert isinstance(driver.call, StepCall)


def test_keys_do_nothing_while_the_first_picture_stands_and_those_held_then_act():
    driver = Driver(resetFreeze=3).playing()
    driver.say(action="up")
    driver.say(action="up", held=True)
    driver.say(action="up", held=False)
    driver.say(action="right", held=True)
    driver.wait(3)
    assert driver.call.actions["player_0"].name == "right"
    driver.say(action="right", held=False)
    assert played(driver) == "noop"


def test_after_a_pause_the_first_picture_stands_for_its_whole_time_again():
    driver = Driver(resetFreeze=3).playing()
    driver.wait(2)
    driver.say(command="pause")
    driver.wait(60)
    driver.say(command="start")
    assert state(driver)["startsIn"] == 3
    driver.wait(2.9)
    assert not isinstance(driver.call, StepCall)
    driver.wait(0.1)
    assert isinstance(driver.call, StepCall)


def test_a_client_that_asks_is_told_how_long_the_first_picture_still_stands():
    driver = Driver(resetFreeze=3).playing()
    driver.wait(1)
    driver.say(command="requestUI")
    said = json.loads(next(each.text for each in driver.effects if isinstance(each, SendMessage)))
    assert said["startsIn"] == 2


# ---- limits


def played(driver, steps=1):
    """Take steps, one each tenth of a second; return the action of the step that is due then."""
    for _ in range(steps):
        driver.step()
        driver.wait(0.1)
    return driver.call.actions["player_0"].name


def ends(driver):
    return [each.fields for each in driver.all if isinstance(each, RecordLine) and each.kind == "end"]


def test_an_episode_is_truncated_after_max_steps():
    driver = Driver(maxSteps=3, maxEpisodes=2).playing()
    for number in (1, 2, 3):
        driver.wait(0.1)
        assert driver.call.truncated_by == ("maxSteps" if number == 3 else None)
        driver.step()
    assert [(each["steps"], each["why"], each["limit"]) for each in ends(driver)] == [(3, "truncated", "maxSteps")]
    assert driver.trial.progress.episode == 2


def test_an_episode_is_truncated_after_its_seconds_of_play_and_pauses_do_not_count():
    driver = Driver(episodeSeconds=1, startingFrameRate=10, maxEpisodes=2).playing()
    played(driver, 5)
    driver.say(command="pause")
    assert state(driver)["timeLeft"] == pytest.approx(0.5)
    driver.step()
    driver.wait(100)
    driver.say(command="start")
    assert state(driver)["timeLeft"] == pytest.approx(0.5)
    played(driver, 4)
    assert driver.call.truncated_by is None
    played(driver)
    assert driver.call.truncated_by == "episodeSeconds"
    driver.step()
    assert [(each["steps"], each["why"], each["limit"]) for each in ends(driver)] == [
        (12, "truncated", "episodeSeconds")
    ]
    assert driver.trial.progress.episode == 2


@pytest.mark.parametrize(("left", "limit"), [(0.06, None), (0.04, "episodeSeconds")])
def test_the_step_less_than_half_a_frame_before_the_limit_is_the_last_one(left, limit):
    driver = Driver(episodeSeconds=2, startingFrameRate=10).playing()
    driver.step()
    driver.wait(2 - left)
    assert driver.call.truncated_by == limit


def test_in_a_break_no_time_of_an_episode_is_told():
    driver = Driver(episodeSeconds=9, betweenEpisodes=3, maxEpisodes=2).playing()
    assert state(driver)["timeLeft"] == 9
    driver.step(terminated=True)
    said = state(driver)
    assert (said["state"], said["nextIn"], "timeLeft" in said) == ("break", 3, False)
    driver.say(command="stop")
    said = state(driver)
    assert (said["state"], "nextIn" in said, "timeLeft" in said) == ("ended", False, False)


@pytest.mark.parametrize("between", [0, 5])
def test_the_next_episode_begins_with_all_its_time(between):
    driver = Driver(episodeSeconds=1, startingFrameRate=10, maxEpisodes=2, betweenEpisodes=between).playing()
    played(driver, 10)
    driver.step()
    driver.wait(between)
    driver.reset()
    said = state(driver)
    assert (said["state"], said["episode"], said["timeLeft"]) == ("playing", 2, 1)


def test_an_episode_that_terminates_at_the_limit_is_not_truncated():
    driver = Driver(maxSteps=1, maxEpisodes=2).playing()
    driver.step(terminated=True)
    assert [each["why"] for each in ends(driver)] == ["terminated"]
    assert "limit" not in ends(driver)[0]


def test_an_episode_that_an_earlier_server_truncated_counts():
    recorded = RecordedTrial()
    step = {"kind": "step", "episode": 1, "human": None, "action": 0, "reward": 1.0}
    add_lines(recorded, [{"kind": "reset", "episode": 1, "seed": 7}, {**step, "truncated": True}])
    assert recorded.ended == [Episode(1, 1, 1.0, "truncated")]


@given(st.lists(st.tuples(st.sampled_from(["run", "rest", "wait"]), st.floats(0, 5)), max_size=20))
def test_the_time_that_is_left_shrinks_by_what_was_played(events):
    time, now, running, played = EpisodeTime(0, 20), 100.0, False, 0.0
    time.begin()
    for event, seconds in events:
        if event == "run":
            time.run(now)
            running = True
        elif event == "rest":
            time.rest(now)
            running = False
        now += seconds
        played += seconds if running else 0.0
        assert time.left(now) == pytest.approx(max(0.0, 20 - played), abs=1e-6)


def test_without_a_limit_there_is_no_time_left_to_tell():
    assert EpisodeTime(0, 0).left(math.pi) is None


# ---- a break until the player goes on


def test_a_break_with_a_page_ends_when_the_player_goes_on():
    driver = Driver(betweenEpisodes="pause", maxEpisodes=2).playing()
    driver.step(terminated=True)
    said = state(driver)
    assert (said["state"], "nextIn" in said) == ("break", False)
    assert driver.trial.wake_at is None
    driver.wait(10_000)
    assert driver.trial.progress.on_break
    driver.say(command="start")
    driver.reset()
    assert (driver.trial.progress.playing, driver.trial.progress.episode) == (True, 2)
