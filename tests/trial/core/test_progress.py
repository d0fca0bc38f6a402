"""A trial's counts and outcomes, and the rhythm of its frames: each rule by itself."""

import pytest

from hippodrome.trial.core.controls import Controls
from hippodrome.trial.core.history import Break, Episode
from hippodrome.trial.core.messages import CommandRefused
from hippodrome.trial.core.players import PLAYER, Action, Player, alone
from hippodrome.trial.core.progress import PlayState, TrialProgress
from hippodrome.trial.core.timing import Pacer
from hippodrome.trial.settings import trial_section

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


# ---- breaks


@pytest.mark.parametrize(
    ("how", "why", "state"),
    [
        ("start", "start", PlayState.PLAYING),
        ("go_on", "over", PlayState.PLAYING),
        ("pause", "pause", PlayState.PAUSED),
        ("leave", "left", PlayState.PAUSED),
    ],
)
def test_a_break_ends_with_the_next_episode_which_is_played_or_held(how, why, state):
    game = playing(betweenEpisodes=5)
    game.stepped({PLAYER: 1.5}, True, False)
    getattr(game, how)()
    assert (game.state, game.ended[1:], game.needs_reset) == (state, [Break(1, why)], True)
    assert counts(game) == (2, 0, 1, 1, 1.5, 0)


@pytest.mark.parametrize(
    ("how", "why", "outcome"),
    [
        (lambda game: game.stop(), "stop", "stopped"),
        (lambda game: game.partner_left(), "partnerLeft", "partnerLeft"),
        (lambda game: game.failed(fatal=True), "failed", "failed"),
    ],
    ids=["stop", "partnerLeft", "failed"],
)
def test_a_trial_that_ends_in_a_break_ends_the_break_and_no_second_episode(how, why, outcome):
    game = playing(betweenEpisodes=5)
    game.stepped({PLAYER: 1.0}, True, False)
    how(game)
    assert (game.outcome, game.ended) == (outcome, [Episode(1, 1, 1.0, "terminated"), Break(1, why)])
    assert game.episodes_played == 1
    game.partner_left()
    assert (game.outcome, len(game.ended)) == (outcome, 2)


def test_in_a_break_a_session_that_lacks_a_member_is_not_held_and_an_error_ends_nothing():
    game = playing(betweenEpisodes=1)
    game.stepped({PLAYER: 1.0}, True, False)
    game.hold()
    game.failed()
    game.reset()
    assert (game.on_break, len(game.ended)) == (True, 1)


def test_an_episode_that_is_held_when_it_ends_is_followed_by_the_next_one_without_a_break():
    game = playing(betweenEpisodes=5)
    game.act("up", True)
    game.pause()
    game.stepped({PLAYER: 1.0}, True, False)
    assert (game.state, game.episode, game.needs_reset) == (PlayState.PAUSED, 2, True)


def test_only_a_game_that_is_on_is_held():
    game = new_game()
    game.hold()
    assert game.state is PlayState.READY
    game.start()
    game.hold()
    assert game.state is PlayState.PAUSED


# ---- the first picture


def test_the_first_picture_is_shown_while_the_game_is_on_from_the_reset_until_its_time_is_over():
    game = new_game(resetFreeze=1)
    assert (game.frozen, game.shows_first_picture) == (True, False)
    game.start()
    assert not game.shows_first_picture, "the environment is not reset yet"
    game.began()
    assert game.shows_first_picture
    game.pause()
    assert not game.shows_first_picture
    game.start()
    game.act("up", None)
    game.act("left", True)
    game.thaw()
    assert (game.frozen, game.shows_first_picture) == (False, False)
    assert game.next_actions()[PLAYER] == Action(2, "left", "human"), "presses before are forgotten"
    game.stepped({PLAYER: 1.0}, True, False)
    assert game.frozen, "each episode has its own first picture"
    assert not playing().frozen


def test_an_episode_that_goes_on_where_it_was_shows_no_first_picture():
    game = new_game(resetFreeze=2)
    game.replayed(1, {PLAYER: 1.0})
    game.start()
    assert not game.shows_first_picture


# ---- limits


@pytest.mark.parametrize(
    ("step", "why", "limit"),
    [
        ((True, False, "maxSteps"), "terminated", None),
        ((False, True, "maxSteps"), "truncated", None),
        ((False, False, "maxSteps"), "truncated", "maxSteps"),
    ],
)
def test_a_limit_is_recorded_only_if_the_environment_does_not_end_the_episode_itself(step, why, limit):
    game = playing()
    game.stepped({PLAYER: 1.0}, *step)
    assert game.ended == [Episode(1, 1, 1.0, why, limit=limit)]


