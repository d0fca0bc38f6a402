"""Measures what a trial costs its machine: processor time, trials on one core, memory, and slow policies.

`python -m bench.load`. Clients are sockets instead of browsers: they acknowledge frames as our page does, and press
keys. So only the servers are measured. The yardstick of processor time is the game alone: a bare loop that calls the
example's agent as often.
"""

from __future__ import annotations

import asyncio
import contextlib
import copy
import json
import math
import os
import random
import statistics
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed
from websockets.typing import Subprotocol

from bench import seen
from bench.interpreter import interpreter
from bench.pictures import GAME, ROOT
from bench.table import Row, each, row
from trial.recordings import recording

RATE = 30  # frames a second
SETTLE = 2.0  # seconds of play before the measurement
SECONDS = 8.0  # the seconds of play that are measured
LEAST_SHARE = 0.95  # the least share of frames of a yardstick: two servers that fail alike are not well
MAX_CPU = 1.2  # the goal for a frame of the example: ms of processor time
TRIALS = 32  # trials that one core has to serve
MAX_MEMORY = 45.0  # the goal for the memory of each trial: MB
ACTIONS = ("noop", "up", "right", "left", "down")
TOGETHER = 0.05  # pictures that are drawn within so many seconds are acknowledged together
_ID = struct.Struct("!BI")  # the beginning of a binary message: kind and number

ALONE = """
import random, sys, time
from bench.pictures import example_agent
agent = example_agent()
agent.start({game!r})
agent.reset(seed=7)
due = time.monotonic()
print("plays", flush=True)
while True:
    due = max(due + 1 / {rate}, time.monotonic() - 1)
    time.sleep(max(0, due - time.monotonic()))
    _, _, terminated, truncated, _ = agent.step(random.randrange(5))
    agent.render()
    if terminated or truncated:
        agent.reset(seed=7)
"""

# A game that takes hardly any time, and a partner whose answers all come three ticks late.
SLOW = """
import time
import numpy as np
class Agent:
    possible_agents = ["player", "partner"]
    def start(self, game):
        pass
    def reset(self, seed=None):
        self.t = 0
        return {each: np.zeros(2, np.float32) for each in self.possible_agents}, {}
    def step(self, actions):
        self.t += 1
        seen = {each: np.full(2, self.t, np.float32) for each in self.possible_agents}
        return seen, dict.fromkeys(self.possible_agents, 0.0), {"__all__": False}, {"__all__": False}, {}
    def render(self):
        return np.full((90, 160, 3), self.t % 256, np.uint8)
    def close(self):
        pass
class Partner:
    def reset(self, seed):
        pass
    def act(self, observation, info):
        time.sleep(0.1)
        return 1
"""


@dataclass
class ServerLoad:
    """The figures of one server: what it delivered and cost.

    `share` is the share of the due frames that it delivered. `cpu` is in ms per frame, memory in MB.
    """

    share: float
    cpu: float
    memory: float
    """The process's own pages, and its part of shared pages (Pss)."""
    resident: float


def frame_id(data: bytes) -> int:
    """Return the number of the picture in a binary message."""
    return int(_ID.unpack_from(data)[1])


@dataclass
class Count:
    """The numbers of pictures and bytes that one client has received."""

    pictures: int = 0
    bytes: int = 0


class Acknowledging:
    """Acknowledges pictures as our page does (docs/wire.md, "Acknowledgements")."""

    def __init__(self, send: Callable[[str], Coroutine[Any, Any, None]]) -> None:
        self._send = send
        self._loop = asyncio.get_running_loop()
        self._drawn = -math.inf
        self._later: asyncio.TimerHandle | None = None  # set while an acknowledgement waits
        self._sending: asyncio.Task[None] | None = None

    async def drawn(self, picture: int) -> None:
        """Acknowledge this picture, which was just drawn, now or together with the next one."""
        now = self._loop.time()
        quick, self._drawn = now - self._drawn < TOGETHER, now
        if quick and self._later is None:
            self._later = self._loop.call_later(TOGETHER, self._no_other_came, picture)
            return
        if self._later is not None:
            self._later.cancel()
            self._later = None
        await self._acknowledge(picture)

    def _no_other_came(self, picture: int) -> None:
        self._later = None
        self._sending = self._loop.create_task(self._acknowledge(picture))

    async def _acknowledge(self, picture: int) -> None:
        with contextlib.suppress(ConnectionClosed):
            await self._send(json.dumps({"ack": picture}))


