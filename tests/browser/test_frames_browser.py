"""Frames in a real Chromium: what arrives is drawn, in order, and a picture at rest is exact."""

from __future__ import annotations

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

from testing.browser import game_page
from tests.browser.conftest import PATIENCE
from tests.browser.test_pages_browser import World, play, reconnected, world
from tests.trial.conftest import launch
from trial.pictures.encoder import Encoder
from trial.pictures.frames import DIFFERENCE, JPEG, KEY, ROWS, Frame, header, jpeg

__all__ = ["launch", "world"]  # fixtures
pytestmark = [pytest.mark.browser, pytest.mark.xdist_group("browser")]

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


def expected(t: int) -> Frame:
    namespace: dict[str, Any] = {}
    exec(AGENT, namespace)
    agent = namespace["Agent"]()
    agent.start("")
    agent.t = t
    picture: Frame = agent.render()
    return picture


def shown(tab: Any, width: int, height: int) -> Frame:
    data = tab.evaluate(PIXELS.format(width=width, height=height))
    return np.array(data, np.uint8).reshape(height, width, 4)[:, :, :3]


def time_of(picture: Frame) -> int:
    """The number of the step that the agent has written into the picture."""
    return 256 * int(picture[0, 0, 0]) + int(picture[1, 0, 0])


def until(tab: Any, true: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE / 1000
    while not true():
        assert time.monotonic() < end
        tab.wait_for_timeout(20)


@pytest.fixture
def sent(tab: Any) -> list[int]:
    """The kinds of frames that the page has been sent."""
    kinds: list[int] = []

    def hear(data: Any) -> None:
        if isinstance(data, bytes):
            kinds.append(data[0])

    tab.on("websocket", lambda socket: socket.on("framereceived", hear))
    return kinds


@pytest.fixture
def textured(launch: Any) -> Iterator[str]:
    """The address of the game page of a game whose texture scrolls."""
    server = launch(agent=AGENT, trial={"actionSpace": ["noop", "left"]})
    with game_page(server.address, user="P1", token="the-secret-token", step="3") as address:
        yield address


def test_a_texture_is_drawn_and_exact_once_it_stands_still(tab: Any, sent: list[int], textured: str) -> None:
    tab.goto(textured)
    tab.click("#overlay-button")
    until(tab, lambda: sent.count(JPEG) >= 30)
    assert not {KEY, DIFFERENCE} & set(sent[5:])
    tab.keyboard.press("p")
    tab.wait_for_selector("#mode[data-state=paused]", state="attached")
    until(tab, lambda: ROWS in sent)
    until(tab, lambda: np.array_equal(picture := shown(tab, WIDTH, HEIGHT), expected(time_of(picture))))
    t = time_of(shown(tab, WIDTH, HEIGHT))
    assert t >= 20
    before = sent.count(JPEG)
    tab.click("#overlay-button")
    until(tab, lambda: sent.count(JPEG) >= before + 10)


@pytest.fixture
def new_world(world: World) -> World:
    """A trial server that speaks hippodrome.2."""
    world.spoken = "hippodrome.2"
    return world


def texture(seed: int, channels: int = 3) -> Frame:
    return np.random.default_rng(seed).integers(0, 256, (40, 60, channels), np.uint8).repeat(2, 0)


def test_mixed_kinds_are_drawn_in_order(new_world: World, tab: Any) -> None:
    """What the encoder makes of a sequence is shown by the browser as it is meant, and every frame is acknowledged."""
    play(new_world, tab)
    encoder = Encoder(lossy=True)
    number = 2
    for picture in (texture(1), texture(1, 1), np.zeros((80, 60, 3), np.uint8), texture(2)):
        encoder_kinds = []
        for shift in (0, 3, 3, 6):
            number += 1
            data = encoder.encode(np.roll(picture, shift, 1), number)
            encoder_kinds.append(data[0])
            new_world.connections[0].send(data)
        new_world.wait_for({"ack": number})
        error = np.abs(shown(tab, 60, 80).astype(int) - np.roll(picture, 6, 1)).mean()
        assert error < 60 if JPEG in encoder_kinds else error == 0
        while not encoder.exact:
            new_world.connections[0].send(encoder.sharpen(number))
        exact = np.broadcast_to(np.roll(picture, 6, 1), (80, 60, 3))
        until(tab, lambda exact=exact: np.array_equal(shown(tab, 60, 80), exact))
    assert len(new_world.connections) == 1


def test_a_burst_is_acknowledged_to_the_end_and_the_newest_is_shown(new_world: World, tab: Any) -> None:
    """JPEGs that wait behind a slow one are left out when a later picture is ready; none comes after a newer one."""
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
    play(new_world, tab)
    flat = [np.full((16, 16, 3), value, np.uint8) for value in range(10, 90, 10)]
    for number, frame in enumerate(flat, 3):
        new_world.connections[0].send(header(JPEG, frame, number) + jpeg(frame))
    until(tab, lambda: tab.evaluate("window.decoded") == len(flat) - 1)
    tab.evaluate("window.goOn()")
    new_world.wait_for({"ack": 10})
    assert np.abs(shown(tab, 16, 16).astype(int) - flat[-1]).max() <= 3
    assert 1 <= tab.evaluate("window.drawn") < len(flat)
    acks = new_world.commands("ack")
    assert acks == sorted(acks)
    assert len(new_world.connections) == 1


def test_every_second_frame_is_acknowledged_where_they_come_quickly(new_world: World, tab: Any) -> None:
    tab.add_init_script(
        """window.clock = 1000;
        performance.now = () => window.clock;
        const wait = window.setTimeout, draw = CanvasRenderingContext2D.prototype.putImageData;
        window.setTimeout = (done, ms, ...more) => (ms === 50 ? 0 : wait(done, ms, ...more));
        window.drawn = 0;
        CanvasRenderingContext2D.prototype.putImageData = function (...parts) { window.drawn += 1; draw.apply(this, parts); };"""
    )
    play(new_world, tab)  # the server sends frames 1 and 2
    for number in range(3, 12):
        until(tab, lambda number=number: tab.evaluate("window.drawn") == number - 1)
        tab.evaluate("window.clock += 20")
        new_world.connections[0].send(header(KEY, SMALL, number) + PACKED)
    new_world.wait_for({"ack": 11})
    assert new_world.commands("ack") == [1, 3, 5, 7, 9, 11]


def test_a_frame_that_no_other_follows_is_acknowledged(new_world: World, tab: Any) -> None:
    play(new_world, tab)
    for number in range(3, 8):
        new_world.connections[0].send(header(KEY, SMALL, number) + PACKED)
        new_world.wait_for({"ack": number})


def jpeg_of(width: int, height: int) -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (width, height)).save(out, "JPEG")
    return out.getvalue()


