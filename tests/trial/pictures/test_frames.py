"""Pictures on the wire: exact where that is promised, small, and close to the original where something is lost."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import io
import json
import math
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from hippodrome.trial.pictures import frames
from hippodrome.trial.pictures.encoder import Encoder
from hippodrome.trial.pictures.frames import DIFFERENCE, JPEG, KEY, ROWS, Decoder, Frame, jpeg_message
from hippodrome.trial.wire import connection as connections
from hippodrome.trial.wire.connection import SUBPROTOCOL, Connection
from testing.exploration import examples
from testing.waiting import PATIENCE

EXACT = {KEY, DIFFERENCE}


# ---- without loss


@st.composite
def pictures(draw):
    shapes = st.tuples(st.integers(1, 12), st.integers(1, 12), st.sampled_from([1, 3]))
    sequence = []
    shape = draw(shapes)
    for _ in range(draw(st.integers(1, 8))):
        if draw(st.booleans()) and draw(st.booleans()):
            shape = draw(shapes)
        data = draw(st.binary(min_size=math.prod(shape), max_size=math.prod(shape)))
        sequence.append(np.frombuffer(data, np.uint8).reshape(shape))
    return sequence


@given(pictures(), st.integers(0, 2**33))
def test_any_sequence_of_frames_arrives_unchanged(sequence, first):
    encoder, last = Encoder(), None
    for number, frame in enumerate(sequence):
        data = encoder.encode(frame, first + number)
        # A browser's decoding, written a second time: independent of our own decoder.
        kind = data[0]
        assert int.from_bytes(data[1:5], "big") == (first + number) % 2**32
        width, height = int.from_bytes(data[5:7], "big"), int.from_bytes(data[7:9], "big")
        assert (height, width, data[9]) == frame.shape
        pixels = zlib.decompressobj(-15).decompress(data[10:])
        if kind == 1:
            pixels = bytes(a ^ b for a, b in zip(pixels, last, strict=True))
        else:
            assert kind == 0
        assert pixels == frame.tobytes()
        last = pixels
    assert kind == (1 if len(sequence) > 1 and sequence[-1].shape == sequence[-2].shape else 0)


@given(pictures())
def test_decoder_undoes_encoder(sequence):
    encoder, decoder = Encoder(), frames.Decoder()
    for number, frame in enumerate(sequence):
        found, same = decoder.decode(encoder.encode(frame, number))
        assert found == number
        assert np.array_equal(same, frame)


@given(st.binary(max_size=60))
def test_the_decoder_reads_or_refuses_any_bytes(data):
    with contextlib.suppress(frames.FrameError):
        frames.Decoder().decode(data)


def test_render_may_return_images_of_bytes_and_nothing_else():
    assert frames.as_frame(np.zeros((4, 5), np.uint8)).shape == (4, 5, 1)
    assert frames.as_frame(np.zeros((4, 5, 4), np.uint8)).shape == (4, 5, 3)
    assert frames.as_frame(np.zeros((5, 4, 3), np.uint8).transpose(1, 0, 2)).flags.c_contiguous
    mine = np.zeros((2, 2, 3), np.uint8)
    kept = frames.as_frame(mine)
    mine[:] = 9
    assert not kept.any(), "the agent may draw into the same array again"
    for wrong in (None, np.zeros((4, 5, 3)), np.zeros((4, 5, 2), np.uint8), np.zeros((0, 5, 3), np.uint8), "x", [[]]):
        with pytest.raises(frames.FrameError):
            frames.as_frame(wrong)


def test_a_picture_that_no_browser_could_show_is_refused():
    pixel = np.zeros(1, np.uint8)
    for shape in ((60_000, 60_000, 3), (4097, 4096, 3), (65536, 1), (1, 70_000, 3), (2**40, 2**20, 3)):
        with pytest.raises(frames.FrameError):
            frames.as_frame(np.lib.stride_tricks.as_strided(pixel, shape, (0,) * len(shape)))  # costs no memory
    assert frames.as_frame(np.zeros((4096, 4096), np.uint8)).shape == (4096, 4096, 1)


# ---- with loss where that is cheaper

SHAPES = [(48, 40, 3), (40, 64, 1), (8, 200, 3), (1, 1, 3), (1, 1, 1), (64, 1, 3)]


def texture(height: int, width: int, channels: int = 3, seed: int = 7) -> Frame:
    """Something like grass and gravel: noise of several sizes."""
    random = np.random.default_rng(seed)
    mixed = np.full((height, width, channels), 128.0)
    for size in (1, 2, 4, 8):
        coarse = random.normal(scale=10 * size**0.5, size=(height // size + 1, width // size + 1, channels))
        mixed += coarse.repeat(size, 0).repeat(size, 1)[:height, :width]
    return mixed.clip(0, 255).astype(np.uint8)


def scrolling(count: int, height: int = 120, width: int = 200) -> list[Frame]:
    whole = texture(height, width + 3 * count)
    return [np.ascontiguousarray(whole[:, 3 * number : 3 * number + width]) for number in range(count)]


def with_figure(background: Frame, number: int) -> Frame:
    """Return a small square that walks over a picture."""
    frame = background.copy()
    at = 4 * number % (background.shape[1] - 10)
    frame[10:20, at : at + 10] = 255
    return frame


def hippos_picture(frame: Frame) -> Frame:
    """Return the picture that HIPPO's browsers would show."""
    data = base64.b64decode(json.loads(jpeg_message(frame, 0))["frame"])
    return np.asarray(Image.open(io.BytesIO(data))).reshape(frame.shape)