@pytest.mark.parametrize("limit", [None, "maxSteps"])
def test_failures_are_counted_anew_after_an_episode_that_ended_by_itself_or_at_a_limit(limit):
    game = playing(maxEpisodes=9)
    for _ in range(2):
        game.failed()
        game.began()
    game.stepped({PLAYER: 1.0}, limit is None, False, limit)
    for _ in range(2):
        game.failed()
        game.began()
    assert not game.over


@pytest.mark.parametrize("how", ["time_over", "reset", "stepped"])
def test_a_trial_whose_last_episode_fails_is_finished_if_another_did_not(how):
    game = playing(maxEpisodes=2)
    game.stepped({PLAYER: 1.0}, False, False)
    if how == "stepped":
        game.stepped({PLAYER: 1.0}, False, False, "maxSteps")
    else:
        getattr(game, how)()
    game.began()
    game.failed()
    assert (game.outcome, [each.why for each in game.ended][1]) == ("finished", "failed")


# ---- several players

TWO = (Player("a", SPACE), Player("b", SPACE, "random"))


def test_with_several_players_each_has_their_score_and_the_first_humans_comes_first():
    section = trial_section({"maxEpisodes": 3, "betweenEpisodes": 0, "players": {"a": "random", "b": "human"}})
    game = TrialProgress(section, (Player("a", SPACE, "random"), Player("b", SPACE)))
    assert (game.several, game.first, game.humans) == (True, "b", ("b",))
    game.start()
    game.began()
    game.stepped({"a": 1.0, "b": 2.0}, False, False)
    assert (game.score, game.episode_score, game.scores) == (2.0, 2.0, {"a": 1.0, "b": 2.0})
    game.stepped({"a": 1.0}, True, False)
    assert game.ended == [Episode(1, 2, 2.0, "terminated", {"a": 2.0, "b": 2.0})]
    assert (game.scores, game.episode_scores) == ({"a": 2.0, "b": 2.0}, {"a": 0.0, "b": 0.0})
    assert not new_game().several


def test_scores_of_an_earlier_server_count_for_the_players_that_still_are_there():
    game = TrialProgress(trial_section({"maxEpisodes": 3, "players": {"a": "human", "b": "random"}}), TWO)
    game.resume([Episode(1, 4, 1.0, "truncated", {"a": 1.0, "b": 3.0, "gone": 9.0})])
    game.replayed(2, {"b": 0.5, "gone": 9.0})
    assert (game.scores, game.episode_scores) == ({"a": 1.0, "b": 3.5}, {"a": 0.0, "b": 0.5})
    assert counts(game) == (2, 2, 6, 1, 1.0, 0.0)


def test_a_trial_that_a_member_has_left_on_an_earlier_server_is_over():
    game = new_game()
    game.resume([Episode(1, 4, 1.0, "partnerLeft")])
    assert (game.over, game.outcome, game.episode) == (True, "partnerLeft", 2)


def test_an_action_is_the_first_humans_unless_another_player_is_named():
    section = trial_section({"players": {"a": "human", "b": "human"}})
    game = TrialProgress(section, (Player("a", SPACE), Player("b", SPACE)))
    game.start()
    game.began()
    game.act("up", True)
    game.act("left", True, player="b")
    assert {name: action.name for name, action in game.next_actions().items()} == {"a": "up", "b": "left"}
    game.leave("a")
    assert (game.choices.controls["a"].held, game.choices.controls["b"].held) == ((), ("left",))
    game.leave()
    assert game.choices.controls["b"].held == ()
    assert not game.to_act("a"), "in real time it is nobody's turn"


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
    assert pacer.next(1.25, 10) == pytest.approx(1.2), "one was missed"
    assert pacer.next(1.25, 20) == pytest.approx(1.25), "a new rate counts from the next frame on"


def succeed(game, *, success):
    game.began()
    game.stepped({PLAYER: 1.0}, terminated=True, truncated=False, success=success)


def test_with_until_the_trial_is_over_once_so_many_episodes_have_succeeded():
    game = playing(maxEpisodes=9, until={"success": 2})
    for success in (True, False):
        succeed(game, success=success)
    assert (game.over, game.reached) == (False, False)
    succeed(game, success=True)
    assert (game.outcome, game.reached, game.episode, game.episodes_played) == ("finished", True, 3, 3)


def test_who_does_not_reach_the_criterion_plays_max_episodes():
    game = playing(maxEpisodes=2, until={"success": 2})
    for success in (False, True):
        succeed(game, success=success)
    assert (game.outcome, game.reached, game.episodes_played) == ("finished", False, 2)


def test_successes_on_an_earlier_server_count():
    game = new_game(maxEpisodes=9, until={"success": 2})
    game.resume([Episode(1, 1, 1.0, "terminated", success=True), Episode(2, 1, 1.0, "terminated", success=True)])
    assert (game.outcome, game.reached, game.episode) == ("finished", True, 2)