SMALL = np.zeros((2, 2, 3), np.uint8)
PACKED = zlib.compress(SMALL.tobytes(), wbits=-15)
BOMBS = {
    "another size": header(JPEG, SMALL, 3) + jpeg_of(3, 2),
    "a huge one in a small frame": header(JPEG, SMALL, 3) + jpeg_of(5000, 5000),
    "no JPEG": header(JPEG, SMALL, 3) + b"nonsense",
    "cut off before its size": header(JPEG, SMALL, 3) + jpeg_of(2, 2)[:30],
    "too large": struct.pack("!BIHHB", JPEG, 3, 60_000, 60_000, 3) + jpeg_of(2, 2),
    "rows below the picture": header(ROWS, SMALL, 3) + struct.pack("!H", 2) + b"\x03\x00",
    "rows that are missing": header(ROWS, SMALL, 3) + struct.pack("!H", 1) + b"\x01\x06\x00\xf9\xff" + bytes(6),
    "an unknown kind": struct.pack("!BIHHB", 4, 3, 2, 2, 3) + bytes(20),
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_frames_that_are_none_are_refused(new_world: World, tab: Any, bomb: str) -> None:
    play(new_world, tab)
    new_world.connections[0].send(BOMBS[bomb])
    reconnected(new_world, tab)
    assert tab.evaluate("document.getElementById('screen').width") == 2


def test_a_small_message_cannot_fill_the_memory(new_world: World, tab: Any) -> None:
    packer = zlib.compressobj(wbits=-15)
    zeros = packer.compress(bytes(2**24)) + packer.flush(zlib.Z_FULL_FLUSH)
    play(new_world, tab)
    before = most_memory(tab)
    new_world.connections[0].send(header(KEY, SMALL, 3) + 64 * zeros)  # 1 MB, unpacked 1 GB
    reconnected(new_world, tab)
    assert most_memory(tab) - before < 256


def most_memory(tab: Any) -> float:
    """The megabytes that the browser's pages ever had at a time."""
    asked = tab.context.browser.new_browser_cdp_session()
    processes = asked.send("SystemInfo.getProcessInfo")["processInfo"]
    asked.detach()
    statuses = [Path(f"/proc/{one['id']}/status").read_text() for one in processes if one["type"] == "renderer"]
    return max(int(status.split("VmHWM:")[1].split()[0]) for status in statuses) / 1024


def test_a_browser_that_cannot_decode_gets_what_it_knows(launch: Any, tab: Any, sent: list[int]) -> None:
    server = launch(agent=AGENT, trial={"actionSpace": ["noop", "left"]})
    tab.add_init_script("delete window.createImageBitmap")
    with game_page(server.address, user="P1", token="the-secret-token", step="3") as address:
        tab.goto(address)
        tab.click("#overlay-button")
        until(tab, lambda: len(sent) >= 10)
    assert set(sent) == {KEY, DIFFERENCE}
