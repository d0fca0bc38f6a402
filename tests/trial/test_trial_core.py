"""The parts of the trial server that do no I/O."""

import asyncio
import contextlib
import gzip
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testing.exploration import examples
from trial.agent.agent import AgentError, read_step_result
from trial.core import messages
from trial.core.controls import Controls
from trial.core.ended import Break, Episode
from trial.core.flow_control import STALLED_SECONDS, Window
from trial.core.messages import CommandRefused
from trial.core.players import PLAYER, alone
from trial.core.progress import PlayState, Progress
from trial.core.timing import Pacer
from trial.pictures.frames import Decoder
from trial.recordings import recording
from trial.server.watchdog import Watchdog
from trial.settings import Settings, SettingsError, trial_section
from trial.wire.connection import Connection

SPACE = ("noop", "up", "right", "left", "down", "upright", "upleft")

# ---- controls


def test_held_keys_combine_and_the_newest_wins():
    controls = Controls(SPACE, 1)
    controls.hold("up")
    assert controls.take() == (1, True)
    controls.hold("right")
    assert controls.take() == (5, True)
    controls.hold("left")
    assert controls.take() == (6, True), "left is newer than right"
    controls.release("left")
    assert controls.take() == (5, True)
    controls.hold("down")
    assert controls.take() == (4, True), "nothing goes with down"
    for key in ("up", "right", "down"):
        controls.release(key)
    assert controls.take() == (0, False)


def test_a_press_lasts_its_steps_or_until_another_action():
    controls = Controls(SPACE, 3)
    controls.press("left")
    assert [controls.take() for _ in range(4)] == [(3, True)] * 3 + [(0, False)]
    controls.press("left")
    controls.press("up")
    assert controls.take() == (1, True)
    controls.hold("down")
    assert controls.take() == (4, True)
    controls.press("left")
    assert [controls.take()[0] for _ in range(4)] == [3, 3, 3, 4]


def test_a_tap_between_two_steps_is_not_lost():
    controls = Controls(SPACE, 1)
    controls.hold("right")
    controls.take()
    controls.hold("up")
    controls.release("up")
    assert controls.take() == (5, True)
    assert controls.take() == (2, True)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["press", "hold", "release", "take", "clear"]), st.sampled_from([*SPACE, "fire", "jump"])
        ),
        max_size=60,
    ),
    st.integers(1, 5),
)
def test_controls_always_have_an_action(events, lifespan):
    controls = Controls(SPACE, lifespan)
    held = set()
    for what, name in events:
        if what in ("press", "hold", "release"):
            getattr(controls, what)(name)
            held = held | {name} if what == "hold" else held - {name} if what == "release" else held
        elif what == "clear":
            controls.clear()
            held = set()
        else:
            index, _ = controls.take()
            assert 0 <= index < len(SPACE)
        assert set(controls.held) == held
    for name in held:
        controls.release(name)
    for _ in range(lifespan + 1):
        controls.take()
    assert controls.take() == (0, False), "everything ends once nothing is held"


# ---- the game


def new_game(**keys):
    return Progress(trial_section({"allowFrameRateChange": True, **keys}), alone(SPACE))


EVENTS = st.one_of(
    st.sampled_from(["start", "pause", "leave", "reset", "stop", "failed", "step", "end", "began", "go_on"]),
    st.tuples(st.sampled_from(["rate"]), st.one_of(st.sampled_from(["faster", "slower"]), st.floats(-1e6, 1e6))),
    st.tuples(st.sampled_from(["act"]), st.sampled_from(SPACE), st.sampled_from([None, True, False])),
)


@given(st.lists(EVENTS, max_size=80), st.integers(1, 4), st.sampled_from([0, 3]))
def test_game_goes_forward_only(events, limit, pause):
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


def test_an_episode_that_ends_well_forgives_the_failures_before_it():
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
def test_pacer_never_bursts(delays):
    pacer, now, previous = Pacer(), 100.0, None
    for delay, rate in delays:
        due = pacer.next(now, rate)
        assert due > now - 1 / rate - 1e-9, "never more than a frame behind"
        assert due <= now + 1 / rate + 1e-9
        if previous is not None:
            assert due >= previous
        previous = due
        now = max(now, due) + delay


