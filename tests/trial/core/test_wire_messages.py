"""Each message of docs/wire.md, each reason to refuse one, frames, keys and the watchdog, case by case."""

import base64
import io
import json
import math
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from hippodrome.trial.core import clients, messages
from hippodrome.trial.core.controls import Controls
from hippodrome.trial.pictures import frames
from hippodrome.trial.server.lifetime import Watchdog
from hippodrome.trial.settings import trial_section

# ---- what a client says


@pytest.mark.parametrize(
    "data", [b'{"command": "start"}', "", "{", "[1]", "3", "null", '"start"', r'{"command": "\ud800"}', "[" * 100_000]
)
def test_data_that_are_no_json_object_are_refused(data):
    for parse in (messages.parse, messages.parse_hello):
        with pytest.raises(messages.NotAMessage):
            parse(data)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({}, "an empty message"),
        ({"cmd": "start"}, "unknown field 'cmd'"),
        ({"ack": 1, "z": 1, "y": 1}, "unknown field 'y'"),
        ({"y" * 50: 1}, f"unknown field '{'y' * 40}'"),
        ({"command": "dance"}, "unknown command 'dance'"),
        ({"command": None}, "unknown command 'NoneType'"),
        ({"command": 3}, "unknown command 'int'"),
        ({"action": ""}, "action must be the name of an action"),
        ({"action": "x" * 65}, "action must be the name of an action"),
        ({"action": None}, "action must be the name of an action"),
        ({"action": "\0up"}, "action must be the name of an action"),
        ({"held": True}, "held must be true or false and come with an action or a key"),
        ({"action": "up", "held": 1}, "held must be true or false and come with an action or a key"),
        ({"changeFrameRate": "fast"}, "changeFrameRate must be 'faster', 'slower' or a number"),
        ({"changeFrameRate": True}, "changeFrameRate must be 'faster', 'slower' or a number"),
        ({"changeFrameRate": None}, "changeFrameRate must be 'faster', 'slower' or a number"),
        ({"changeFrameRate": float("inf")}, "changeFrameRate must be 'faster', 'slower' or a number"),
        ({"ack": -1}, "ack must be the id of a frame"),
        ({"asset": 1}, "asset must be the name of an image"),
        ({"asset": ""}, "asset must be the name of an image"),
        ({"asset": "a" * 201}, "asset must be the name of an image"),
        ({"ack": 2**32}, "ack must be the id of a frame"),
        ({"ack": True}, "ack must be the id of a frame"),
        ({"ack": "1"}, "ack must be the id of a frame"),
    ],
)
def test_a_wrong_message_is_refused_with_the_reason(fields, words):
    with pytest.raises(messages.BadMessage) as refused:
        messages.parse(json.dumps(fields))
    assert str(refused.value) == words


@pytest.mark.parametrize(
    ("fields", "message", "recorded"),
    [
        *(({"command": name}, {"command": name}, {"command": name}) for name in ("start", "pause", "reset", "stop")),
        *(({"command": name}, {"command": name}, {"command": name}) for name in messages.FEEDBACK),
        ({"command": "requestUI"}, {"command": "requestUI"}, {}),
        ({"action": " UP "}, {"action": "up"}, {"action": "up"}),
        ({"action": "x"}, {"action": "x"}, {"action": "x"}),
        ({"action": "x" * 64}, {"action": "x" * 64}, {"action": "x" * 64}),
        ({"action": "up", "held": False}, {"action": "up", "held": False}, {"action": "up", "held": False}),
        ({"changeFrameRate": "faster"}, {"frame_rate": "faster"}, {"changeFrameRate": "faster"}),
        ({"changeFrameRate": "slower"}, {"frame_rate": "slower"}, {"changeFrameRate": "slower"}),
        ({"changeFrameRate": 12.5}, {"frame_rate": 12.5}, {"changeFrameRate": 12.5}),
        ({"changeFrameRate": 10**400}, {"frame_rate": 1e6}, {"changeFrameRate": 1e6}),
        ({"changeFrameRate": -(10**400)}, {"frame_rate": -1e6}, {"changeFrameRate": -1e6}),
        ({"ack": 0}, {"ack": 0}, {}),
        ({"asset": "../../x"}, {"asset": "../../x"}, {}),
        ({"ack": 2**32 - 1}, {"ack": 2**32 - 1}, {}),
    ],
)
def test_a_message_is_read_and_recorded(fields, message, recorded):
    found = messages.parse(json.dumps(fields))
    assert found == messages.Message(**message)
    assert found.record() == recorded
    if "frame_rate" in message and not isinstance(message["frame_rate"], str):
        assert isinstance(found.frame_rate, float)