@dataclass
class Delivered:
    """The deliveries of one server to each of its clients during the measurement. `cpu` is in seconds."""

    due: float  # pictures for each client
    clients: list[Count]
    cpu: float


async def play(url: str, count: Count) -> None:
    """Play until the task is cancelled."""
    keys = random.Random(7)
    async with connect(
        url, subprotocols=[Subprotocol("hippodrome.2")], max_size=None, compression=None, open_timeout=60
    ) as client:
        acknowledging = Acknowledging(client.send)
        await client.send(json.dumps({"userId": "bench", "token": "bench"}))
        async for data in client:
            count.bytes += len(data)
            if isinstance(data, str):
                continue
            count.pictures += 1
            await acknowledging.drawn(frame_id(data))
            if count.pictures == 1:
                await client.send(json.dumps({"command": "start"}))
            elif count.pictures % 20 == 0:
                await client.send(json.dumps({"action": keys.choice(ACTIONS[1:]), "held": keys.random() < 0.5}))


async def delivered(
    servers: Sequence[tuple[str, int]], plays: Sequence[Callable[[str, Count], Coroutine[Any, Any, None]]]
) -> list[Delivered]:
    """Play on all of these servers at once, on each with these clients. Return what each delivered and cost.

    Raises RuntimeError if a server ends its connection, TimeoutError if the clients get no pictures within 120 seconds.
    """
    counts = [[Count() for _ in plays] for _ in servers]
    clients = [
        asyncio.create_task(play(url, count))
        for (url, _), received in zip(servers, counts, strict=True)
        for play, count in zip(plays, received, strict=True)
    ]
    try:
        async with asyncio.timeout(120):
            while not all(count.pictures > RATE for received in counts for count in received):
                await asyncio.sleep(0.1)
                for client in clients:
                    if client.done():
                        client.result()
                        raise RuntimeError("a server has ended its connection")
        await asyncio.sleep(SETTLE)
        loop = asyncio.get_running_loop()
        begun, before = loop.time(), copy.deepcopy(counts)
        cpu = [seen.cpu_seconds(pid) for _, pid in servers]
        await asyncio.sleep(SECONDS)
        due = RATE * (loop.time() - begun)
        return [
            Delivered(due, [*map(_since, received, earlier)], seen.cpu_seconds(pid) - used)
            for (_, pid), received, earlier, used in zip(servers, counts, before, cpu, strict=True)
        ]
    finally:
        for client in clients:
            client.cancel()
        await asyncio.gather(*clients, return_exceptions=True)


def _since(now: Count, before: Count) -> Count:
    return Count(now.pictures - before.pictures, now.bytes - before.bytes)


async def played(servers: Sequence[tuple[str, int]]) -> list[ServerLoad]:
    """Play on all of these servers at once, and return what each delivered and cost."""
    found = await delivered(servers, [play])
    return [_played(pid, one) for (_, pid), one in zip(servers, found, strict=True)]


def _played(pid: int, found: Delivered) -> ServerLoad:
    (client,) = found.clients
    return ServerLoad(client.pictures / found.due, 1000 * found.cpu / max(client.pictures, 1), *memory(pid))


def memory(pid: int) -> tuple[float, float]:
    """Return the memory of a process in MB: own pages with its part of shared ones (Pss), and resident pages (Rss)."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()
    sizes = {line.split()[0]: int(line.split()[1]) / 1024 for line in lines if line.startswith(("Rss:", "Pss:"))}
    return sizes["Pss:"], sizes["Rss:"]


@contextlib.contextmanager
def example(count: int = 1) -> Iterator[list[tuple[str, int]]]:
    """Run `count` servers of the example's game for the block, and give their addresses and pids. They share a core."""
    cores = os.sched_getaffinity(0)
    core = cores if count == 1 else {max(cores)}
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as running:
        Path(folder, "agent.py").write_bytes((ROOT / "agent.py").read_bytes())
        # A process inherits the cores of the thread that starts it.
        with ThreadPoolExecutor(4, initializer=os.sched_setaffinity, initargs=(0, core)) as starting:

            def start(_: int) -> tuple[str, int]:
                return running.enter_context(
                    seen.server(Path(folder), startingFrameRate=RATE, actionSpace=list(ACTIONS))
                )

            servers = list(starting.map(start, range(count)))
        yield servers


