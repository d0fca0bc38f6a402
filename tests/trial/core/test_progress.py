"""A trial's counts and outcomes, and the rhythm of its frames: each rule by itself."""

import pytest

from trial.core.actions import Action
from trial.core.controls import Controls
from trial.core.ended import Episode
from trial.core.messages import CommandRefused
from trial.core.players import PLAYER, alone
from trial.core.progress import PlayState, TrialProgress
from trial.core.timing import Pacer
from trial.settings import trial_section

SPACE = ("noop", "up", "left")


def new_game(**keys):
    return TrialProgress(trial_section({"maxEpisodes": 3, "betweenEpisodes": 0, **keys}), alone(SPACE))


def playing(**keys):
    game = new_game(**keys)
    game.start()
    game.began()
    return game


def counts(game):
    return game.episode, game.steps, game.total_steps, game.episodes_played, game.score, game.episode_score


def test_a_game_begins_ready_at_its_first_episode():
    game = new_game(startingFrameRate=25)
    assert (game.state, game.outcome, game.frame_rate, game.needs_reset) == (PlayState.READY, None, 25, True)
    assert counts(game) == (1, 0, 0, 0, 0, 0)
    assert (game.ended, game.playing, game.over, game.on_break) == ([], False, False, False)


def test_steps_and_rewards_count_for_the_episode_and_the_trial():
    game = playing()
    game.stepped({PLAYER: 1.5}, False, False)
    game.stepped({PLAYER: 2.0}, False, True)
    assert counts(game) == (2, 0, 2, 1, 3.5, 0)
    assert game.needs_reset
    game.began()
    game.stepped({PLAYER: -1.0}, True, True)
    assert game.ended == [Episode(1, 2, 3.5, "truncated"), Episode(2, 1, -1.0, "terminated")]
    assert counts(game) == (3, 0, 3, 2, 2.5, 0)


def test_an_episode_that_is_played_again_stands_where_it_was():
    game = new_game()
    game.stepped({PLAYER: 1.0}, False, False)
    game.replayed(4, {PLAYER: 2.5})
    assert counts(game) == (1, 4, 5, 0, 3.5, 2.5)
    assert not game.needs_reset


@pytest.mark.parametrize(
    ("ended", "state", "outcome", "now"),
    [
        ([], PlayState.READY, None, (1, 0, 0, 0, 0, 0)),
        ([Episode(1, 4, 2.5, "terminated")], PlayState.READY, None, (2, 0, 4, 1, 2.5, 0)),
        ([Episode(1, 0, 0.0, "failed")], PlayState.READY, None, (2, 0, 0, 0, 0, 0)),
        ([Episode(1, 4, 2.5, "stopped")], PlayState.ENDED, "stopped", (2, 0, 4, 1, 2.5, 0)),
        (
            [Episode(number, 1, 1.0, "truncated") for number in (1, 2, 3)],
            PlayState.ENDED,
            "finished",
            (3, 0, 3, 3, 3.0, 0),
        ),
        ([Episode(number, 1, 1.0, "failed") for number in (1, 2, 3)], PlayState.ENDED, "failed", (3, 0, 3, 3, 3.0, 0)),
        (
            [Episode(1, 1, 1.0, "reset"), Episode(3, 2, 1.0, "failed")],
            PlayState.ENDED,
            "finished",
            (3, 0, 3, 2, 2.0, 0),
        ),
    ],
)
def test_a_game_goes_on_after_the_episodes_of_an_earlier_server(ended, state, outcome, now):
    game = new_game()
    game.resume(ended)
    assert (game.state, game.outcome, counts(game)) == (state, outcome, now)


def test_the_third_failure_in_a_row_ends_the_trial():
    game = playing(maxEpisodes=9)
    for number in (1, 2):
        game.failed()
        assert (game.over, game.episode) == (False, number + 1)
        game.began()
    game.failed()
    assert (game.over, game.outcome) == (True, "failed")
    assert game.ended == [Episode(number, 0, 0.0, "failed") for number in (1, 2, 3)]


def test_after_a_good_episode_failures_are_counted_anew():
    game = playing(maxEpisodes=4)
    for fails in (True, True, False, True):
        if fails:
            game.failed()
        else:
            game.stepped({PLAYER: 1.0}, True, False)
        game.began()
    assert (game.over, game.outcome) == (True, "finished")


def test_a_reset_that_fails_is_tried_again_in_the_same_episode():
    game = new_game()
    game.start()
    game.failed()
    assert (game.episode, game.over, game.ended) == (1, False, [])


def test_a_fatal_failure_ends_the_trial_at_once():
    game = playing()
    game.stepped({PLAYER: 1.0}, False, False)
    game.failed(fatal=True)
    assert (game.outcome, game.ended) == ("failed", [Episode(1, 1, 1.0, "failed")])
    game.failed(fatal=True)
    assert len(game.ended) == 1, "what is over stays over"