def test_feedback_and_commands_are_those_of_docs_wire():
    assert sorted(messages.FEEDBACK) == ["bad", "good", "trainOffline", "trainOnline"]
    assert sorted(messages.PLAIN_COMMANDS) == ["pause", "requestUI", "reset", "start", "stop"]
    assert sorted(clients.ALWAYS_ALLOWED) == ["requestUI", "start"]


@pytest.mark.parametrize(
    ("fields", "hello"),
    [
        ({}, (None, None, None)),
        ({"userId": "a"}, ("a", None, None)),
        ({"token": "t", "other": [1]}, (None, "t", None)),
        ({"step": 3}, (None, None, "3")),
        ({"step": "s" * 65}, (None, None, "s" * 64)),
    ],
)
def test_a_hello_may_leave_fields_out(fields, hello):
    assert messages.parse_hello(json.dumps(fields)) == messages.Hello(*hello)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"userId": 1}, "userId must be a text"),
        ({"token": ["t"]}, "token must be a text"),
        ({"step": True}, "step must be a text"),
        ({"step": 1.5}, "step must be a text"),
    ],
)
def test_a_hello_with_a_wrong_field_is_refused_with_the_reason(fields, words):
    with pytest.raises(messages.BadMessage) as refused:
        messages.parse_hello(json.dumps(fields))
    assert str(refused.value) == words


# ---- what the server answers


@pytest.mark.parametrize("next_in", [None, 1.23456])
def test_the_servers_messages_are_json_with_the_names_of_docs_wire(next_in):
    left = {} if next_in is None else {"nextIn": 1.235}
    said = messages.controls(
        ui=("start", "good"),
        frame_rate=30,
        min_frame_rate=1,
        max_frame_rate=90,
        frame_rate_step_size=5,
        allow_frame_rate_change=True,
        action_space=("noop", "up"),
        state="paused",
        episode=2,
        max_episodes=3,
        score=1.5,
        episode_score=0.5,
        next_in=next_in,
    )
    assert json.loads(said) == left | {
        "UI": ["start", "good"],
        "frameRate": 30,
        "minFrameRate": 1,
        "maxFrameRate": 90,
        "frameRateStepSize": 5,
        "allowFrameRateChange": True,
        "actionSpace": ["noop", "up"],
        "state": "paused",
        "episode": 2,
        "maxEpisodes": 3,
        "score": 1.5,
        "episodeScore": 0.5,
    }
    assert json.loads(messages.state("break", 2, 3.0, 30, episode_score=1.0, next_in=next_in)) == left | {
        "state": "break",
        "episode": 2,
        "frameRate": 30,
        "score": 3,
        "episodeScore": 1,
    }
    assert json.loads(messages.done(2, 7.0)) == {"done": True, "episodes": 2, "score": 7}
    failed = {"done": True, "episodes": 2, "score": 7, "error": "It failed."}
    assert json.loads(messages.done(2, 7.0, words="It failed.")) == failed
    assert json.loads(messages.error("no")) == {"error": "no"}


# ---- fields that are there only sometimes

