"""What a trial server delivers and costs: `python -m bench.trial`.

Every figure is measured here and now, on a real server process and the example project's game; the yardstick of the
encoding is HIPPO's (PIL JPEG, base64, JSON) on the very same frames in the same run.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from bench.table import Row, row
from trial.encoder import Encoder
from trial.frames import HEADER, Decoder, Frame, as_frame, jpeg_message

ROOT = Path(__file__).parents[1]
GAME = "ALE/MsPacman-v5"
SECONDS = 8.0
FRAMES = 600
PRESSES = 80
IDLE_SECONDS = 5.0

# A screen that shows, in its corner, the action of the step it was drawn after.
ECHO = """
import numpy as np
class Agent:
    def start(self, game):
        self.screen = np.zeros((210, 160, 3), np.uint8)
    def reset(self):
        pass
    def step(self, action):
        self.screen[:8, :8] = action
        return None, 0.0, False, False, {}
    def render(self):
        return self.screen
    def close(self):
        pass
"""


@contextlib.contextmanager
def server(agent_dir: Path, **trial: Any) -> Iterator[tuple[str, int]]:
    """A running server: its address and process id."""
    with tempfile.TemporaryDirectory() as store:
        env = {
            **os.environ,
            "PROJECT_ID": "bench",
            "USER_ID": "bench",
            "SERVER": "bench",
            "TOKEN": "bench",
            "GAME_STEPS": "1",
            "STORE": store,
            "TRIAL": json.dumps({"game": GAME, "maxEpisodes": 1000, "betweenEpisodes": 0, **trial}),
            "HOST": "127.0.0.1",
            "PORT": "0",
            "TLS": "off",
            "AGENT_DIR": str(agent_dir),
            "PYTHONPATH": str(ROOT),
        }
        process = subprocess.Popen(
            [sys.executable, "-m", "trial"], cwd=store, env=env, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        try:
            assert process.stdout is not None
            port = json.loads(process.stdout.readline())["port"]
            yield f"ws://127.0.0.1:{port}/", process.pid
        finally:
            process.terminate()
            process.wait(30)


def cpu_seconds(pid: int) -> float:
    """Processor time a process has used, user and system."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextlib.asynccontextmanager
async def playing(address: str) -> Any:
    """A connection on which the game runs; the frames up to here are passed over."""
    async with connect(
        address, subprotocols=[Subprotocol("hippodrome.1")], compression=None, max_size=None, proxy=None
    ) as ws:
        await ws.send(json.dumps({"userId": "bench", "token": "bench"}))
        decoder = Decoder()
        while True:
            data = await ws.recv()
            if isinstance(data, bytes):
                break
        decoder.decode(data)
        await ws.send('{"command": "start"}')
        yield ws, decoder


async def deliver(address: str, pid: int, rate: int) -> tuple[float, float, float]:
    """Share of the due frames that arrived, server's processor ms per frame, 99th percentile of the gap in ms."""
    async with playing(address) as (ws, _):
        arrived: list[float] = []
        begun = end = cpu = 0.0
        settled = time.perf_counter() + 1.0
        while True:
            data = await ws.recv()
            now = time.perf_counter()
            if isinstance(data, str):
                continue
            # The client is light on purpose: two small machines' worth of work share two cores here.
            await ws.send(f'{{"ack": {HEADER.unpack_from(data)[1]}}}')
            if now < settled:
                continue
            if not begun:
                begun, end, cpu = now, now + SECONDS + 0.5 / rate, cpu_seconds(pid)
                continue
            if now >= end:
                break
            arrived.append(now)
        spent = cpu_seconds(pid) - cpu
    gaps = np.diff([begun, *arrived])
    return len(arrived) / (rate * SECONDS), 1000 * spent / len(arrived), 1000 * float(np.percentile(gaps, 99))


async def press(address: str) -> list[float]:
    """Seconds from a key going down or up to the arrival of the frame that shows it."""
    waits: list[float] = []
    async with playing(address) as (ws, decoder):
        await see(ws, decoder, 0)
        for number in range(PRESSES):
            await idle(ws, decoder, random.uniform(0.02, 0.12))  # so that keys come at any moment between two frames
            down = number % 2 == 0
            begun = time.perf_counter()
            await ws.send(json.dumps({"action": "left", "held": down}))
            waits.append(await see(ws, decoder, 3 if down else 0) - begun)
    return waits


