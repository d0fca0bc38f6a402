"""A game that is drawn by objects, on a real trial server."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

AGENT = """
class Agent:
    def start(self, game):
        self.t = 0
    def reset(self, seed=None):
        self.t = 0
    def step(self, action):
        self.t += 1
        return None, 1.0, self.t >= {length}, False, {{}}
    def render(self):
        objects = [
            {{"uuid": "dot", "object_type": "circle", "x": self.t / 1000, "y": 0.5, "radius": 5, "color": "#ff0000"}},
            {{"id": "cook", "type": "sprite", "image": "cook", "x": 0, "y": 0, "width": 20, "height": 20}},
        ]
        if self.t == 0:
            objects.append({{"id": "wall", "type": "rectangle", "x": 0.5, "y": 0, "width": 9, "height": 9,
                            "permanent": True}})
        {more}
        return {{"objects": objects, "hud": f"Step {{self.t // 1000}}"}}
    def close(self):
        pass
"""
SCENE = {"width": 100, "height": 50, "background": "#0000ff"}


def agent(length: int = 10**6, more: str = "pass") -> str:
    return AGENT.format(length=length, more=more)


def with_images(folder: Path, **images: int) -> None:
    """Write images of random pixels, with sides of these lengths."""
    (folder / "agent" / "assets").mkdir(parents=True)
    for name, side in images.items():
        pixels = np.random.default_rng(1).integers(0, 256, (side, side, 3), np.uint8)
        Image.fromarray(pixels).save(folder / "agent" / "assets" / f"{name}.png")


def started(launch: Any, tmp_path: Path, source: str, **trial: Any) -> Any:
    with_images(tmp_path, cook=8, large=200)
    return launch(agent=source, trial={"actionSpace": ["noop"], "scene": SCENE, **trial}, SERVER="a-1")


async def test_a_client_is_told_of_the_picture_and_gets_scenes(launch: Any, open_client: Any, tmp_path: Path) -> None:
    server = started(launch, tmp_path, agent())
    async with open_client(server.address) as client:
        await client.play(frames=5)
        assert client.controls["scene"] == {
            **{"width": 100, "height": 50, "background": "#0000ff", "coordinates": "relative", "pixelArt": False}
        }
        assert set(client.kinds) == {4}
        assert list(client.scene.objects) == ["wall", "dot", "cook"]
        assert client.scene.objects["dot"]["x"] >= 0.003
        assert client.scene.hud == "Step 0"
    assert "render()" not in server.log_text()


async def test_a_client_that_comes_back_gets_the_whole_scene(launch: Any, open_client: Any, tmp_path: Path) -> None:
    server = started(launch, tmp_path, agent())
    async with open_client(server.address) as client:
        await client.play(frames=3)
    async with open_client(server.address) as client:
        await client.enter()
        assert set(client.scene.objects) == {"wall", "dot", "cook"}


async def test_images_are_sent_to_clients_that_ask_for_them(launch: Any, open_client: Any, tmp_path: Path) -> None:
    server = started(launch, tmp_path, agent())
    async with open_client(server.address) as client:
        await client.play(frames=2)
        cook, large = client.controls["assets"]
        assert (cook["name"], large["name"]) == ("cook", "large")
        assert large["bytes"] > 100_000
        for each in (large, cook):
            await client.say(asset=each["name"])
        await client.until(lambda: [len(client.assets.get(n, b"")) for n in (0, 1)] == [cook["bytes"], large["bytes"]])
        head = int.from_bytes(client.assets[1][:4])
        assert json.loads(client.assets[1][4 : 4 + head]) == {"type": "image/png"}
        assert Image.open(io.BytesIO(client.assets[1][4 + head :])).size == (200, 200)
        await client.say(asset="../agent.py")
        await client.until(lambda: client.errors)
        assert client.errors == ["this game has no such image"]


async def test_a_client_gets_an_image_three_times_at_most_however_often_it_asks(
    launch: Any, open_client: Any, tmp_path: Path
) -> None:
    server = started(launch, tmp_path, agent())
    async with open_client(server.address) as client:
        await client.play(frames=2)
        got = 0
        for _ in range(10):
            await client.say(asset="cook")
        await client.until(lambda: client.assets)
        seen = len(client.frames)
        while len(client.frames) < seen + 10:
            before = client.assets.pop(0, None)
            got += before is not None
            await client.take()
        assert got <= 3


async def test_clients_that_draw_no_objects_get_pictures_that_the_server_draws(
    launch: Any, open_client: Any, tmp_path: Path
) -> None:
    server = started(launch, tmp_path, agent())
    for decodes in (["deflate", "jpeg"], ["deflate"], ["jpeg"]):
        async with open_client(server.address) as client:
            await client.start(decodes=decodes)
            await client.see(3)
            assert client.frame.shape == (50, 100, 3)
            assert set(client.kinds) <= {0, 1, 2, 3}
            assert client.frame[40, 90, 2] > 250 > 5 > client.frame[40, 90, 0]
    async with open_client(server.address, subprotocols=None) as client:
        await client.hello()
        await client.until(lambda: client.jpegs)
        picture = Image.open(io.BytesIO(base64.b64decode(client.jpegs[-1]["frame"])))
        assert picture.size == (100, 50)


async def test_an_object_that_cannot_be_drawn_is_logged_once_and_the_game_goes_on(
    launch: Any, open_client: Any, tmp_path: Path
) -> None:
    more = 'objects += [{"id": "bad", "type": "circle", "x": float("nan"), "y": 0, "radius": 1}, {"id": "e", "type": "sprite", "image": "../../etc/passwd", "x": 0, "y": 0}]'
    server = started(launch, tmp_path, agent(length=8, more=more), maxEpisodes=1)
    async with open_client(server.address) as client:
        await client.play(frames=3)
        await client.until(lambda: client.done)
    assert server.answer()["answers"]["episodes"] == 1
    said = server.log_text()
    assert said.count("render(): the object 'bad' cannot be drawn: its x is no finite number (nan)") == 1
    assert said.count("render(): the object 'e' shows the image '../../etc/passwd', which is not in assets/") == 1


async def test_objects_without_a_scene_in_config_yml_end_the_game_with_a_sentence(
    launch: Any, open_client: Any, tmp_path: Path
) -> None:
    server = started(launch, tmp_path, agent(), scene=None)
    async with open_client(server.address) as client:
        await client.hello()
        await client.closed()
    assert "say in config.yml how large the picture is, as trial.scene" in server.log_text()


async def test_a_picture_of_pixels_may_come_between_scenes(launch: Any, open_client: Any, tmp_path: Path) -> None:
    more = "import numpy; assert True\n        if self.t % 4 == 2: return numpy.zeros((20, 30, 3), numpy.uint8)"
    server = started(launch, tmp_path, agent(more=more))
    async with open_client(server.address) as client:
        await client.play(frames=12)
        await client.until(lambda: set(client.kinds) >= {4, 0})
        await client.until(lambda: client.kinds[-1] == 4)
        assert set(client.scene.objects) == {"wall", "dot", "cook"}


async def test_permanent_objects_of_the_first_picture_are_shown_after_an_episode_is_resumed(
    launch: Any, open_client: Any, tmp_path: Path
) -> None:
    source = agent().replace("def reset(self, seed=None):", "def reset(self, seed=None):\n        self.seed = seed")
    server = started(launch, tmp_path, source)
    async with open_client(server.address) as client:
        await client.play(frames=5)
    server.terminate()
    server.wait()
    again = launch(agent=source, trial={"actionSpace": ["noop"], "scene": SCENE}, SERVER="a-2")
    async with open_client(again.address) as client:
        await client.play(frames=2)
        assert client.scene.objects["dot"]["x"] >= 0.004
        assert "wall" in client.scene.objects