ALWAYS: dict = {
    "ui": (),
    "frame_rate": 30,
    "min_frame_rate": 1,
    "max_frame_rate": 90,
    "frame_rate_step_size": 5,
    "allow_frame_rate_change": True,
    "action_space": ("noop",),
    "state": "playing",
    "episode": 1,
    "max_episodes": 3,
    "score": 0.0,
    "episode_score": 0.0,
}


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"words": ("wellDone",)}, {"words": ["wellDone"]}),
        ({"player": "a", "players": ("a",)}, {}),
        ({"player": "a", "players": ("a", "b")}, {"player": "a", "players": ["a", "b"]}),
        ({"to_act": False}, {"pace": "turns", "toAct": False}),
        ({"to_act": True, "turn_ends_in": 1.5}, {"pace": "turns", "toAct": True, "turnEndsIn": 1.5}),
        ({"starts_in": 0.0, "time_left": 2.0004}, {"startsIn": 0.0, "timeLeft": 2.0}),
        ({"next_in": math.inf}, {}),
        ({"scene": {"scene": {"width": 3}, "assets": []}}, {"scene": {"width": 3}, "assets": []}),
        ({"input_of_project": {"input": "single"}}, {"input": "single"}),
        ({"session": {"you": "a"}}, {"you": "a"}),
    ],
)
def test_the_message_about_the_controls_has_a_further_field_only_if_there_is_something_to_tell(given, told):
    plain = json.loads(messages.controls(**ALWAYS))
    assert json.loads(messages.controls(**ALWAYS, **given)) == plain | told
    assert plain.keys().isdisjoint(told)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"to_act": False}, {"toAct": False}),
        ({"to_act": True, "turn_ends_in": 1.5}, {"toAct": True, "turnEndsIn": 1.5}),
        ({"to_act": False, "chosen": "up"}, {"toAct": False, "chosen": "up"}),
        ({"to_act": True, "time_up": ""}, {"toAct": True, "timeUp": ""}),
        ({"starts_in": 0.0, "time_left": 2.0004}, {"startsIn": 0.0, "timeLeft": 2.0}),
        ({"next_in": math.inf}, {}),
        ({"session": {"you": "a"}}, {"you": "a"}),
    ],
)
def test_the_message_with_the_state_has_a_further_field_only_if_there_is_something_to_tell(given, told):
    plain = {"state": "playing", "episode": 1, "frameRate": 30, "score": 2, "episodeScore": 1}
    assert json.loads(messages.state("playing", 1, 2.0, 30, episode_score=1.0, **given)) == plain | told


def test_the_last_message_says_how_the_trial_of_a_session_has_ended():
    assert json.loads(messages.done(2, 1.5, "stopped")) == {
        "done": True,
        "episodes": 2,
        "score": 1.5,
        "outcome": "stopped",
    }


def test_a_hello_names_its_project_also_if_the_name_is_no_text():
    hello = messages.parse_hello(json.dumps({"projectId": 3}))
    assert (hello.names_project, hello.project_id) == (True, None)
    hello = messages.parse_hello(json.dumps({"step": 0}))
    assert (hello.names_project, hello.project_id, hello.step) == (False, None, "0")


@pytest.mark.parametrize(
    ("fields", "message", "recorded"),
    [
        ({"key": "x" * 32}, {"key": "x" * 32}, {"key": "x" * 32}),
        ({"key": "x", "held": False}, {"key": "x", "held": False}, {"key": "x", "held": False}),
        ({"asset": "a"}, {"asset": "a"}, {}),
        ({"asset": "a" * 200}, {"asset": "a" * 200}, {}),
        ({"hidden": True}, {"hidden": True}, {}),
        ({"hidden": False}, {"hidden": False}, {}),
        ({"changeFrameRate": 2e6}, {"frame_rate": 2e6}, {"changeFrameRate": 2e6}),
        ({"command": "wellDone"}, {"command": "wellDone"}, {"command": "wellDone"}),
    ],
)
def test_a_key_an_image_a_hidden_page_and_a_word_of_the_project_are_read(fields, message, recorded):
    found = messages.parse(json.dumps(fields), ("wellDone",))
    assert found == messages.Message(**message)
    assert found.record() == recorded


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"key": "x", "action": "up"}, "key must be the name of a key, and come without an action"),
        ({"key": "x" * 33}, "key must be the name of a key, and come without an action"),
        ({"hidden": 1}, "hidden must be true or false"),
        ({"form": {"page": "rules", "fields": {}}}, "form must have a page of the game, and fields with texts"),
        (
            {"form": {"page": "instructions", "fields": {"a": 3}}},
            "form must have a page of the game, and fields with texts",
        ),
        ({"form": {"page": "instructions", "fields": {"a": "x" * 100_000}}}, "the form is too long"),
        ({"hidden": None}, "hidden must be true or false"),
        ({"command": "welldone"}, "unknown command 'welldone'"),
        ({"changeFrameRate": math.nan}, "changeFrameRate must be 'faster', 'slower' or a number"),
    ],
)
def test_a_wrong_key_or_word_is_refused_with_the_reason(fields, words):
    with pytest.raises(messages.BadMessage) as refused:
        messages.parse(json.dumps(fields), ("wellDone",))
    assert str(refused.value) == words


