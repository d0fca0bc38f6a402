"""Fixtures: a real trial server in a process of its own, and a small client that plays on it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed
from websockets.typing import Subprotocol

from hippodrome.trial.pictures.frames import Decoder, Frame
from hippodrome.trial.pictures.scene_encoder import ASSET, ASSET_HEADER, PACKED_SCENE, SCENE, SceneDecoder
from hippodrome.trial.recordings import recording
from hippodrome.trial.wire.connection import SUBPROTOCOL
from testing import processes
from testing.async_tests import pytest_pyfunc_call  # noqa: F401 - a hook
from tests.trial.client_messages import TakesMessages

ROOT = Path(__file__).parents[2]

GRID_AGENT = '''
"""A tiny environment: a dot on a field, moved by the action; an episode is LENGTH steps."""
import gymnasium
import numpy as np

LENGTH = {length}

class Grid(gymnasium.Env):
    action_space = gymnasium.spaces.Discrete(6)
    observation_space = gymnasium.spaces.Box(0, 255, (2,), np.uint8)
    metadata = {{"render_modes": ["rgb_array"]}}
    render_mode = "rgb_array"

    def get_action_meanings(self):
        return ["NOOP", "UP", "RIGHT", "LEFT", "DOWN", "UPRIGHT"]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        self.last = 0
        self.start = int(self.np_random.integers(1000))
        return np.array([0, 0], np.uint8), {{"start": np.int64(self.start)}}

    def step(self, action):
        self.t += 1
        self.last = action
        done = LENGTH is not None and self.t >= LENGTH
        info = {{"t": np.int64(self.t), "nan": float("nan")}}
        return np.array([self.t % 256, action], np.uint8), np.float32(1.5), done, False, info

    def render(self):
        picture = np.zeros((20, 30, 3), np.uint8)
        picture[self.t % 20, self.t % 30] = 255
        picture[0, 0] = self.last
        return picture

class Agent:
    def start(self, game):
        self.env = Grid()
        return self.env
    def reset(self, seed=None):
        return self.env.reset(seed=seed)
    def step(self, action):
        return self.env.step(action)
    def render(self):
        return self.env.render()
    def feedback(self, word):
        self.env.word = word
    def close(self):
        self.env.close()
'''


DECODES = ["deflate", "jpeg", "objects"]


def grid_agent(length: int | None = None) -> str:
    return GRID_AGENT.format(length=length)


class Running:
    """A trial server that runs in a process of its own."""

    def __init__(self, folder: Path, agent: str | None, trial: dict[str, Any], env: dict[str, str]) -> None:
        self.store = folder / "store"
        self.log = folder / "stderr.txt"
        agent_dir = folder / "agent"
        agent_dir.mkdir(exist_ok=True)
        if agent is not None:
            (agent_dir / "agent.py").write_text(agent)
        settings = {
            "PROJECT_ID": "study",
            "USER_ID": "P1",
            "SERVER": "a1",
            "TOKEN": "the-secret-token",
            "GAME_STEPS": "3",
            "STORE": str(self.store),
            "TRIAL": json.dumps({"game": "grid", "betweenEpisodes": 0, **trial}),
            "HOST": "127.0.0.1",
            "PORT": "0",
            "TLS": "off",
            "LINGER_SECONDS": "0.2",
            "HELLO_SECONDS": "60",  # tests at the same time make the machine slow
            "STALLED_SECONDS": "60",
            "AGENT_DIR": str(agent_dir),
            "PYTHONPATH": str(ROOT),
        }
        inherited = {k: v for k, v in os.environ.items() if k not in settings and k not in ("SPOOL", "DEADLINE")}
        with self.log.open("ab") as log:
            self.process = processes.start(
                "hippodrome.trial", cwd=folder, env={**inherited, **settings, **env}, stdout=subprocess.PIPE, stderr=log
            )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, self.log.read_text()
        self.port: int = json.loads(line)["port"]

    @property
    def address(self) -> str:
        return f"ws://127.0.0.1:{self.port}/"

    def log_text(self) -> str:
        return self.log.read_text()

    def answer(self, step: str = "3") -> dict[str, Any]:
        return json.loads((self.store / f"study/users/P1/answers/{step}.json").read_text())

    def answered(self, step: str = "3") -> bool:
        return (self.store / f"study/users/P1/answers/{step}.json").exists()

    def recordings(self, pattern: str = "*.gz", server: str = "a1") -> dict[str, list[dict[str, Any]]]:
        folder = self.store / "study/users/P1/trials" / server
        return {path.name: recording.read(path.read_bytes()) for path in sorted(folder.glob(pattern))}

    def wait(self, seconds: float = 60) -> int:
        return self.process.wait(seconds)

    def terminate(self) -> None:
        self.process.send_signal(signal.SIGTERM)

    def cpu_seconds(self) -> float:
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Client(TakesMessages):
    """A client that plays as a browser does, and keeps the messages that it gets by kind."""

    def __init__(self, websocket: ClientConnection) -> None:
        self.websocket = websocket
        self.decoder = Decoder()
        self.acks = True
        self.controls: dict[str, Any] = {}
        self.state: dict[str, Any] = {}
        self.states: list[str] = []
        self.errors: list[str] = []
        self.done: dict[str, Any] | str | None = None
        self.frames: list[tuple[float, int]] = []
        self.kinds: list[int] = []
        self.frame: Frame | None = None
        self.scene = SceneDecoder()
        self.assets: dict[int, bytes] = {}
        self.jpegs: list[dict[str, Any]] = []
        self.lines: dict[int, dict[str, Any]] = {}
        self.turn: str | None = None
        self.typing: dict[str, bool] = {}
        self.refused: list[dict[str, Any]] = []

    async def say(self, **message: Any) -> None:
        await self.websocket.send(json.dumps(message))

    async def hello(self, **change: Any) -> None:
        hello: dict[str, Any] = {"userId": "P1", "token": "the-secret-token", "step": "3"}
        if self.websocket.subprotocol is not None:
            hello["decodes"] = DECODES
        hello |= change
        await self.say(**{key: value for key, value in hello.items() if value is not None})

    async def take(self) -> None:
        data = await self.websocket.recv()
        if isinstance(data, bytes) and data[0] == ASSET:
            _, number, offset = ASSET_HEADER.unpack_from(data)
            had = self.assets.setdefault(number, b"")
            assert len(had) == offset
            self.assets[number] = had + data[ASSET_HEADER.size :]
            return
        if isinstance(data, bytes):
            if data[0] in (SCENE, PACKED_SCENE):
                frame_id = self.scene.decode(data)
            else:
                frame_id, self.frame = self.decoder.decode(data)
            self.frames.append((time.monotonic(), frame_id))
            self.kinds.append(data[0])
            if self.acks:
                with contextlib.suppress(ConnectionClosed):  # messages that came before the end are still read
                    await self.say(ack=frame_id)
            return
        if data == "done":
            self.done = "done"
            return
        message = json.loads(data)
        if "error" in message and "done" not in message:
            self.errors.append(message["error"])
        elif "UI" in message:
            self.controls = message
            self.state = message
        elif "done" in message:
            self.done = message
        elif "frame" in message:
            self.jpegs.append(message)
        elif "lines" in message:
            self.lines |= {line["n"]: line for line in message["lines"]}
            self.turn = message.get("turn", self.turn)
        elif "typing" in message:
            self.typing |= message["typing"]
        elif "refused" in message:
            self.refused.append(message["refused"])
        else:
            self.state = message
            self.states.append(message["state"])

    async def read(self, count: int) -> list[tuple[str, str]]:
        """Take messages until `count` lines are said and complete; return who said what."""
        await self.until(lambda: len(self.lines) >= count and not any(line.get("more") for line in self.lines.values()))
        return [(self.lines[n]["by"], self.lines[n]["text"]) for n in sorted(self.lines)]

    async def wait_until_heard(self) -> None:
        """Return when the server has read all messages so far. The picture after the next one shows a later step."""
        self.controls = {}
        await self.say(command="requestUI")
        await self.until(lambda: self.controls)

    async def see(self, more: int) -> None:
        """Take messages until `more` further pictures have come."""
        seen = len(self.frames)
        await self.until(lambda: len(self.frames) >= seen + more)

    async def enter(self, **change: Any) -> None:
        """Say hello, and take messages until the first picture has come."""
        await self.hello(**change)
        await self.until(lambda: self.frames)

    async def start(self, **change: Any) -> None:
        """Say hello, and start as soon as the controls have come."""
        await self.hello(**change)
        await self.until(lambda: self.controls)
        await self.say(command="start")

    async def play(self, frames: int = 5) -> None:
        """Say hello, start, and see some pictures."""
        await self.start()
        await self.see(frames)

    async def stop(self) -> None:
        """Stop the game; the server has to close the connection with the code of a normal end."""
        await self.say(command="stop")
        assert await self.closed() == 1000


@contextlib.asynccontextmanager
async def client_of(address: str, *, subprotocols: tuple[str, ...] | None = (SUBPROTOCOL,), **options: Any) -> Any:
    async with connect(
        address,
        subprotocols=subprotocols and [Subprotocol(name) for name in subprotocols],
        compression=None,
        max_size=None,
        proxy=None,
        **options,
    ) as ws:
        yield Client(ws)


@pytest.fixture
def open_client() -> Any:
    """`async with open_client(address) as client`."""
    return client_of


@pytest.fixture
def launch(tmp_path: Path) -> Any:
    """Start a trial server: `launch(agent=…, trial={…}, NAME="value")`."""
    started: list[Running] = []

    def start(agent: str | None = grid_agent(), trial: dict[str, Any] | None = None, **env: str) -> Running:
        running = Running(tmp_path, agent, trial or {}, env)
        started.append(running)
        return running

    yield start
    for running in started:
        running.process.kill()
        running.process.wait()
        if running.log.exists():
            print(running.log_text())  # pytest shows it if the test failed


@pytest.fixture
def grid() -> Any:
    """The source of an agent.py whose episodes have a given length."""
    return grid_agent