def test_pacer_does_not_drift():
    pacer, now = Pacer(), 0.0
    for _ in range(301):
        due = pacer.next(now, 30)
        now = due + 0.001
    assert due == pytest.approx(10.0)


# ---- flow control and the watchdog


def test_window_fits_the_round_trip():
    for round_trip, rate, wanted in ((0.001, 30, 3), (0.1, 30, 5), (0.1, 60, 8), (10, 60, 15)):
        window = Window()
        assert window.wait(0.0, rate) == 0.0
        window.sent(1, 0.0)
        window.acknowledged(1, round_trip)
        under_way = 0
        while window.wait(100.0, rate) == 0.0:
            window.sent(2 + under_way, 100.0)
            under_way += 1
        assert under_way == wanted
        assert window.wait(100.5, rate) == pytest.approx(0.5)
        assert window.wait(101.0, rate) == 0.0
        assert not window.stalled(100.0 + STALLED_SECONDS)
        assert window.stalled(100.1 + STALLED_SECONDS)
        window.acknowledged(2, 104.0)
        assert window.wait(104.0, rate) == 0.0


def under_way(window: Window, rate: int, first: int, now: float) -> int:
    """So many frames, from this one, are sent to a client that acknowledges none of them."""
    number = first
    while window.wait(now, rate) == 0.0:
        window.sent(number, now)
        number += 1
    return number - first


def test_a_client_that_acknowledges_two_frames_at_once_may_have_one_more_under_way():
    window = Window()
    window.sent(1, 0.0)
    window.acknowledged(1, 0.1)
    window.sent(2, 1.0)
    window.sent(3, 1.0)
    window.acknowledged(3, 1.1)
    assert under_way(window, 30, 4, 2.0) == 6
    window.acknowledged(9, 2.2)  # the six of them
    window.sent(10, 3.0)
    window.acknowledged(10, 3.1)
    assert under_way(window, 30, 11, 4.0) == 5, "it acknowledges each frame again"


def test_frames_that_are_acknowledged_in_pairs_never_wait():
    """Round trips that vary by a frame: the client acknowledges every second frame as it is drawn."""
    rate, window, acks = 30, Window(), []
    for number in range(1, 300):
        now = number / rate
        while acks and acks[0][1] <= now:
            window.acknowledged(*acks.pop(0))
        assert window.wait(now, rate) == 0.0, number
        window.sent(number, now)
        if number % 2 or number < 3:
            acks.append((number, now + 0.1 + number % 3 / rate / 2))


@given(st.floats(0.05, 1.0), st.lists(st.tuples(st.floats(0.001, 0.3), st.booleans()), min_size=1, max_size=60))
def test_rows_of_a_picture_do_not_make_the_line_seem_quick(round_trip, sendings):
    """Several messages with one id are under way: what is acknowledged may be an earlier one of them."""
    window, now, number, acks = Window(), 0.0, 1, []
    for pause, is_new in sendings:
        now += pause
        while acks and acks[0][1] <= now:
            window.acknowledged(*acks.pop(0))
        number += is_new
        window.sent(number, now)
        acks.append((number, now + round_trip))
    for ack in acks:
        window.acknowledged(*ack)
    window.sent(number + 1, now + 2)
    under_way = 1
    while window.wait(now + 2, 30) == 0.0:
        under_way += 1
        window.sent(number + under_way, now + 2)
    assert under_way == min(2 + math.ceil(round_trip * 30), 15)


class Paper:
    """A websocket that writes down what it is sent."""

    subprotocol = "hippodrome.1"

    def __init__(self):
        self.sent = []
        self.transport = self

    def get_extra_info(self, _):
        return None

    async def send(self, data):
        self.sent.append(data)

    async def close(self, code):
        self.sent.append(code)


@pytest.mark.parametrize("code", [1000, 4409])
def test_a_connection_keeps_little_but_never_loses_its_last_words(code):
    async def talk():
        paper = Paper()
        connection = Connection(paper)
        for number in range(10_000):
            connection.send(str(number))
            connection.send_state(f"state {number}")
            connection.put_picture(np.full((2, 2, 3), number % 256, np.uint8), number)
            connection.send_now()
        connection.close(code, "done")
        connection.close(4410, "too late")
        await connection.run()
        return paper.sent

    sent = asyncio.run(talk())
    assert len(sent) < 100
    assert sent[0] == "0"
    assert sent[-2:] == ["done", code]
    pictures = [Decoder().decode(each)[0] for each in sent if isinstance(each, bytes)]
    assert pictures == ([9_999] if code == 1000 else []), "the picture that shows how the game ended"
    assert sent[-3 - len(pictures)] == "state 9999"