def test_the_recording_has_what_it_knows_of_unknown_fields():
    assert messages.Message(fields={"x": 1}).record() == {"fields": {"x": 1}}
    assert messages.Message(fields_dropped=2).record() == {"fieldsDropped": 2}


def test_the_words_of_a_project_are_its_controls_that_name_no_action():
    buttons = ("jump", "Fire", "leftUp", "rightUp", "leftDown", "rightDown", "wait")
    section = trial_section({"game": "g", "actionSpace": ["noop", "Jump"], "ui": dict.fromkeys(buttons, True)})
    assert messages.words_of(section) == ("wait",)
    assert [messages.is_feedback(name) for name in ("wait", "good", "start", None)] == [True, True, False, False]


def test_a_connection_is_closed_with_a_code_and_words():
    closed = messages.CloseConnection(4400, "that is not JSON")
    assert (closed.code, closed.words, str(closed)) == (4400, "that is not JSON", "that is not JSON")


# ---- what ui offers


@pytest.mark.parametrize(
    ("said", "ui", "missing"),
    [
        ({"command": "start"}, [], None),
        ({"command": "requestUI"}, [], None),
        ({"command": "pause"}, ["stop"], "pause"),
        ({"command": "pause"}, ["pause"], None),
        ({"frame_rate": "faster"}, ["fpsDown", "fpsSet"], "fpsUp"),
        ({"frame_rate": "faster"}, ["fpsUp"], None),
        ({"frame_rate": "slower"}, ["fpsUp", "fpsSet"], "fpsDown"),
        ({"frame_rate": "slower"}, ["fpsDown"], None),
        ({"frame_rate": 20.0}, ["fpsUp", "fpsDown"], "fpsSet"),
        ({"frame_rate": 20.0}, ["fpsSet"], None),
        ({"action": "left"}, ["right"], "left"),
        ({"action": "upleft"}, ["up"], "left"),
        ({"action": "upleft"}, ["up", "left"], None),
        ({"action": "upright"}, ["up"], "right"),
        ({"action": "downleft"}, ["left"], "down"),
        ({"action": "fire"}, [], None),
        ({"action": "upfire"}, [], "up"),
        ({"action": "jump"}, [], None),
        ({"action": "upward"}, [], None),
        ({"command": "stop", "action": "left"}, ["stop"], "left"),
    ],
)
def test_a_message_whose_control_is_missing_in_ui_is_not_offered(said, ui, missing):
    assert clients.not_offered(messages.Message(**said), ui) == missing


@pytest.mark.parametrize(
    ("score", "shown"), [(340.0, "340"), (1 / 3, "0.333333"), (-0.5, "-0.5"), (float("inf"), "0"), (float("nan"), "0")]
)
def test_a_score_is_written_with_few_digits(score, shown):
    assert json.dumps(messages.tidy(score)) == shown


# ---- frames


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"\0" * 9, "too short"),
        (struct.pack("!BIHHB", 0, 1, 2, 2, 1) + b"\xff\xff", "not deflate"),
        (struct.pack("!BIHHB", 0, 1, 2, 2, 1) + zlib.compress(b"123", wbits=-15), "wrong length"),
        (
            struct.pack("!BIHHB", 1, 1, 2, 2, 1) + zlib.compress(b"1234", wbits=-15),
            "a difference to a frame that was not sent",
        ),
        (struct.pack("!BIHHB", 99, 1, 2, 2, 1) + zlib.compress(b"1234", wbits=-15), "unknown kind"),
    ],
)
def test_bytes_that_are_no_frame_are_refused_with_the_reason(data, words):
    with pytest.raises(frames.FrameError) as refused:
        frames.Decoder().decode(data)
    assert str(refused.value) == words


def test_a_difference_to_a_frame_of_another_size_is_refused():
    decoder = frames.Decoder()
    decoder.decode(struct.pack("!BIHHB", 0, 1, 2, 2, 1) + zlib.compress(b"1234", wbits=-15))
    with pytest.raises(frames.FrameError):
        decoder.decode(struct.pack("!BIHHB", 1, 2, 4, 1, 1) + zlib.compress(b"1234", wbits=-15))


