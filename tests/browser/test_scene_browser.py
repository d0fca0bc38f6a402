"""Games that are drawn by objects, in a real Chromium on a real trial server."""

from __future__ import annotations

import io
import json
import re
import struct
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from testing.processes import ROOT
from tests.browser.world import FLAWS, OLD_BROWSERS, PATIENCE, RED, World, deflated_zeros, pack, shot
from tests.browser.world import play as open_game
from tests.trial.conftest import Running

pytestmark = pytest.mark.browser

AGENT = """
class Agent:
    def start(self, game):
        self.t = self.x = 0
    def reset(self, seed=None):
        self.t = self.x = 0
    def step(self, action):
        self.t += 1
        self.x = max(self.x, action)
        return None, 1.0, self.t >= 5000, False, {}
    def render(self):
        return {"hud": "Caught: <b>3</b> of 10", "objects": [
            {"id": "sky", "type": "rectangle", "x": 0, "y": 0, "width": 600, "height": 400, "color": "#bfe3f2", "permanent": True, "depth": -2},
            {"id": "hill", "type": "line", "points": [(0, 0.8), (0.3, 0.65), (0.7, 0.8), (1, 0.7)], "fill_below": True, "color": "#4f9d69", "depth": -1},
            {"id": "sun", "type": "circle", "x": 0.85, "y": 0.15, "radius": 30, "color": "#f6c445", "outline": "#e08e1b", "outline_width": 4},
            {"id": "house", "type": "polygon", "points": [(0.1, 0.7), (0.1, 0.5), (0.17, 0.4), (0.24, 0.5), (0.24, 0.7)], "color": "#b5533c"},
            {"id": "box", "type": "rectangle", "x": 0.6, "y": 0.5, "width": 60, "height": 60, "angle": 45, "origin": (0.5, 0.5), "color": "#7a4fbf"},
            {"id": "label", "type": "text", "x": 0.5, "y": 0.05, "origin": (0.5, 0), "text": "3 < 4 <b>&amp;\\nsecond line", "size": 24},
            {"id": "cook", "type": "sprite", "image": "cook", "frame": 1, "x": 0.4, "y": 0.75, "width": 64, "height": 64},
            {"id": "runner", "type": "sprite", "image": "cook", "animation": "walk", "x": 0.2 * self.x, "y": 0.8, "width": 64, "tween": 10000},
            {"id": "lost", "type": "sprite", "image": "nowhere", "x": 0.75, "y": 0.8, "width": 40, "height": 40},
        ]}
    def close(self):
        pass
"""
SCENE = {"width": 600, "height": 400, "background": "#000000", "pixelArt": True}
SHOWN = """([x, y]) => {
    const easel = document.querySelectorAll(".stage canvas")[1];
    const at = [Math.floor(x * easel.width), Math.floor(y * easel.height), 1, 1];
    return "#" + [...easel.getContext("2d").getImageData(...at).data.slice(0, 3)].map((n) => n.toString(16).padStart(2, "0")).join("");
}"""


def draw_cook(folder: Path, noise: int = 0) -> None:
    """An atlas of two frames of 16 by 16 pixels, one blue and one red; and an image of `noise` by `noise` pixels."""
    folder.mkdir(parents=True)
    sheet = np.zeros((16, 32, 4), np.uint8)
    sheet[2:14, 2:14] = (32, 64, 200, 255)
    sheet[2:14, 18:30] = (200, 32, 64, 255)
    Image.fromarray(sheet).save(folder / "cook.png")
    atlas = {"frameWidth": 16, "animations": {"walk": {"frames": [0, 1], "frameRate": 4}}}
    (folder / "cook.json").write_text(json.dumps(atlas))
    if noise:
        pixels = np.random.default_rng(1).integers(0, 256, (noise, noise, 3), np.uint8)
        Image.fromarray(pixels).save(folder / "noise.png")


