"""A trial's progress whatever happens in whatever order, and the rhythm of its frames."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.trial.core.history import Break, Episode
from hippodrome.trial.core.messages import CommandRefused
from hippodrome.trial.core.players import PLAYER, alone
from hippodrome.trial.core.progress import PlayState, TrialProgress
from hippodrome.trial.core.timing import Pacer
from hippodrome.trial.settings import trial_section

SPACE = ("noop", "up", "right", "left", "down", "upright", "upleft")


def new_game(**keys):
    return TrialProgress(trial_section({"allowFrameRateChange": True, **keys}), alone(SPACE))


EVENTS = st.one_of(
    st.sampled_from(["start", "pause", "leave", "reset", "stop", "failed", "step", "end", "began", "go_on"]),
    st.tuples(st.sampled_from(["rate"]), st.one_of(st.sampled_from(["faster", "slower"]), st.floats(-1e6, 1e6))),
    st.tuples(st.sampled_from(["act"]), st.sampled_from(SPACE), st.sampled_from([None, True, False])),
)


@given(st.lists(EVENTS, max_size=80), st.integers(1, 4), st.sampled_from([0, 3]))
def test_the_counts_of_a_game_never_go_back(events, limit, pause):
    game = new_game(maxEpisodes=limit, minFrameRate=3, maxFrameRate=60, betweenEpisodes=pause)
    steps = 0
    for event in events:
        before = (game.episode, game.over, game.total_steps, game.episodes_played)
        if isinstance(event, tuple):
            if event[0] == "rate":
                game.change_frame_rate(event[1])
            else:
                game.act(event[1], event[2])
        elif event == "began":
            game.began()
        elif event in ("step", "end"):
            if game.playing and not game.needs_reset:
                choice = game.next_actions()[PLAYER]
                assert choice.name == SPACE[choice.index]
                game.stepped({PLAYER: 1.0}, event == "end", False)
                steps += 1
        else:
            getattr(game, event)()
        assert (game.episode, game.over, game.total_steps, game.episodes_played) >= before
        assert before[1] is False or game.over, "what is over stays over"
        assert 1 <= game.episode <= limit
        assert 3 <= game.frame_rate <= 60
        assert isinstance(game.frame_rate, int)
        assert game.total_steps == game.score == steps
        assert game.over == (game.outcome is not None)
        assert game.episodes_played <= limit
        assert not (game.on_break and (pause == 0 or game.needs_reset or game.episode == limit))
    episodes = [over for over in game.ended if isinstance(over, Episode)]
    assert sum(episode.steps for episode in episodes) == steps - (0 if game.over or game.on_break else game.steps)
    numbers = [episode.number for episode in episodes]
    assert numbers == sorted(set(numbers)), "each episode ends once, and they end in order"
    assert [over.after in numbers for over in game.ended if isinstance(over, Break)].count(False) == 0


def test_every_episode_is_counted_and_the_last_ends_the_trial():
    game = new_game(maxEpisodes=2, betweenEpisodes=0)
    game.start()
    for _ in range(2):
        game.began()
        game.stepped({PLAYER: 2.0}, False, True)
    assert game.state is PlayState.ENDED
    assert game.outcome == "finished"
    assert [(e.number, e.steps, e.score, e.why) for e in game.ended] == [
        (1, 1, 2.0, "truncated"),
        (2, 1, 2.0, "truncated"),
    ]
    game.start()
    game.stepped({PLAYER: 1.0}, True, False)
    assert game.state is PlayState.ENDED
    assert game.score == 4.0


def test_reset_of_an_untouched_episode_changes_nothing():
    game = new_game()
    game.began()
    game.reset()
    assert game.episode == 1
    assert not game.needs_reset


def test_three_failures_in_a_row_end_the_trial():
    game = new_game()
    for _ in range(2):
        game.failed()
        assert game.episode == 1
        assert game.needs_reset
    game.failed()
    assert game.outcome == "failed"
    game = new_game()
    game.failed(fatal=True)
    assert game.outcome == "failed"


def test_after_an_episode_that_ends_well_failures_are_counted_anew():
    game = new_game(betweenEpisodes=0)
    game.start()
    for why in ("failed", "failed", "good", "failed", "failed"):
        game.began()
        if why == "good":
            game.stepped({PLAYER: 1.0}, True, False)
        else:
            game.stepped({PLAYER: 1.0}, False, False)
            game.failed()
    assert not game.over


def test_a_trial_of_failed_episodes_alone_is_failed_on_the_next_server_too():
    for why, outcome in (("failed", "failed"), ("terminated", "finished")):
        game = new_game(maxEpisodes=2)
        game.resume([Episode(1, 3, 1.0, "failed"), Episode(2, 3, 1.0, why)])
        assert (game.over, game.outcome) == (True, outcome)


def test_a_press_while_the_game_is_held_does_nothing_when_it_goes_on():
    game = new_game(actionBufferLifespan=5)
    game.start()
    game.pause()
    game.act("left", None)
    game.start()
    assert not game.next_actions()[PLAYER].human
    game.act("left", None)
    assert game.next_actions()[PLAYER].name == "left"


def test_leaving_lets_go_of_the_keys():
    game = new_game()
    game.start()
    game.act("left", True)
    game.leave()
    assert game.state is PlayState.PAUSED
    game.start()
    assert game.next_actions()[PLAYER].human is False
    with pytest.raises(CommandRefused):
        game.act("jump", None)


@given(st.lists(st.tuples(st.floats(0, 0.2), st.integers(1, 90)), max_size=100))
def test_a_frame_is_due_at_most_one_interval_before_or_after_now(delays):
    pacer, now, previous = Pacer(), 100.0, None
    for delay, rate in delays:
        due = pacer.next(now, rate)
        assert due > now - 1 / rate - 1e-9, "never more than a frame behind"
        assert due <= now + 1 / rate + 1e-9
        if previous is not None:
            assert due >= previous
        previous = due
        now = max(now, due) + delay


def test_frames_that_are_taken_late_do_not_delay_the_later_ones():
    pacer, now = Pacer(), 0.0
    for _ in range(301):
        due = pacer.next(now, 30)
        now = due + 0.001
    assert due == pytest.approx(10.0)