def test_the_largest_and_smallest_sides_of_a_picture():
    pixel = np.zeros(1, np.uint8)
    for shape in ((1, 65535), (65535, 1), (1, 1, 3)):
        array = np.lib.stride_tricks.as_strided(pixel, shape, (0,) * len(shape))
        assert frames.as_frame(array).shape[:2] == shape[:2]
    for shape in ((1, 65536), (65536, 1), (0, 1), (1, 0), (2, 2, 0), (2, 2, 5), (2,), (1, 1, 1, 1)):
        with pytest.raises(frames.FrameError, match=r"must return height x width x 3 bytes"):
            frames.as_frame(np.zeros(shape, np.uint8))


@pytest.mark.parametrize(("channels", "mode"), [(1, "L"), (3, "RGB")])
def test_a_hippo_client_gets_a_jpeg_in_json(channels, mode):
    said = json.loads(frames.jpeg_message(np.full((4, 6, channels), 200, np.uint8), 7))
    picture = Image.open(io.BytesIO(base64.b64decode(said["frame"])))
    assert (said["frameId"], picture.format, picture.mode, picture.size) == (7, "JPEG", mode, (6, 4))
    assert np.abs(np.asarray(picture).astype(int) - 200).max() < 5


# ---- keys


def test_without_noop_the_first_action_is_taken_when_no_key_acts():
    assert Controls(("up", "noop"), 1).take() == (1, False)
    assert Controls(("up", "down"), 1).take() == (0, False)


def test_directions_are_keys_even_where_no_action_has_their_name():
    controls = Controls(("noop", "upfire"), 2)
    assert [controls.knows(name) for name in ("up", "down", "left", "right", "fire", "noop", "jump")] == [True] * 6 + [
        False
    ]
    controls.hold("up")
    assert controls.take() == (0, False)
    controls.hold("fire")
    assert controls.take() == (1, True)
    controls.press("fire")
    assert controls.take() == (1, True), "a press that is no action leaves the keys alone"


def test_a_press_of_a_key_that_is_no_action_ends_the_press_before_it():
    controls = Controls(("noop", "up"), 5)
    controls.press("up")
    controls.press("fire")
    assert controls.take() == (0, False)


def test_a_key_that_the_keyboard_repeats_does_not_become_the_newest():
    controls = Controls(("noop", "up", "down"), 1)
    for name in ("up", "down", "up"):
        controls.hold(name)
    assert controls.held == ("down", "up")
    assert controls.take() == (2, True)


def test_at_most_four_held_keys_are_combined():
    controls = Controls(("noop", "abcd", "e"), 1)
    for name in "eabcd":
        controls.hold(name)
    assert controls.take() == (1, True)
    controls.release("a")
    controls.hold("x")
    assert controls.take() == (0, False), "the fifth key does not count"


def test_a_released_key_acts_once_and_a_cleared_key_not_at_all():
    controls = Controls(("noop", "up", "down"), 3)
    controls.hold("up")
    controls.release("up")
    controls.clear()
    assert controls.take() == (0, False)
    controls.press("down")
    controls.clear()
    assert controls.take() == (0, False)
    controls.hold("up")
    controls.clear()
    assert controls.take() == (0, False)
    controls.hold("up")
    controls.release("up")
    assert [controls.take(), controls.take()] == [(1, True), (0, False)]


# ---- the watchdog


def test_the_watchdog_of_a_server_without_a_participant_waits_up_to_the_deadline():
    dog = Watchdog(now=None, idle=10, grace=0, deadline=1000)
    assert dog.expires() == 1000
    assert dog.verdict(999) is None
    dog.wait(50)
    assert (dog.expires(), dog.verdict(59), dog.verdict(60)) == (60, None, "idle")


def test_the_watchdog_waits_for_a_participant_who_left_for_the_longer_of_idle_and_grace():
    for idle, grace, until in ((10, 60, 160), (60, 10, 160), (0, 0, 100)):
        dog = Watchdog(now=0, idle=idle, grace=grace, deadline=None)
        dog.came()
        dog.wait(100)
        assert dog.expires() == until
    dog = Watchdog(now=5, idle=0, grace=60, deadline=None)
    assert dog.verdict(5) == "idle", "nobody was here"