def play(world: World, tab: Any, folder: Path, width: int = 1280, height: int = 800, noise: int = 0) -> Running:
    """Open the page of a game that has just begun on a real server."""
    draw_cook(folder / "agent" / "assets", noise)
    trial = {"actionSpace": ["noop", "right"], "scene": SCENE, "maxEpisodes": 1}
    server = Running(folder, AGENT, trial, {})
    tab.set_viewport_size({"width": width, "height": height})
    world.trial = {"scene": SCENE}
    world.step = 2
    world.state = {**world.state, "state": "ready", "url": server.address, "token": "the-secret-token", "userId": "P1"}
    tab.goto(world.url)
    return server


@pytest.fixture
def game(world: World, tab: Any, tmp_path: Path) -> Iterator[Any]:
    started: list[Running] = []

    def start(**options: Any) -> Running:
        started.append(play(world, tab, tmp_path, **options))
        return started[0]

    yield start
    for server in started:
        server.process.kill()
        server.wait()


@pytest.mark.parametrize(("width", "height"), [(360, 740), (1280, 800)])
def test_every_type_of_object_is_drawn_where_it_belongs(game: Any, tab: Any, width: int, height: int) -> None:
    game(width=width, height=height)
    tab.click("#overlay-button")
    tab.wait_for_selector("#play[data-state=playing]", state="attached")
    spots = {
        **{(0.01, 0.3): "#bfe3f2", (0.5, 0.98): "#4f9d69", (0.85, 0.15): "#f6c445", (0.17, 0.6): "#b5533c"},
        **{(0.6, 0.5): "#7a4fbf", (0.6, 0.41): "#7a4fbf", (0.66, 0.43): "#bfe3f2"},  # turned about its middle
        (0.45, 0.83): "#c82040",  # the red frame of the atlas
    }
    until = time.monotonic() + PATIENCE / 1000
    while (shown := {spot: tab.evaluate(SHOWN, list(spot)) for spot in spots}) != spots and time.monotonic() < until:
        tab.wait_for_timeout(20)
    assert shown == spots
    assert tab.inner_text("#scene-hud") == "Caught: <b>3</b> of 10"
    assert tab.evaluate(FLAWS) == []
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    shot(tab, f"{width}-scene")
    easel = tab.evaluate(
        "(({ width, clientWidth }) => [width, clientWidth])(document.querySelectorAll('.stage canvas')[1])"
    )
    assert easel[0] == easel[1] * tab.evaluate("devicePixelRatio")


@pytest.mark.parametrize("lacks", OLD_BROWSERS.values(), ids=OLD_BROWSERS.keys())
def test_a_browser_that_cannot_inflate_draws_objects(game: Any, tab: Any, lacks: str) -> None:
    tab.add_init_script(lacks)
    game()
    tab.click("#overlay-button")
    tab.wait_for_selector("#play[data-state=playing]", state="attached")
    tab.wait_for_function(f"""() => ({SHOWN})([0.17, 0.6]) === "#b5533c" && ({SHOWN})([0.45, 0.83]) === "#c82040" """)


def test_a_sprite_with_a_tween_moves_between_two_pictures(game: Any, tab: Any) -> None:
    game()
    tab.click("#overlay-button")
    tab.wait_for_selector("#play[data-state=playing]", state="attached")
    tab.evaluate(
        """() => {
            const easel = document.querySelectorAll(".stage canvas")[1];
            window.seen = [];
            const look = () => {
                const row = easel.getContext("2d").getImageData(0, Math.floor(0.88 * easel.height), easel.width, 1).data;
                for (let x = 0; x < easel.width; x += 1) {
                    if (row[4 * x + 1] < 100) { seen.push(x / easel.width); break; }
                }
                requestAnimationFrame(look);
            };
            look();
        }"""
    )
    tab.keyboard.press("ArrowRight")
    tab.wait_for_function("() => new Set(seen.map((place) => place.toFixed(4))).size > 5")
    seen = tab.evaluate("seen")
    assert seen == sorted(seen)


COLORS = """() => {
    const { width, height } = document.querySelectorAll('.stage canvas')[1];
    const { data } = document.querySelectorAll('.stage canvas')[1].getContext('2d').getImageData(1, 1, width - 2, height - 2);
    return [...new Set(new Uint32Array(data.buffer))].length;
}"""