def mean_error(shown: Frame, frame: Frame) -> float:
    return float(np.abs(shown.astype(int) - frame).mean())


@st.composite
def lively_pictures(draw: Any) -> list[Frame]:
    """Pictures as games make them: still, scrolling, flickering, another size."""
    changes = st.sampled_from(["noise", "texture", "flat", "same", "same", "scroll", "dot", "size"])
    frame = texture(*draw(st.sampled_from(SHAPES)))
    sequence = [frame]
    for number in range(draw(st.integers(1, 60))):
        change = draw(changes)
        random = np.random.default_rng(number)
        if change == "noise":
            frame = random.integers(0, 256, frame.shape, np.uint8)
        elif change == "texture":
            frame = texture(*frame.shape, seed=number)
        elif change == "flat":
            frame = np.full_like(frame, number)
        elif change == "scroll":
            frame = np.roll(frame, 1, axis=1)
        elif change == "dot":
            frame = frame.copy()
            frame[random.integers(len(frame)), 0] ^= 255
        elif change == "size":
            frame = texture(*draw(st.sampled_from(SHAPES)))
        sequence.append(frame)
    return sequence


@settings(max_examples=examples(40))
@given(lively_pictures(), st.integers(0, 59))
def test_each_frame_shown_is_exact_or_as_good_as_a_jpeg(sequence: list[Frame], joins: int) -> None:
    encoder, decoder = Encoder(lossy=True), Decoder()
    for number, frame in enumerate(sequence):
        if number == joins:  # a client that connects later has none of the frames before
            encoder, decoder = Encoder(lossy=True), Decoder()
        data = encoder.encode(frame, number)
        found, shown = decoder.decode(data)
        assert found == number
        assert encoder.exact == np.array_equal(shown, frame) or data[0] in (JPEG, ROWS)
        if data[0] in EXACT:
            assert np.array_equal(shown, frame)
        assert mean_error(shown, frame) <= mean_error(hippos_picture(frame), frame) + 0.5
        if encoder.exact:
            assert np.array_equal(shown, frame)
    while not encoder.exact:
        data = encoder.sharpen(number)
        found, shown = decoder.decode(data)
        assert (data[0], found) == (ROWS, number)
    assert np.array_equal(shown, frame)