def test_pixels_are_packed_unless_that_takes_more_bytes_than_allowed():
    noise = np.random.default_rng(1).integers(0, 256, (300, 100, 3), dtype=np.uint8)
    whole = frames.packed(noise)
    assert zlib.decompress(whole, wbits=-15) == noise.tobytes()
    for size in (len(whole), len(whole) + 500):
        assert zlib.decompress(frames.packed(noise, limit=size), wbits=-15) == noise.tobytes()
    for size in (0, 1000, len(whole) // 2, len(whole) - 500):
        assert frames.packed(noise, limit=size) is None
    base = np.roll(noise, 1)
    assert zlib.decompress(frames.packed(noise, base), wbits=-15) == np.bitwise_xor(noise, base).tobytes()
    chunked = frames.packed(noise, base, limit=1e9)
    assert zlib.decompress(chunked, wbits=-15) == np.bitwise_xor(noise, base).tobytes()


def test_a_large_picture_is_packed_in_parts_if_its_size_is_limited():
    noise = np.random.default_rng(1).integers(0, 256, (2000, 100, 3), dtype=np.uint8)
    for base in (None, np.roll(noise, 1)):
        plain = noise if base is None else np.bitwise_xor(noise, base)
        data = frames.packed(noise, base, limit=1e9)
        assert data is not None
        assert zlib.decompress(data, wbits=-15) == plain.tobytes()
        assert frames.packed(noise, base, limit=len(data)) == data
        assert frames.packed(noise, base, limit=len(data) - 1) is None
    assert zlib.decompress(frames.packed(noise[:1], limit=1e9), wbits=-15) == noise[:1].tobytes()


def test_jpegs_have_quality_80_and_those_for_hippos_page_75():
    picture = np.random.default_rng(1).integers(0, 256, (16, 16, 3), dtype=np.uint8)

    def tables(data):
        return Image.open(io.BytesIO(data)).quantization

    def of_quality(quality):
        out = io.BytesIO()
        Image.fromarray(picture).save(out, "JPEG", quality=quality)
        return tables(out.getvalue())

    assert tables(frames.jpeg(picture)) == of_quality(80)
    assert tables(base64.b64decode(json.loads(frames.jpeg_message(picture, 1))["frame"])) == of_quality(75)


def test_a_frame_of_the_wrong_length_is_refused():
    def key(pixels, more=b""):
        return struct.pack("!BIHHB", 0, 1, 2, 3, 3) + zlib.compress(pixels, wbits=-15) + more

    assert frames.Decoder().decode(key(bytes(18)))[1].shape == (3, 2, 3)
    for wrong in (key(bytes(18), b"x"), key(bytes(19)), key(bytes(17)), key(bytes(12)), key(b""), key(bytes(18))[:-1]):
        with pytest.raises(frames.FrameError, match="wrong length"):
            frames.Decoder().decode(wrong)


def rows(first, pixels):
    return struct.pack("!BIHHBH", 3, 2, 2, 3, 3, first) + zlib.compress(pixels, wbits=-15)


def test_a_picture_becomes_exact_by_rows_in_their_order():
    decoder = frames.Decoder()
    decoder.decode(struct.pack("!BIHHB", 0, 1, 2, 3, 3) + zlib.compress(bytes(18), wbits=-15))
    for first, pixels in ((0, b"a" * 6), (1, b"b" * 12)):
        _, shown = decoder.decode(rows(first, pixels))
    assert shown.tobytes() == b"a" * 6 + b"b" * 12
    for wrong in (rows(2, b"c" * 6), rows(0, b"c" * 24), rows(0, b"c" * 5), rows(0, b"c" * 9)):
        with pytest.raises(frames.FrameError):
            decoder.decode(wrong)
    with pytest.raises(frames.FrameError, match="rows of no picture"):
        frames.Decoder().decode(rows(0, b"a" * 6))
    with pytest.raises(frames.FrameError, match="rows of no picture"):
        decoder.decode(rows(0, b"")[: frames.HEADER.size + 1])
    with pytest.raises(frames.FrameError, match="wrong length"):
        decoder.decode(rows(0, b"")[: frames.HEADER.size + 2])


def test_rows_begin_with_the_first_one_after_a_whole_picture():
    decoder = frames.Decoder()
    decoder.decode(struct.pack("!BIHHB", 0, 1, 2, 3, 3) + zlib.compress(bytes(18), wbits=-15))
    with pytest.raises(frames.FrameError, match="rows are missing"):
        decoder.decode(rows(1, b"a" * 6))


@pytest.mark.parametrize("more", [bytes(18), bytes(13), b""])
def test_rows_that_do_not_fit_the_rest_of_a_picture_are_refused(more):
    decoder = frames.Decoder()
    decoder.decode(struct.pack("!BIHHB", 0, 1, 2, 3, 3) + zlib.compress(bytes(18), wbits=-15))
    decoder.decode(rows(0, b"a" * 6))
    with pytest.raises(frames.FrameError, match="wrong length"):
        decoder.decode(rows(1, more))


def test_a_difference_may_follow_rows_only_when_all_of_them_have_come():
    difference = struct.pack("!BIHHB", 1, 2, 2, 3, 3) + zlib.compress(bytes([1]) * 18, wbits=-15)
    for parts in ((b"a" * 18,), (b"a" * 6, b"a" * 12), (b"a" * 12,)):
        decoder, first = frames.Decoder(), 0
        decoder.decode(struct.pack("!BIHHB", 0, 1, 2, 3, 3) + zlib.compress(bytes(18), wbits=-15))
        for part in parts:
            _, shown = decoder.decode(rows(first, part))
            first += len(part) // 6
        if first == 3:
            assert decoder.decode(difference)[1].tobytes() == b"`" * 18
            assert shown.tobytes() == b"a" * 18, "a picture that was given away stays as it was"
        else:
            with pytest.raises(frames.FrameError, match="a difference to a frame that was not sent"):
                decoder.decode(difference)


def test_the_largest_frame_is_read():
    head = struct.pack("!BIHHB", 0, 1, 4096, 4096, 1)
    assert frames.Decoder().decode(head + zlib.compress(bytes(4096 * 4096), 1, -15))[1].shape == (4096, 4096, 1)
    with pytest.raises(frames.FrameError, match="wrong length"):
        frames.Decoder().decode(head)


def test_a_jpeg_may_have_as_long_a_side_as_libjpeg_allows():
    long = frames.jpeg(np.zeros((1, frames.MAX_JPEG_SIDE, 1), np.uint8))
    assert Image.open(io.BytesIO(long)).size == (frames.MAX_JPEG_SIDE, 1)


@pytest.mark.parametrize(
    "head", [(0, 1, 0, 3, 3), (0, 1, 2, 0, 3), (0, 1, 2, 3, 2), (0, 1, 4097, 4096, 1), (0, 1, 65535, 65535, 3)]
)
def test_a_frame_of_an_impossible_size_is_refused(head):
    with pytest.raises(frames.FrameError, match="no such picture"):
        frames.Decoder().decode(struct.pack("!BIHHB", *head))


def test_a_jpeg_with_as_many_pixels_in_another_form_and_a_picture_that_is_no_jpeg_are_refused():
    whole = frames.jpeg(np.full((16, 16, 3), 99, np.uint8))
    with pytest.raises(frames.FrameError, match="not a JPEG of this size"):
        frames.Decoder().decode(frames.HEADER.pack(2, 1, 8, 32, 3) + whole)
    png = io.BytesIO()
    Image.fromarray(np.full((16, 16, 3), 99, np.uint8)).save(png, "PNG")
    with pytest.raises(frames.FrameError, match="not a JPEG of this size"):
        frames.Decoder().decode(frames.HEADER.pack(2, 1, 16, 16, 3) + png.getvalue())


@pytest.mark.parametrize("channels", [1, 3])
def test_a_jpeg_is_shown_with_as_many_channels_as_the_picture_has(channels):
    whole = frames.jpeg(np.full((8, 16, channels), 99, np.uint8))
    _, shown = frames.Decoder().decode(frames.HEADER.pack(2, 1, 16, 8, channels) + whole)
    assert shown.shape == (8, 16, channels)


def test_a_jpeg_of_another_size_or_cut_off_is_refused():
    whole = frames.jpeg(np.full((16, 16, 3), 99, np.uint8))
    head = frames.HEADER.pack(2, 1, 16, 16, 3)
    assert np.abs(frames.Decoder().decode(head + whole)[1].astype(int) - 99).max() < 5
    for wrong in (frames.HEADER.pack(2, 1, 8, 16, 3) + whole, head + whole[:60], head, head + b"GIF89a"):
        with pytest.raises(frames.FrameError):
            frames.Decoder().decode(wrong)