@pytest.mark.parametrize("subprotocol", [None, "hippodrome.2"])
def test_a_picture_that_cannot_be_packed_ends_its_connection(subprotocol, caplog):
    """The page connects again; without this it would wait for pictures for ever."""

    class Cut(Paper):
        def abort(self):
            self.sent.append("cut")

    async def talk():
        paper = Cut()
        paper.subprotocol = subprotocol
        connection = Connection(paper)
        width, depth = (65_535, 3) if subprotocol is None else (3, 0)  # wider than a JPEG may be; without a byte
        connection.put_picture(np.zeros((2, width, depth), np.uint8), 1)
        connection.send_now()
        await asyncio.wait_for(connection.run(), 5)
        return paper.sent

    assert asyncio.run(talk()) == ["cut"]
    assert "a picture cannot be sent" in caplog.text


def test_watchdog():
    dog = Watchdog(now=0, idle=10, grace=60, deadline=1000)
    assert dog.verdict(9) is None
    assert dog.verdict(10) == "idle"
    dog.came()
    assert dog.verdict(999) is None
    assert dog.verdict(1000) == "deadline"
    dog.left(500)
    assert dog.verdict(559) is None
    assert dog.verdict(560) == "idle"
    assert Watchdog(now=0, idle=10, grace=0, deadline=None).expires() == 10


# ---- messages

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
FIELDS = st.dictionaries(
    st.sampled_from(["command", "action", "held", "changeFrameRate", "ack", "x"]), JSON, max_size=4
)


@settings(max_examples=examples(300))
@given(st.one_of(st.text(), st.binary(), JSON.map(json.dumps), FIELDS.map(json.dumps)))
def test_parsing_never_raises_anything_else(data):
    for parse in (messages.parse, messages.parse_hello):
        try:
            parse(data)
        except (messages.NotAMessage, messages.BadMessage) as error:
            messages.error(str(error))


@pytest.mark.parametrize(
    "text", ["[" * 4000, "1" * 4096, '{"ack": ' + "9" * 4000 + "}", '{"changeFrameRate": ' + "9" * 4000 + "}"]
)
def test_cruel_json(text):
    with contextlib.suppress(messages.NotAMessage, messages.BadMessage):
        messages.parse(text)


def test_messages_of_the_wire():
    message = messages.parse('{"command": "start", "action": "LEFT", "held": true, "changeFrameRate": 40, "ack": 3}')
    assert message == messages.Message("start", "left", True, 40.0, 3)
    assert "ack" not in message.record()
    assert messages.parse_hello('{"userId": "a", "token": "t", "step": 3, "projectId": "p"}') == messages.Hello(
        "a", "t", "3", names_project=True, project_id="p"
    )
    assert json.loads(messages.state("break", 2, 340.0, 30, episode_score=40.5, next_in=2.5)) == {
        "state": "break",
        "episode": 2,
        "score": 340,
        "episodeScore": 40.5,
        "nextIn": 2.5,
        "frameRate": 30,
    }
    assert json.loads(messages.done(1, math.nan))["score"] == 0


# ---- agents' answers and recordings


def test_shapes_of_a_step():
    five = read_step_result((1, np.float32(2), np.bool_(True), False, {"a": 1}))
    assert (five.reward, five.terminated, five.truncated, five.info) == (2.0, True, False, {"a": 1})
    assert read_step_result((1, 2, True, None)).terminated
    hippo = read_step_result({"observation": 1, "reward": 3, "done": True, "info": {}, "action": np.int64(4)})
    assert (hippo.reward, hippo.terminated, hippo.action) == (3.0, True, 4)
    for wrong in (None, (1, 2), (1, "x", False, {}), (1, math.nan, False, {}), 5):
        with pytest.raises(AgentError):
            read_step_result(wrong)