@settings(max_examples=examples(25))
@given(lively_pictures())
def test_no_sequence_takes_a_fifth_more_bytes_than_hippos(sequence: list[Frame]) -> None:
    encoder = Encoder(lossy=True)
    ours = sum(len(encoder.encode(frame, number)) for number, frame in enumerate(sequence))
    hippos = sum(len(jpeg_message(frame, number)) for number, frame in enumerate(sequence))
    assert ours <= 1.2 * hippos


def test_a_scrolling_texture_is_sent_as_jpegs() -> None:
    sequence = scrolling(40)
    encoder = Encoder(lossy=True)
    sent = [encoder.encode(frame, number) for number, frame in enumerate(sequence)]
    assert {data[0] for data in sent} == {JPEG}
    assert all(
        len(data) <= len(jpeg_message(frame, number))
        for number, (data, frame) in enumerate(zip(sent, sequence, strict=True))
    )
    again = Encoder(lossy=True)
    assert [again.encode(frame, number) for number, frame in enumerate(sequence)] == sent, "the same on every machine"


def test_a_flat_game_is_exact_from_the_first_frame() -> None:
    background = np.zeros((210, 160, 3), np.uint8)
    background[40:60] = 90
    encoder = Encoder(lossy=True)
    sent = [encoder.encode(with_figure(background, number), number) for number in range(100)]
    assert [data[0] for data in sent] == [KEY] + [DIFFERENCE] * 99
    assert max(map(len, sent)) < 600


def test_a_flash_costs_no_second_whole_picture() -> None:
    """Differences go on from what was exact before the JPEGs."""
    background = texture(120, 200)
    encoder, decoder = Encoder(lossy=True), Decoder()
    decoder.decode(encoder.encode(background, 0))
    while not encoder.exact:
        decoder.decode(encoder.sharpen(0))
    kinds = []
    for number in range(1, 60):
        frame = with_figure(texture(120, 200, seed=9) if number in (5, 6) else background, number)
        data = encoder.encode(frame, number)
        kinds.append(data[0])
        assert mean_error(decoder.decode(data)[1], frame) < 20
    assert kinds.count(KEY) == kinds.count(ROWS) == 0
    assert kinds[:4] == [DIFFERENCE] * 4
    assert JPEG in kinds[4:6]
    assert kinds[25:] == [DIFFERENCE] * 34


def test_a_calm_texture_becomes_exact_while_the_game_goes_on() -> None:
    """A new scene in which only a figure moves."""
    encoder, decoder = Encoder(lossy=True), Decoder()
    scene = [with_figure(texture(120, 200), number) for number in range(300)]
    sent = [encoder.encode(frame, number) for number, frame in enumerate(scene)]
    kinds = [data[0] for data in sent]
    assert kinds.count(KEY) == 1
    assert set(kinds[kinds.index(KEY) + 1 :]) == {DIFFERENCE}
    until = kinds.index(KEY) + 1
    assert sum(map(len, sent[:until])) <= 1.2 * sum(len(jpeg_message(frame, 0)) for frame in scene[:until])
    for data in sent:
        shown = decoder.decode(data)[1]
    assert np.array_equal(shown, scene[-1])


def test_a_still_picture_becomes_exact_in_small_parts() -> None:
    frame = texture(120, 200)
    encoder, decoder = Encoder(lossy=True), Decoder()
    parts = [encoder.encode(frame, number) for number in range(30)]  # the game shows the same again and again
    kinds = [data[0] for data in parts]
    rows = kinds.count(ROWS)
    assert kinds == [JPEG] + [ROWS] * rows + [DIFFERENCE] * (29 - rows)
    assert all(len(data) <= len(jpeg_message(frame, 0)) for data in parts)
    for data in parts:
        shown = decoder.decode(data)[1]
    assert np.array_equal(shown, frame)


