"""Frames in a real Chromium: the page draws them in order, and without loss if the picture stands still."""

from __future__ import annotations

import contextlib
import io
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from hippodrome.trial.pictures.encoder import Encoder
from hippodrome.trial.pictures.frames import DIFFERENCE, JPEG, KEY, ROWS, Frame, header, jpeg
from testing.browser import game_page
from tests.browser.world import OLD_BROWSERS, PATIENCE, World, play, wait_for_reconnection
from tests.trial.conftest import launch

__all__ = ["launch"]  # a fixture
pytestmark = pytest.mark.browser

AGENT = """
import numpy as np

class Agent:
    def start(self, game):
        self.noise = np.random.default_rng(7).integers(0, 256, (100, 160, 3), np.uint8).repeat(2, 0).repeat(2, 1)
    def reset(self):
        self.t = 0
    def step(self, action):
        self.t += 1
        return None, 0.0, False, False, {}
    def render(self):
        picture = np.roll(self.noise, 3 * self.t, axis=1)
        picture[:1, :8] = self.t // 256
        picture[1:2, :8] = self.t % 256
        return picture
    def close(self):
        pass
"""
HEIGHT, WIDTH = 200, 320
PIXELS = "[...document.getElementById('screen').getContext('2d').getImageData(0, 0, {width}, {height}).data]"


def picture_at(t: int) -> Frame:
    namespace: dict[str, Any] = {}
    exec(AGENT, namespace)
    agent = namespace["Agent"]()
    agent.start("")
    agent.t = t
    picture: Frame = agent.render()
    return picture


def pixels(tab: Any, width: int, height: int) -> Frame:
    data = tab.evaluate(PIXELS.format(width=width, height=height))
    return np.array(data, np.uint8).reshape(height, width, 4)[:, :, :3]


def step_of(picture: Frame) -> int:
    """Return the number of the step that the agent has written into the picture."""
    return 256 * int(picture[0, 0, 0]) + int(picture[1, 0, 0])


def wait_until(tab: Any, condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE / 1000
    while not condition():
        assert time.monotonic() < end
        tab.wait_for_timeout(20)


@pytest.fixture
def frame_kinds(tab: Any) -> list[int]:
    """The kinds of the frames that the page has received, in order."""
    kinds: list[int] = []

    def hear(data: Any) -> None:
        if isinstance(data, bytes):
            kinds.append(data[0])

    tab.on("websocket", lambda socket: socket.on("framereceived", hear))
    return kinds


@pytest.fixture
def texture_page(launch: Any) -> Iterator[str]:
    """The address of the page of a game that draws a scrolling texture."""
    server = launch(agent=AGENT, trial={"actionSpace": ["noop", "left"]})
    with game_page(server.address, user="P1", token="the-secret-token", step="3") as address:
        yield address


def test_a_texture_is_drawn_and_exact_once_it_stands_still(tab: Any, frame_kinds: list[int], texture_page: str) -> None:
    tab.goto(texture_page)
    tab.click("#overlay-button")
    wait_until(tab, lambda: frame_kinds.count(JPEG) >= 30)
    assert not {KEY, DIFFERENCE} & set(frame_kinds[5:])
    tab.keyboard.press("p")
    tab.wait_for_selector("#play[data-state=paused]", state="attached")
    wait_until(tab, lambda: ROWS in frame_kinds)
    wait_until(tab, lambda: np.array_equal(picture := pixels(tab, WIDTH, HEIGHT), picture_at(step_of(picture))))
    t = step_of(pixels(tab, WIDTH, HEIGHT))
    assert t >= 20
    before = frame_kinds.count(JPEG)
    tab.click("#overlay-button")
    wait_until(tab, lambda: frame_kinds.count(JPEG) >= before + 10)


def texture(seed: int, channels: int = 3) -> Frame:
    return np.random.default_rng(seed).integers(0, 256, (40, 60, channels), np.uint8).repeat(2, 0)


def test_frames_of_mixed_kinds_are_drawn_in_order(world: World, tab: Any) -> None:
    """The browser shows the encoder's frames as they were meant, and acknowledges each."""
    play(world, tab)
    encoder = Encoder(lossy=True)
    number = 2
    for picture in (texture(1), texture(1, 1), np.zeros((80, 60, 3), np.uint8), texture(2)):
        encoder_kinds = []
        for shift in (0, 3, 3, 6):
            number += 1
            data = encoder.encode(np.roll(picture, shift, 1), number)
            encoder_kinds.append(data[0])
            world.connections[0].send(data)
        world.wait_for({"ack": number})
        error = np.abs(pixels(tab, 60, 80).astype(int) - np.roll(picture, 6, 1)).mean()
        assert error < 60 if JPEG in encoder_kinds else error == 0
        while not encoder.exact:
            world.connections[0].send(encoder.sharpen(number))
        exact = np.broadcast_to(np.roll(picture, 6, 1), (80, 60, 3))
        wait_until(tab, lambda exact=exact: np.array_equal(pixels(tab, 60, 80), exact))
    assert len(world.connections) == 1


def test_a_burst_of_frames_is_acknowledged_and_the_newest_is_shown(world: World, tab: Any) -> None:
    """The page leaves out JPEGs that wait behind a slow one when a later one is ready, and never draws an older one later."""
    tab.add_init_script(
        """const plain = window.createImageBitmap;
        const first = new Promise((done) => { window.goOn = done; });
        let calls = 0;
        window.drawn = window.decoded = 0;
        window.createImageBitmap = async (...parts) => {
            if (calls++ === 0) await first;
            const bitmap = await plain(...parts);
            window.decoded += 1;
            return bitmap;
        };
        const draw = CanvasRenderingContext2D.prototype.drawImage;
        CanvasRenderingContext2D.prototype.drawImage = function (...parts) { window.drawn += 1; draw.apply(this, parts); };"""
    )
    play(world, tab)
    flat = [np.full((16, 16, 3), value, np.uint8) for value in range(10, 90, 10)]
    for number, frame in enumerate(flat, 3):
        world.connections[0].send(header(JPEG, frame, number) + jpeg(frame))
    wait_until(tab, lambda: tab.evaluate("window.decoded") == len(flat) - 1)
    tab.evaluate("window.goOn()")
    world.wait_for({"ack": 10})
    assert np.abs(pixels(tab, 16, 16).astype(int) - flat[-1]).max() <= 3
    assert 1 <= tab.evaluate("window.drawn") < len(flat)
    acks = world.commands("ack")
    assert acks == sorted(acks)
    assert len(world.connections) == 1


def test_every_second_frame_is_acknowledged_when_frames_come_quickly(world: World, tab: Any) -> None:
    tab.add_init_script(
        """window.clock = 1000;
        performance.now = () => window.clock;
        const wait = window.setTimeout, draw = CanvasRenderingContext2D.prototype.putImageData;
        window.setTimeout = (done, ms, ...more) => (ms === 50 ? 0 : wait(done, ms, ...more));
        window.drawn = 0;
        CanvasRenderingContext2D.prototype.putImageData = function (...parts) { window.drawn += 1; draw.apply(this, parts); };"""
    )
    play(world, tab)  # the server sends frames 1 and 2
    for number in range(3, 12):
        wait_until(tab, lambda number=number: tab.evaluate("window.drawn") == number - 1)
        tab.evaluate("window.clock += 20")
        world.connections[0].send(header(KEY, SMALL, number) + PACKED)
    world.wait_for({"ack": 11})
    assert world.commands("ack") == [1, 3, 5, 7, 9, 11]


def test_a_frame_that_no_other_follows_is_acknowledged(world: World, tab: Any) -> None:
    play(world, tab)
    for number in range(3, 8):
        world.connections[0].send(header(KEY, SMALL, number) + PACKED)
        world.wait_for({"ack": number})


def jpeg_of(width: int, height: int) -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (width, height)).save(out, "JPEG")
    return out.getvalue()