def test_lines_are_json_whatever_the_info(tmp_path):
    circle: dict = {}
    circle["me"] = circle
    odd = {
        "array": np.arange(3),
        "number": np.float64("nan"),
        "infinity": math.inf,
        ("a", 1): {1, 2},
        "bytes": b"x",
        "object": object(),
        "date": np.datetime64("2026-01-01"),
        "circle": circle,
    }
    line = json.loads(recording.line("step", info=odd))
    assert line["info"]["array"] == [0, 1, 2]
    assert line["info"]["number"] is None
    assert line["info"]["infinity"] is None
    seen = np.arange(12, dtype=np.float32).reshape(3, 4)
    kept = json.loads(recording.line("step", observation=recording.observation({"a": seen, "b": (1, seen)})))
    assert np.array_equal(recording.read_observation(kept["observation"]["a"]), seen)
    assert np.array_equal(recording.read_observation(kept["observation"]["b"][1]), seen)


@given(events=st.lists(st.integers(0, 3), max_size=30))
def test_a_recording_can_be_read_at_any_moment(events, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "r.part"
    kept = recording.Recording(path, "r")
    added = flushed = 0
    for event in events:
        if event == 3:
            kept.flush()
            flushed = added
        else:
            kept.add(recording.line("step", step=added))
            added += 1
        assert [line["step"] for line in recording.read(path.read_bytes())] == list(range(flushed))
    kept.close()
    kept.close()
    assert gzip.decompress(path.read_bytes()).count(b"\n") == added


# ---- settings

ENV = {
    "PROJECT_ID": "p",
    "USER_ID": "u",
    "SERVER": "s.1",
    "TOKEN": "t",
    "GAME_STEPS": "2, 4",
    "STORE": "x",
    "TLS": "off",
}


def test_settings_from_the_environment():
    found = Settings.from_env(
        {**ENV, "TRIAL": json.dumps({"ui": {"left": True, "up": False}, "actionSpace": ["NOOP", "Left"]})}
    )
    assert found.game_steps == ("2", "4")
    assert found.trial.ui.shown() == ("left",)
    assert found.trial.action_space == ("noop", "left")
    assert (found.port, found.idle_seconds, found.grace_seconds, found.deadline) == (5000, 600, 60, None)
    assert "'t'" not in repr(found)
    assert [Settings.from_env({**ENV, "GROUP": text}).group for text in ("", "0", "12")] == [None, 0, 12]


def test_trial_section_of_config_yml(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert Settings.from_env(ENV).trial == trial_section({})
    (tmp_path / "config.yml").write_text(
        "project: {}\ntrial:\n  game: X-v1\n  maxEpisodes: 3\n  allowFramRateChange: true\n"
    )
    found = Settings.from_env(ENV).trial
    assert (found.game, found.max_episodes, found.allow_frame_rate_change) == ("X-v1", 3, True)
    for text in ("trial: [1]", "trial: {maxEpisodes: none}", ": : :"):
        (tmp_path / "config.yml").write_text(text)
        with pytest.raises(SettingsError):
            Settings.from_env(ENV)


@pytest.mark.parametrize(
    "change",
    [
        {"PROJECT_ID": "../x"},
        {"USER_ID": ""},
        {"SERVER": "a/b"},
        {"TOKEN": ""},
        {"GAME_STEPS": "a/b"},
        {"GAME_STEPS": ","},
        {"PORT": "70000"},
        {"PORT": "x"},
        {"GROUP": "a"},
        {"GROUP": "-1"},
        {"TLS": "maybe"},
        {"TLS": "on"},
        {"DEADLINE": "nan"},
        {"IDLE_SECONDS": "-1"},
        {"TRIAL": "{"},
        {"TRIAL": "[]"},
        {"TRIAL": '{"maxEpisodes": 0}'},
        {"TRIAL": '{"maxEpisodes": true}'},
        {"TRIAL": '{"minFrameRate": 50, "maxFrameRate": 20}'},
        {"TRIAL": '{"startingFrameRate": 500}'},
        {"TRIAL": '{"dataFile": "both"}'},
        {"TRIAL": '{"actionSpace": ["a", "A"]}'},
        {"TRIAL": '{"actionSpace": "up"}'},
        {"TRIAL": '{"ui": ["left"]}'},
        {"TRIAL": '{"s3upload": "maybe"}'},
        {"TRIAL": '{"game": 3}'},
    ],
)
def test_wrong_settings_are_refused(change):
    with pytest.raises(SettingsError):
        Settings.from_env({**ENV, **change})
