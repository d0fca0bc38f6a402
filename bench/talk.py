"""Measures talk on a trial server of this machine: two participants of a session, and an agent that speaks."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from bench.row import Row, row
from bench.study import PATIENCE, folder
from hippodrome.protocol.session import Member, SessionDocument, member_token

SESSION, TOKEN, MEMBERS = "s.0123456789abcdef0123", "a-token", ("anna", "bert")
AGENT = """
import numpy as np

class Agent:
    possible_agents = ["left", "right"]

    def start(self, game):
        self.last = 0

    def each(self, value):
        return dict.fromkeys(self.possible_agents, value)

    def reset(self, seed=None):
        return self.each(0), self.each({})

    def step(self, actions):
        return self.each(0), self.each(0.0), self.each(False), self.each(False), self.each({})

    def render(self):
        return np.random.default_rng().integers(0, 255, (120, 160, 3), np.uint8)

    def close(self):
        pass

    def on_tick(self, session):
        if session.options.get("lines") and session.ticks % 3 == 0:
            session.say("A line of some words that is neither short nor long.")
            session.say("And another one.")
"""
LINES, RATE, SECONDS = 40, 30, 10.0


def lines() -> Iterator[Row]:
    """Measure the way of a line from person to person, frames beside 20 lines a second, and the server's memory."""
    plain = asyncio.run(_play(chat=False, noisy=False))
    quiet = asyncio.run(_play(chat=True, noisy=False))
    noisy = asyncio.run(_play(chat=True, noisy=True))
    yield row(
        "a line from person to person on one machine, p50",
        1000 * statistics.median(quiet["waits"]),
        "ms",
        at_most=50,
        decides="whether people talk as in a messenger",
        detail={"p95": 1000 * statistics.quantiles(quiet["waits"], n=20)[-1], "lines": len(quiet["waits"])},
    )
    yield row(
        f"frames at {RATE}/s beside 20 lines a second",
        noisy["frames"],
        "frames/s",
        yardstick=plain["frames"],
        at_least=0.98,
        better="more",
        decides="whether talk makes the game slower",
        detail={"without talk": plain["frames"], "lines read": noisy["lines"]},
    )
    yield row(
        "what talk adds to a server's memory, after some hundred lines",
        (noisy["memory"] - plain["memory"]) / 1024**2,
        "MiB",
        at_most=5,
        decides="how small a Fargate task may be",
        detail={"without talk": plain["memory"] / 1024**2},
    )


async def _play(*, chat: bool, noisy: bool) -> dict[str, Any]:
    with folder() as place:
        trial = {
            "game": "bench", "players": {"left": "human", "right": "human"}, "countdown": 0, "startingFrameRate": RATE,
            "lossless": True, "actionSpace": ["noop"], "options": {"lines": noisy}, **({"chat": True} if chat else {}),
        }  # fmt: skip
        async with _serving(place, trial) as (port, pid), _member(port, "anna") as anna, _member(port, "bert") as bert:
            reads = [asyncio.create_task(each.read()) for each in (anna, bert)]
            await asyncio.sleep(3)  # until the game runs evenly
            waits = await _talk(anna, bert) if chat and not noisy else []
            before = anna.frames
            await asyncio.sleep(SECONDS)
            frames = (anna.frames - before) / SECONDS
            memory = _memory(pid)
            for task in reads:
                task.cancel()
        return {"waits": waits, "frames": frames, "memory": memory, "lines": len(anna.lines)}


async def _talk(anna: _Client, bert: _Client) -> list[float]:
    waits = []
    for number in range(1, LINES + 1):
        said = time.perf_counter()
        bert.heard.clear()
        await anna.send(say={"id": number, "text": f"Line {number}"})
        await asyncio.wait_for(bert.heard.wait(), PATIENCE)
        waits.append(time.perf_counter() - said)
        await asyncio.sleep(1.02)  # the server takes five lines in five seconds
    return waits


class _Client:
    """A member's client, which counts frames and keeps lines."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.frames = 0
        self.lines: dict[int, Any] = {}
        self.heard = asyncio.Event()

    async def send(self, **message: Any) -> None:
        await self._socket.send(json.dumps(message))

    async def read(self) -> None:
        async for data in self._socket:
            if isinstance(data, bytes):
                self.frames += 1
                await self.send(ack=int.from_bytes(data[1:5], "big"))
                continue
            found = json.loads(data).get("lines")
            if found:
                self.lines |= {line["n"]: line for line in found}
                self.heard.set()


@contextlib.asynccontextmanager
async def _member(port: int, user: str) -> AsyncIterator[_Client]:
    protocols = [Subprotocol("hippodrome")]
    async with connect(f"ws://127.0.0.1:{port}/", subprotocols=protocols, max_size=None, proxy=None) as socket:
        client = _Client(socket)
        await client.send(userId=user, token=member_token(TOKEN, user), step="2", decodes=["deflate"])
        yield client


@contextlib.asynccontextmanager
async def _serving(place: Path, trial: dict[str, Any]) -> AsyncIterator[tuple[int, int]]:
    """Run a trial server whose session is formed; give its port and the id of its process."""
    (place / "agent.py").write_text(AGENT, encoding="utf-8")
    document = place / f"store/study/sessions/{SESSION}/session.json"
    document.parent.mkdir(parents=True)
    members = tuple(Member(user, None, seat) for seat, user in enumerate(MEMBERS))
    document.write_bytes(SessionDocument(SESSION, 2, members, None, "2026-11-22T22:00:00.000000Z").to_json())
    settings = {
        "PROJECT_ID": "study", "USER_ID": "", "SESSION": SESSION, "SERVER": "bench-1", "TOKEN": TOKEN,
        "GAME_STEPS": "2", "STORE": str(place / "store"), "TRIAL": json.dumps(trial), "HOST": "127.0.0.1",
        "PORT": "0", "TLS": "off", "AGENT_DIR": str(place),
    }  # fmt: skip
    command = [sys.executable, "-m", "hippodrome.trial"]
    with subprocess.Popen(
        command, cwd=place, env={**os.environ, **settings}, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        try:
            assert process.stdout is not None
            yield int(json.loads(await asyncio.to_thread(process.stdout.readline))["port"]), process.pid
        finally:
            process.terminate()


def _memory(pid: int) -> int:
    """Return the bytes of a process's memory that it shares with no other."""
    fields = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:])
    return 1024 * sum(int(fields[name].split()[0]) for name in ("Private_Clean", "Private_Dirty"))