SMALL = np.zeros((2, 2, 3), np.uint8)
PACKED = zlib.compress(SMALL.tobytes(), wbits=-15)
MALFORMED = {
    "another size": header(JPEG, SMALL, 3) + jpeg_of(3, 2),
    "a huge one in a small frame": header(JPEG, SMALL, 3) + jpeg_of(5000, 5000),
    "no JPEG": header(JPEG, SMALL, 3) + b"nonsense",
    "cut off before its size": header(JPEG, SMALL, 3) + jpeg_of(2, 2)[:30],
    "too large": struct.pack("!BIHHB", JPEG, 3, 60_000, 60_000, 3) + jpeg_of(2, 2),
    "rows below the picture": header(ROWS, SMALL, 3) + struct.pack("!H", 2) + b"\x03\x00",
    "rows that are missing": header(ROWS, SMALL, 3) + struct.pack("!H", 1) + b"\x01\x06\x00\xf9\xff" + bytes(6),
    "an unknown kind": struct.pack("!BIHHB", 4, 3, 2, 2, 3) + bytes(20),
}


@pytest.mark.parametrize("bomb", MALFORMED)
def test_malformed_frames_are_refused(world: World, tab: Any, bomb: str) -> None:
    play(world, tab)
    world.connections[0].send(MALFORMED[bomb])
    wait_for_reconnection(world, tab)
    assert tab.evaluate("document.getElementById('screen').width") == 2


def test_a_small_message_cannot_fill_the_memory(world: World, tab: Any) -> None:
    packer = zlib.compressobj(wbits=-15)
    zeros = packer.compress(bytes(2**24)) + packer.flush(zlib.Z_FULL_FLUSH)
    play(world, tab)
    before = peak_memory(tab)
    world.connections[0].send(header(KEY, SMALL, 3) + 64 * zeros)  # 1 MB, unpacked 1 GB
    wait_for_reconnection(world, tab)
    assert peak_memory(tab) - before < 256


def peak_memory(tab: Any) -> float:
    """Return the most memory that a page of the browser has ever had, in megabytes."""
    asked = tab.context.browser.new_browser_cdp_session()
    processes = asked.send("SystemInfo.getProcessInfo")["processInfo"]
    asked.detach()
    statuses = []
    for one in processes:
        with contextlib.suppress(OSError):  # the renderer of an earlier page may have ended
            if one["type"] == "renderer":
                statuses.append(Path(f"/proc/{one['id']}/status").read_text())
    peaks = [int(status.split("VmHWM:")[1].split()[0]) for status in statuses if "VmHWM:" in status]
    return max(peaks) / 1024


@pytest.mark.parametrize("lacks", OLD_BROWSERS.values(), ids=OLD_BROWSERS.keys())
def test_a_browser_that_cannot_inflate_shows_jpegs(
    tab: Any, frame_kinds: list[int], texture_page: str, lacks: str
) -> None:
    tab.add_init_script(lacks)
    tab.goto(texture_page)
    tab.click("#overlay-button")
    wait_until(tab, lambda: len(frame_kinds) >= 10)
    wait_until(tab, lambda: pixels(tab, WIDTH, HEIGHT).std() > 30)  # the noise
    assert set(frame_kinds) == {JPEG}