@pytest.mark.parametrize(("how", "outcome"), [("reset", "finished"), ("failed", "failed")])
def test_the_last_episode_ends_the_trial(how, outcome):
    game = playing(maxEpisodes=1)
    game.stepped({PLAYER: 1.0}, False, False)
    getattr(game, how)()
    assert (game.over, game.outcome, game.ended) == (True, outcome, [Episode(1, 1, 1.0, how)])
    assert counts(game) == (1, 1, 1, 1, 1.0, 1.0)


def test_a_reset_ends_an_episode_that_has_steps():
    game = playing()
    game.reset()
    assert (game.episode, game.ended) == (1, [])
    game.stepped({PLAYER: 1.0}, False, False)
    game.reset()
    assert (game.episode, game.ended, game.needs_reset) == (2, [Episode(1, 1, 1.0, "reset")], True)


def test_a_stop_ends_the_trial_and_lets_go_of_the_keys():
    game = playing()
    game.act("up", True)
    game.stop()
    assert (game.state, game.outcome, game.ended) == (PlayState.ENDED, "stopped", [Episode(1, 0, 0.0, "stopped")])
    assert game.choices.controls[PLAYER].held == ()
    assert game.episodes_played == 0
    for again in (game.stop, game.start, game.pause, game.leave, game.reset, game.go_on):
        again()
    game.stepped({PLAYER: 1.0}, True, False)
    assert (game.state, game.outcome, len(game.ended), game.total_steps) == (PlayState.ENDED, "stopped", 1, 0)


def test_only_a_game_that_plays_can_be_paused():
    game = new_game()
    game.pause()
    assert game.state is PlayState.READY
    game.start()
    game.pause()
    assert (game.state, game.playing) == (PlayState.PAUSED, False)
    game.start()
    assert game.playing


def test_a_break_lets_go_of_the_keys_and_ignores_those_that_are_tapped_in_it():
    game = playing(betweenEpisodes=5)
    game.act("up", True)
    game.stepped({PLAYER: 1.0}, True, False)
    assert (game.state, game.on_break, game.episode) == (PlayState.BREAK, True, 1)
    assert game.choices.controls[PLAYER].held == ()
    game.act("left", True)
    game.act("left", False)
    game.go_on()
    assert (game.state, game.episode, game.next_actions()[PLAYER]) == (PlayState.PLAYING, 2, Action(0, "noop"))


@pytest.mark.parametrize(
    ("wish", "rate"),
    [("faster", 35), ("slower", 25), (45, 45), (20.6, 21), (1000, 60), (-1000, 10)],
)
def test_the_frame_rate_stays_within_the_projects_limits(wish, rate):
    game = new_game(minFrameRate=10, maxFrameRate=60, startingFrameRate=30, frameRateStepSize=5)
    game.change_frame_rate(wish)
    assert game.frame_rate == rate


def test_a_press_acts_only_while_the_game_plays_and_a_held_key_as_soon_as_it_plays():
    game = new_game(actionBufferLifespan=2)
    game.act("up", None)
    game.start()
    assert game.next_actions()[PLAYER] == Action(0, "noop")
    game.act("up", None)
    assert [game.next_actions()[PLAYER] for _ in range(3)] == [Action(1, "up", "human")] * 2 + [Action(0, "noop")]
    game.pause()
    game.act("left", True)
    game.start()
    assert game.next_actions()[PLAYER] == Action(2, "left", "human")
    game.act("left", False)
    assert game.next_actions()[PLAYER] == Action(0, "noop")
    with pytest.raises(CommandRefused):
        game.act("jump", True)


@pytest.mark.parametrize(("how", "acts"), [("held", True), ("single", False)])
def test_a_key_that_goes_down_and_up_in_a_pause_acts_on_the_first_step_after_it(how, acts):
    game = playing(input=how)
    game.pause()
    game.act("left", True)
    game.act("left", False)
    game.start()
    first = Action(2, "left", "human") if acts else Action(0, "noop")
    assert [game.next_actions()[PLAYER] for _ in range(2)] == [first, Action(0, "noop")]


def test_taps_are_forgotten_and_held_keys_are_not():
    controls = Controls(SPACE, 5)
    controls.press("left")
    controls.hold("up")
    controls.hold("left")
    controls.release("left")
    controls.forget_taps()
    assert [controls.take(), controls.take()] == [(1, True), (1, True)]


# ---- the rhythm


def test_frames_are_due_at_even_intervals_from_the_first_one():
    pacer = Pacer()
    assert [pacer.next(now, 10) for now in (5.0, 5.01, 5.12)] == pytest.approx([5.0, 5.1, 5.2])
    pacer.rest()
    assert pacer.next(9.0, 10) == 9.0


def test_missed_frames_are_skipped_and_the_intervals_stay_as_they_were():
    pacer = Pacer()
    pacer.next(0.0, 10)
    assert pacer.next(0.15, 10) == pytest.approx(0.1), "less than one frame late: it is due at once"
    assert pacer.next(0.95, 10) == pytest.approx(0.9)
    assert pacer.next(0.95, 10) == pytest.approx(1.0)
    assert pacer.next(1.05, 20) == pytest.approx(1.05), "a new rate counts from the next frame on"