def test_a_picture_too_long_for_a_jpeg_is_exact() -> None:
    frame = np.random.default_rng(1).integers(0, 256, (1, 65_535, 3), np.uint8)
    data = Encoder(lossy=True).encode(frame, 1)
    assert data[0] == KEY
    assert np.array_equal(Decoder().decode(data)[1], frame)


def test_the_decoder_refuses_broken_frames_and_changes_of_frames_that_it_does_not_have() -> None:
    frame = texture(48, 40)
    encoder = Encoder(lossy=True)
    first = encoder.encode(frame, 1)
    assert first[0] == JPEG
    rows = encoder.sharpen(1)
    later = encoder.sharpen(1)
    wider = frames.HEADER.pack(JPEG, 1, 41, 48, 3) + first[frames.HEADER.size :]
    nothing = frames.packed(np.zeros_like(frame))
    assert nothing is not None
    missing = frames.HEADER.pack(DIFFERENCE, 2, 40, 48, 3) + nothing
    for sequence in (
        [rows],
        [first, later],
        [first, rows[:11]],
        [first, rows + b"x"],
        [first, rows, rows, rows, later, later],
        [first, missing],
        [first, rows, missing],
        [first[:-20]],
        [wider],
        [first[:10] + b"nonsense"],
        [first[:5] + bytes(4) + first[9:]],
        [first[:9] + b"\x02" + first[10:]],
        [b"\x04" + first[1:]],
    ):
        decoder = Decoder()
        with pytest.raises(frames.FrameError):  # noqa: PT012 - the last of them is refused
            for data in sequence:
                decoder.decode(data)


# ---- a client's connection


class SentMessages:
    """A websocket that keeps the messages that it is given to send."""

    subprotocol = SUBPROTOCOL

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.transport = self

    def get_extra_info(self, _: str) -> None:
        return None

    async def send(self, data: Any) -> None:
        self.sent.append(data)