async def see(ws: ClientConnection, decoder: Decoder, action: int) -> float:
    while True:
        data = await ws.recv()
        now = time.perf_counter()
        if isinstance(data, bytes):
            frame_id, frame = decoder.decode(data)
            await ws.send(f'{{"ack": {frame_id}}}')
            if frame[0, 0, 0] == action:
                return now


async def idle(ws: ClientConnection, decoder: Decoder, seconds: float) -> None:
    end = time.perf_counter() + seconds
    while (left := end - time.perf_counter()) > 0:
        with contextlib.suppress(TimeoutError):
            data = await asyncio.wait_for(ws.recv(), left)
            if isinstance(data, bytes):
                await ws.send(f'{{"ack": {decoder.decode(data)[0]}}}')


def game_frames() -> list[Frame]:
    """Ms. Pac-Man as the example agent shows it, somebody pressing keys."""
    spec = importlib.util.spec_from_file_location("example_agent", ROOT / "agent.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    agent = module.Agent()
    agent.start(GAME)
    agent.reset(seed=7)
    keys = random.Random(7)
    action, frames = 0, []
    for number in range(FRAMES):
        if number % 12 == 0:
            action = keys.choice([1, 2, 3, 4])
        _, _, terminated, truncated, _ = agent.step(action)
        frames.append(as_frame(agent.render()))
        if terminated or truncated:
            agent.reset(seed=7)
    agent.close()
    return frames


def encoding(frames: list[Frame]) -> tuple[float, float, float, float, bool]:
    """Ours and HIPPO's processor ms and bytes per frame, and whether ours arrived unchanged."""
    encoder, decoder = Encoder(), Decoder()
    jpeg_message(frames[0], 0)  # imports happen outside the measurement
    begun = time.process_time()
    ours = [encoder.encode(frame, number) for number, frame in enumerate(frames)]
    middle = time.process_time()
    theirs = [jpeg_message(frame, number) for number, frame in enumerate(frames)]
    end = time.process_time()
    same = all(np.array_equal(decoder.decode(data)[1], frame) for data, frame in zip(ours, frames, strict=True))
    count = len(frames)
    return (
        1000 * (middle - begun) / count,
        1000 * (end - middle) / count,
        sum(map(len, ours)) / count,
        sum(map(len, theirs)) / count,
        same,
    )


def rows() -> Iterator[Row]:
    """Measure everything, one row after another; about 45 s."""
    for rate in (30, 60):
        with server(ROOT, startingFrameRate=rate) as (address, pid):
            share, cpu, gap = asyncio.run(deliver(address, pid, rate))
        yield row(f"frames delivered at {rate}/s", share, "share", at_least=0.99)
        yield row(f"gap between frames at {rate}/s, 99th percentile", gap, "ms")
        yield row(f"server CPU per frame at {rate}/s, game and recording included", cpu, "ms")
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "agent.py").write_text(ECHO)
        space = ["noop", "up", "right", "left", "down"]
        with server(Path(folder), startingFrameRate=30, actionSpace=space) as (address, _):
            waits = asyncio.run(press(address))
    frame = 1000 / 30
    yield row("key to effect at 30/s, p50", 1000 * statistics.median(waits), "ms", at_most=frame + 5)
    yield row("key to effect, p95", 1000 * statistics.quantiles(waits, n=20)[-1], "ms")
    ours, theirs, small, large, same = encoding(game_frames())
    yield row("encoding: CPU per frame, against JPEG in JSON", ours, "ms", yardstick=theirs, at_most=1 / 5)
    yield row("encoding: bytes per frame, against JPEG in JSON", small, "bytes", yardstick=large, at_most=1 / 10)
    yield row("encoding: frames arrive unchanged", float(same), "share", at_least=1)
    with server(ROOT) as (address, pid):
        time.sleep(3.0)
        before = cpu_seconds(pid)
        time.sleep(IDLE_SECONDS)
        share = (cpu_seconds(pid) - before) / IDLE_SECONDS
    yield row("CPU with nobody connected", 100 * share, "% of a core", at_most=1)


if __name__ == "__main__":
    for found in rows():
        print(json.dumps(found), flush=True)