@pytest.mark.parametrize("width", [360, 411, 1280])
@pytest.mark.parametrize("kind", [{"type": "rectangle", "color": "#336699"}, {"type": "sprite", "image": "missing"}])
def test_between_the_tiles_of_a_grid_there_are_no_lines(
    world: World, tab: Any, kind: dict[str, Any], width: int
) -> None:
    scene = {"width": 585, "height": 315, "background": "#ffffff", "coordinates": "pixels"}
    world.trial = {"scene": scene}
    world.controls |= {"scene": scene, "assets": []}
    tab.set_viewport_size({"width": width, "height": 740})
    open_game(world, tab)
    tiles = {
        f"{x},{y}": {**kind, "x": 45 * x, "y": 45 * y, "width": 45, "height": 45} for x in range(13) for y in range(7)
    }
    world.connections[0].send(b"\x04" + struct.pack("!I", 3) + json.dumps({"new": True, "set": tiles}).encode())
    world.wait_for({"ack": 3})
    shot(tab, f"{width}-grid-{kind['type']}")
    assert tab.evaluate(COLORS) == 1


COUNT_DRAWINGS = """(() => {
    const { fillRect } = CanvasRenderingContext2D.prototype;
    window.drawings = 0; // each begins with the background
    CanvasRenderingContext2D.prototype.fillRect = function (...box) { window.drawings += 1; fillRect.apply(this, box); };
})()"""


def test_a_scene_is_only_drawn_if_an_object_has_changed(world: World, tab: Any) -> None:
    world.trial = {"scene": SCENE}
    world.controls |= {"scene": SCENE | {"coordinates": "relative"}, "assets": []}
    tab.add_init_script(COUNT_DRAWINGS)
    open_game(world, tab)
    shown = []

    def show(number: int, **scene: Any) -> None:
        world.connections[0].send(b"\x04" + struct.pack("!I", number) + json.dumps(scene).encode())
        world.wait_for({"ack": number})
        shown.append((tab.evaluate("drawings"), tab.evaluate(SHOWN, [0.25, 0.25])))

    sun = {"type": "circle", "x": 0.25, "y": 0.25, "radius": 30, "color": "#bfe3f2"}
    show(3, new=True, set={"sun": sun})
    show(4)
    show(5, hud="Caught: 3")
    assert tab.inner_text("#scene-hud") == "Caught: 3"
    show(6, set={"sun": {"color": "#f6c445"}})
    world.connections[0].send(pack(7, RED * 4))  # a frame in between, and the scene again
    world.wait_for({"ack": 7})
    show(8)
    show(9, gone=["sun"])
    day, evening, night = "#bfe3f2", "#f6c445", "#000000"
    assert shown == [(1, day), (1, day), (1, day), (2, evening), (3, evening), (4, night)]


def test_the_game_waits_for_its_images(game: Any, world: World, tab: Any) -> None:
    """The test holds back the last bytes of an image that the page has asked for; then it sends them."""
    held: list[Any] = []

    def hold(route: Any) -> None:
        server = route.connect_to_server()

        def pass_on(data: Any) -> None:
            part = isinstance(data, bytes) and data[0] == 6
            if part and (held or int.from_bytes(data[3:7]) > 2_000_000):
                held.append(lambda: route.send(data))
            else:
                route.send(data)

        server.on_message(pass_on)

    tab.route_web_socket("ws://127.0.0.1:*/", hold)
    game(noise=900)
    tab.wait_for_selector("#overlay progress:visible")
    until = time.monotonic() + PATIENCE / 1000
    while not held:
        assert time.monotonic() < until
        tab.wait_for_timeout(20)
    assert tab.inner_text("#overlay-title") == "Loading the pictures…"
    assert tab.is_hidden("#overlay-button")
    assert 0.5 < tab.evaluate("document.querySelector('#overlay progress').value") < 1
    shot(tab, "scene-loading")
    tab.keyboard.press("ArrowRight")
    tab.keyboard.press("Space")
    tab.wait_for_timeout(200)
    assert tab.get_attribute("#play", "data-state") == "ready"
    for send in held:
        send()
    tab.wait_for_selector("#overlay-button:visible")
    assert tab.inner_text("#overlay-title") == "Ready?"
    tab.keyboard.press("ArrowRight")
    tab.wait_for_selector("#play[data-state=playing]", state="attached")