def sent_over_a_connection(decodes: list[str], *, lossless: bool) -> tuple[list[int], Frame]:
    """Return the kinds of frames that a scrolling texture is sent as, and what is shown once it has stopped."""
    sequence = scrolling(10)

    async def talk(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
        # So that all pictures follow each other, however slow the machine is.
        monkeypatch.setattr(connections, "REST_SECONDS", 3600.0)
        websocket = SentMessages()
        connection = Connection(websocket, decodes=decodes, lossless=lossless)  # type: ignore[arg-type]
        running = asyncio.create_task(connection.run())
        for number, frame in enumerate(sequence):
            if number == len(sequence) - 1:
                monkeypatch.undo()
            connection.show(frame, number)
            async with asyncio.timeout(PATIENCE):
                while len(websocket.sent) <= number:
                    await asyncio.sleep(0.001)
        if websocket.sent[-1][0] == JPEG:
            async with asyncio.timeout(PATIENCE):
                decoder = Decoder()
                while not any(np.array_equal(decoder.decode(data)[1], sequence[-1]) for data in websocket.sent):
                    await asyncio.sleep(0.01)
                    decoder = Decoder()
        running.cancel()
        return websocket.sent

    decoder = Decoder()
    with pytest.MonkeyPatch.context() as monkeypatch:
        sent = asyncio.run(talk(monkeypatch))
    for data in sent:
        shown = decoder.decode(data)[1]
    assert np.array_equal(shown, sequence[-1])
    return [data[0] for data in sent], shown


def test_a_connection_makes_a_picture_exact_that_no_other_follows() -> None:
    kinds, _ = sent_over_a_connection(["deflate", "jpeg"], lossless=False)
    assert kinds[:10] == [JPEG] * 10
    assert set(kinds[10:]) == {ROWS}


@pytest.mark.parametrize(("decodes", "lossless"), [(["deflate", "jpeg"], True), (["deflate"], False)])
def test_no_jpeg_is_sent_if_the_study_wants_none_or_the_client_decodes_none(decodes: list[str], lossless: bool) -> None:
    kinds, _ = sent_over_a_connection(decodes, lossless=lossless)
    assert kinds == [KEY] + [DIFFERENCE] * 9


SPACE = {"actionSpace": ["noop", "left"]}
TEXTURED = """
import numpy as np

class Agent:
    def start(self, game):
        noise = np.random.default_rng(7).integers(0, 256, (100, 400, 3), np.uint8)
        self.noise = noise.repeat(2, 0).repeat(2, 1)
    def reset(self):
        self.t = 0
    def step(self, action):
        self.t += 1
        return None, 0.0, False, False, {}
    def render(self):
        picture = np.roll(self.noise, 3 * self.t, axis=1)[:, :300].copy()
        picture[0, :2] = self.t // 256, self.t % 256, 0
        return picture
    def close(self):
        pass
"""


def textured(seen: Any) -> Any:
    """Return the agent's picture of the step that the first pixel of this one names."""
    step = 256 * int(seen[0, 0, 0]) + int(seen[0, 0, 1])
    noise = np.random.default_rng(7).integers(0, 256, (100, 400, 3), np.uint8).repeat(2, 0).repeat(2, 1)
    picture = np.roll(noise, 3 * step, axis=1)[:, :300].copy()
    picture[0, :2] = step // 256, step % 256, 0
    return picture


async def test_a_texture_on_its_way_to_clients_with_and_without_jpegs(launch: Any, open_client: Any) -> None:
    server = launch(agent=TEXTURED, trial=SPACE)
    async with open_client(server.address) as client:
        await client.play(1)
        # Where the game is late, as on a busy machine, rows make its picture exact, and the next one may be a difference.
        await client.until(lambda: client.kinds[-20:] == [JPEG] * 20)
    async with open_client(server.address) as simple:
        await simple.start(decodes=["deflate"])
        await simple.see(20)
        assert set(simple.kinds) == EXACT
        await simple.say(command="pause")
        await simple.until(lambda: simple.state["state"] == "paused")
    async with open_client(server.address) as later:
        await later.hello()
        await later.until(lambda: later.frames and np.array_equal(later.frame, textured(later.frame)))
        # A step that was under way when the game was paused may still bring a picture.
        assert set(later.kinds) == {JPEG, ROWS}
        assert (later.kinds[0], later.kinds[-1]) == (JPEG, ROWS)


async def test_lossless_keeps_every_picture(launch: Any, open_client: Any) -> None:
    server = launch(agent=TEXTURED, trial={**SPACE, "lossless": True})
    async with open_client(server.address) as client:
        await client.play(30)
        assert set(client.kinds) == EXACT


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "P", "1", "LA", "CMYK"])
def test_a_picture_of_pillow_shows_its_colours_in_every_mode(mode: str) -> None:
    picture = Image.new("RGB", (3, 2), (255, 255, 255)).convert(mode)
    assert frames.as_frame(picture).tolist() == [[[255, 255, 255]] * 3] * 2


class Surface:
    """Such as pygame's: it is not an array."""


@pytest.mark.parametrize(
    ("picture", "described"),
    [
        (Surface(), "Surface"),
        ("a text", "str"),
        ([np.zeros((2, 3, 3), np.uint8)], "uint8 of (1, 2, 3, 3)"),
        ([np.zeros((2, 3, 3)), np.zeros((1, 3, 3))], "list"),
        (np.zeros((2, 3, 3)), "float64 of (2, 3, 3)"),
    ],
)
def test_what_is_not_a_picture_is_named_with_the_advice_of_gymnasium(picture: Any, described: str) -> None:
    with pytest.raises(frames.FrameError) as raised:
        frames.as_frame(picture)
    assert str(raised.value).startswith(f"render() returned {described}, and must return height x width x 3 bytes")
    assert str(raised.value).endswith("render_mode='rgb_array'")