def game_alone() -> float:
    """Measure the processor time of the example's agent without a server, in ms per frame, at the same rate."""
    process = subprocess.Popen(
        [sys.executable, "-c", ALONE.format(game=GAME, rate=RATE)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    try:
        assert process.stdout is not None
        process.stdout.readline()

        async def watch() -> float:
            await asyncio.sleep(SETTLE)
            before = seen.cpu_seconds(process.pid)
            await asyncio.sleep(SECONDS)
            return seen.cpu_seconds(process.pid) - before

        return 1000 * asyncio.run(watch()) / (RATE * SECONDS)
    finally:
        process.terminate()
        process.wait(30)


def one_trial() -> Iterator[Row]:
    """Measure one trial of the example."""
    alone = game_alone()
    with example() as servers:
        (found,) = asyncio.run(played(servers))
    yield judged_cpu(found, alone)


def judged_cpu(found: ServerLoad, alone: float) -> Row:
    """Return the row of processor time. `alone` is what `game_alone` returns."""
    return row(
        f"server's CPU per frame of the example at {RATE}/s, against its game alone",
        found.cpu,
        "ms",
        yardstick=alone,
        at_most=MAX_CPU,
        judge="value",
        bound="ours, for a processor and a Python as fast as the image's; the detail has their speed here",
        detail={"share of the frames delivered": found.share, "MB resident": found.resident, **interpreter()},
    )


def one_core() -> Iterator[Row]:
    """Measure many trials on one core, and the memory of each."""
    with example(TRIALS) as servers:
        found = asyncio.run(played(servers))
    yield from judged_core(found)


def judged_core(found: list[ServerLoad]) -> Iterator[Row]:
    """Yield the rows of trials that share a core."""
    yield row(
        f"frames at {RATE}/s that reach the client of each of {len(found)} trials of the example on one core, at least",
        min(one.share for one in found),
        "of those due",
        at_least=0.99,
        bound="ours: one core serves so many",
        detail={
            "of all trials": statistics.mean(one.share for one in found),
            "a client": "a socket, which draws nothing",
            "CPU per frame, ms": statistics.mean(one.cpu for one in found),
            **interpreter(),
        },
    )
    yield row(
        f"memory of each of {len(found)} trials of the example",
        statistics.mean(one.memory for one in found),
        "MB",
        at_most=MAX_MEMORY,
        bound="ours; each process's own pages, and its part of shared ones",
        detail={"MB resident, shared pages counted in each": statistics.mean(one.resident for one in found)},
    )


def slow_policy() -> Iterator[Row]:
    """Measure whether a policy that answers late delays the game."""
    slow, late = beside("agent:Partner")
    idle, _ = beside("idle")
    yield judged_policy(slow, idle, late)


def beside(partner: str) -> tuple[float, float]:
    """Play beside this partner. Return the share of ticks delivered, and the share of steps for which it was late."""
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as store:
        Path(folder, "agent.py").write_text(SLOW, encoding="utf-8")
        trial = {"startingFrameRate": RATE, "actionSpace": ["noop", "up"]}
        players = {"player": "human", "partner": partner}
        with seen.server(Path(folder), store=Path(store), players=players, **trial) as server:
            (found,) = asyncio.run(played([server]))
        steps = [line for line in _recorded(Path(store)) if line["kind"] == "step"]
        late = sum(step["players"]["partner"]["by"] == "late" for step in steps)
        return found.share, late / max(len(steps), 1)


def _recorded(store: Path) -> list[dict[str, Any]]:
    return [line for file in store.rglob("*.jsonl.gz*") for line in recording.read(file.read_bytes())]


def judged_policy(slow: float, idle: float, late: float) -> Row:
    """Return the row of a slow policy. Raises RuntimeError if the policy was never late: the row would show nothing."""
    if late == 0.0:
        raise RuntimeError("the policy was never late")
    return row(
        f"ticks at {RATE}/s that reach the client beside a policy that takes 100 ms, against one that idles",
        slow,
        "of those due",
        yardstick=max(idle, LEAST_SHARE),
        at_least=0.99,
        detail={
            "steps for which it was late": late,
            "beside the one that idles": idle,
            "the yardstick is at least": LEAST_SHARE,
        },
    )


def rows() -> Iterator[Row]:
    """Measure everything; about two minutes."""
    yield from each((one_trial, one_core, slow_policy))


if __name__ == "__main__":
    for found_row in rows():
        print(json.dumps(found_row), flush=True)