def test_images_are_not_loaded_again_when_the_connection_comes_back(game: Any, world: World, tab: Any) -> None:
    said: list[str] = []
    tab.on("websocket", lambda socket: socket.on("framesent", lambda text: said.append(str(text))))
    server = game()
    tab.wait_for_selector("#overlay-button:visible")
    assert [each for each in said if "asset" in each] == ['{"asset":"cook"}']
    server.process.kill()
    server.wait()
    tab.wait_for_selector("text=Connection lost")
    again = Running(server.log.parent, AGENT, {"actionSpace": ["noop", "right"], "scene": SCENE, "maxEpisodes": 1}, {})
    try:
        world.state = {**world.state, "url": again.address}
        tab.wait_for_selector("#overlay-button:visible")
        assert sum("token" in each for each in said) >= 2
        assert [each for each in said if "asset" in each] == ['{"asset":"cook"}']
    finally:
        again.process.kill()
        again.wait()


def png_of_size(number: int) -> bytes:
    """Return a PNG of a few bytes that says it has so many pixels on each side."""
    head = b"IHDR" + struct.pack("!IIBBBBB", number, number, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack("!I", 13) + head + struct.pack("!I", zlib.crc32(head))


SIZE_OF = """async (bytes) => {
    const { width, height } = sizeOf(new DataView(new Uint8Array(bytes).buffer));
    return [width, height];
}"""


@pytest.mark.parametrize(("form", "options"), [("PNG", {}), ("JPEG", {}), ("WEBP", {}), ("WEBP", {"lossless": True})])
def test_the_page_reads_the_size_of_an_image_without_decoding_it(tab: Any, form: str, options: dict[str, Any]) -> None:
    out = io.BytesIO()
    Image.new("RGB", (300, 77), "red").save(out, form, **options)
    sizes = (ROOT / "hippodrome/web/game/sprites.js").read_text()
    function = re.search(r"^function sizeOf\(view\).*?^}", sizes, re.DOTALL | re.MULTILINE)
    jpeg = re.search(
        r"^export (function jpegSize.*?^})",
        (ROOT / "hippodrome/web/game/frames.js").read_text(),
        re.DOTALL | re.MULTILINE,
    )
    assert function is not None
    assert jpeg is not None
    tab.goto("about:blank")
    script = f"(bytes) => {{ {jpeg[1]} {function[0]} return ({SIZE_OF})(bytes); }}"
    assert tab.evaluate(script, list(out.getvalue())) == [300, 77]


def test_a_hostile_server_cannot_fill_the_memory_with_images_or_scenes(world: World, tab: Any) -> None:
    """It announces an image of a terabyte, sends one of 60,000 x 60,000 pixels, and a scene that unpacks to 256 MB."""
    world.trial = {"scene": SCENE}
    lost: list[int] = []
    about = json.dumps({"type": "image/png"}).encode()
    image = struct.pack("!I", len(about)) + about + png_of_size(60_000)

    def play(connection: Any) -> None:
        for text in connection:
            message = json.loads(text)
            if "token" in message:
                assets = [{"name": "a", "bytes": 2**40, "hash": "a"}, {"name": "b", "bytes": len(image), "hash": "b"}]
                said = {"UI": ["start"], "actionSpace": ["noop"], "state": "ready", "episode": 1, "maxEpisodes": 1}
                connection.send(
                    json.dumps({**said, "score": 0, "scene": SCENE | {"coordinates": "relative"}, "assets": assets})
                )
                connection.send(b"\x04" + struct.pack("!I", 1) + json.dumps({"new": True, "set": {}}).encode())
            elif message.get("asset"):
                lost.append(1)
                connection.send(b"\x06" + struct.pack("!HI", 1, 0) + image)
            elif message.get("command") == "start":
                connection.send(b"\x05" + struct.pack("!I", 2) + deflated_zeros(2**28))

    world.play = play  # type: ignore[method-assign]
    world.step = 2
    world.ready()
    tab.goto(world.url)
    tab.wait_for_selector("#overlay-button:visible")  # once the page has given up both images
    assert lost == [1]
    tab.click("#overlay-button")
    tab.wait_for_selector("text=Connection lost")
