"""Measures games of several participants on real servers, and in a real Chromium: `python -m bench together`.

The game itself takes hardly any time, so the figures are those of the server: players on a board, drawn by objects, 30
ticks a second. Clients are sockets that acknowledge pictures as our page does, and press keys. In the browsers, pages
time what participants see, by their own clocks.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import statistics
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from bench import load, seen
from bench.interpreter import interpreter
from bench.table import Row, each, row
from bench.trial_server import trial_server
from protocol.keys import session_key
from protocol.session import Member, SessionDocument, member_token
from testing.browser import chromium, game_page

RATE = load.RATE  # ticks a second
GAMES = 40  # games of two that one core has to serve
MAX_WAIT = 1_000 / RATE + 5
"""The goal of the median time from a key to its effect, in milliseconds: one tick and 5 ms."""
PLAYERS = tuple(f"player_{number}" for number in range(8))
ACTIONS = ("wait", "up", "right", "down", "left")
SESSION, TOKEN = "s." + 20 * "0", "bench"
SCENE = {"width": 600, "height": 400}

# A block for each player shows whether the player's action is "left"; the text is the number of the tick.
AGENT = """
class Agent:
    possible_agents = PLAYERS
    def start(self, game):
        pass
    def reset(self, seed=None):
        self.t, self.taken = 0, dict.fromkeys(PLAYERS, 0)
        self.at = {player: [number, 2] for number, player in enumerate(PLAYERS)}
        return dict.fromkeys(PLAYERS), {}
    def step(self, actions):
        self.t += 1
        self.taken = actions
        for player, action in actions.items():
            x, y = self.at[player]
            dx, dy = ((0, 0), (0, -1), (1, 0), (0, 1), (-1, 0))[action]
            self.at[player] = [min(8, max(0, x + dx)), min(5, max(0, y + dy))]
        over = dict.fromkeys(PLAYERS, False)
        return dict.fromkeys(PLAYERS), dict.fromkeys(PLAYERS, 0.0), over, over, {}
    def render(self):
        found = [{"id": f"tile{n}", "type": "rectangle", "x": n % 9 / 9, "y": n // 9 / 6, "width": 60, "height": 60,
                  "color": "#4f9d69"} for n in range(12)]
        for n, player in enumerate(PLAYERS):
            x, y = self.at[player]
            found.append({"id": player, "type": "circle", "x": (x + 0.5) / 9, "y": (y + 0.5) / 6, "radius": 20,
                          "color": "#f6c445"})
            found.append({"id": f"mark{n}", "type": "rectangle", "x": n * 16 / 600, "y": 0, "width": 16, "height": 16,
                          "color": "#ffffff" if self.taken[player] == 4 else "#000000"})
        found.append({"id": "tick", "type": "text", "x": 0.9, "y": 0.9, "text": str(self.t), "size": 12})
        return found
    def close(self):
        pass
"""

# Notes each draw and its tick, which is the text that is drawn last; and the ms from a key event until the
# participant's own block shows it.
WATCH = """(() => {
  const seat = %d, { fillText } = CanvasRenderingContext2D.prototype;
  benchSeen.ticks = [];
  CanvasRenderingContext2D.prototype.fillText = function (text, ...place) {
    fillText.call(this, text, ...place);
    const now = performance.now(), { width, height } = this.canvas;
    benchSeen.draws.push(now);
    benchSeen.ticks.push([performance.timeOrigin + now, Number(text)]);
    if (benchSeen.wanted === null) return;
    const [left, top] = [(16 * seat + 8) / 600 * width, 8 / 400 * height].map(Math.round);
    const [value] = this.getImageData(left, top, 1, 1).data;
    if (value > 128 !== benchSeen.wanted) return;
    benchSeen.waits.push(performance.now() - benchSeen.since);
    benchSeen.wanted = null;
  };
})()"""


@dataclass
class TogetherLoad:
    """The figures of one server: what it delivered and cost. `cpu` is in ms per tick, `memory` in MB."""

    shares: list[float]  # by member: the share of the ticks that were due
    bytes_a_tick: float  # the bytes sent to each member
    cpu: float
    memory: float


def members(players: int) -> list[str]:
    """Return the ids of so many members."""
    return [f"p{number}" for number in range(players)]


@contextlib.contextmanager
def server(players: int) -> Iterator[tuple[str, int]]:
    """Run the server of a session with so many members within the block; give its address and process id."""
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as store:
        Path(folder, "agent.py").write_text(f"PLAYERS = {list(PLAYERS[:players])}\n{AGENT}", encoding="utf-8")
        trial = {
            "game": "bench",
            "players": dict.fromkeys(PLAYERS[:players], "human"),
            "actionSpace": list(ACTIONS),
            "startingFrameRate": RATE,
            "scene": SCENE,
            "countdown": 0,
            "gather": 3600,  # while dozens of servers start, the clients of one game may come far apart
            "maxEpisodes": 1000,
        }
        document = SessionDocument(
            SESSION, players, tuple(Member(one, None, seat) for seat, one in enumerate(members(players)))
        )
        path = Path(store, session_key("bench", SESSION))
        path.parent.mkdir(parents=True)
        path.write_bytes(document.to_json())
        with trial_server(Path(folder), store, trial, SESSION=SESSION) as (port, process):
            yield f"ws://127.0.0.1:{port}/", process.pid


async def play(user: str, url: str, count: load.Count) -> None:
    """Play as this member until the task is cancelled."""
    keys = random.Random(user)
    async with connect(
        url, subprotocols=[Subprotocol("hippodrome.3")], max_size=None, compression=None, open_timeout=60
    ) as client:
        acknowledging = load.Acknowledging(client.send)
        await client.send(json.dumps({"userId": user, "token": member_token(TOKEN, user)}))
        async for data in client:
            count.bytes += len(data)
            if isinstance(data, str):
                continue
            count.pictures += 1
            await acknowledging.drawn(load.frame_id(data))
            if count.pictures % 20 == 0:
                await client.send(json.dumps({"action": keys.choice(ACTIONS[1:]), "held": keys.random() < 0.5}))


async def played(servers: Sequence[tuple[str, int]], players: int) -> list[TogetherLoad]:
    """Play on all of these servers at once; return what each delivered and cost."""
    found = await load.delivered(servers, [partial(play, user) for user in members(players)])
    return [_played(pid, one) for (_, pid), one in zip(servers, found, strict=True)]


def _played(pid: int, found: load.Delivered) -> TogetherLoad:
    ticks = [client.pictures for client in found.clients]
    size = sum(client.bytes for client in found.clients)
    cpu = 1000 * found.cpu / max(1, *ticks)
    return TogetherLoad([one / found.due for one in ticks], size / max(1, sum(ticks)), cpu, load.memory(pid)[0])


# On sockets


def on_sockets() -> Iterator[Row]:
    """Measure one game of two participants and one of eight."""
    for players in (2, 8):
        with server(players) as one:
            (found,) = asyncio.run(played([one], players))
        yield from judged_game(players, found)


def judged_game(players: int, found: TogetherLoad) -> Iterator[Row]:
    """Yield the rows of one game."""
    yield row(
        f"ticks at {RATE}/s that reach the client of each of {players} participants in one game, at least",
        min(found.shares),
        "of those due",
        at_least=0.99,
        bound="ours: the server sends each tick to each participant",
        detail={"a client": "a socket, which draws nothing", "server's CPU per tick, ms": found.cpu},
    )
    yield row(f"bytes per tick at {RATE}/s to each of {players} participants", found.bytes_a_tick, "bytes")


def one_core() -> Iterator[Row]:
    """Measure many games of two on one core, and the memory of each."""
    with (
        contextlib.ExitStack() as running,
        ThreadPoolExecutor(
            4, initializer=os.sched_setaffinity, initargs=(0, {max(os.sched_getaffinity(0))})
        ) as starting,
    ):  # a process inherits the cores of the thread that starts it
        servers = list(starting.map(lambda _: running.enter_context(server(2)), range(GAMES)))
        found = asyncio.run(played(servers, 2))
    yield from judged_core(found)


def judged_core(found: Sequence[TogetherLoad]) -> Iterator[Row]:
    """Yield the rows of games that share a core."""
    cpu = statistics.mean(one.cpu for one in found)
    yield row(
        f"ticks at {RATE}/s that reach the client of each participant of {len(found)} games on one core, at least",
        min(share for one in found for share in one.shares),
        "of those due",
        at_least=0.99,
        bound="ours: one core serves so many games of two",
        detail={
            "of all participants": statistics.mean(share for one in found for share in one.shares),
            "server's CPU per tick, ms": cpu,
            "games on a core by that": 1000 / RATE / cpu,
            **interpreter(),
        },
    )
    yield row(
        f"memory of each of {len(found)} games of two",
        statistics.mean(one.memory for one in found),
        "MB",
        detail={"counted": "each process's own pages, and its part of shared ones"},
    )


# In two browsers


@dataclass
class PairSeen:
    """What two participants saw, in figures. Times are milliseconds."""

    shares: list[float]  # by participant: the share of the ticks that were due
    waits: list[list[float]]  # by participant: the times from a key event to its effect
    apart: list[int]  # at each draw in either page: how many ticks lie between the pictures of the two pages


def in_two_browsers() -> Iterator[Row]:
    """Measure two participants of one game, each in a browser context of their own. Raises NoChromium."""
    with chromium() as browser:
        yield from judged_views(look(browser))


def look(browser: Any) -> PairSeen:
    """Let both participants watch the game, then let each press keys; return what they saw."""
    with server(2) as (url, pid), contextlib.ExitStack() as opened:
        pages = []
        for seat, user in enumerate(members(2)):
            trial = {"scene": SCENE}
            address = opened.enter_context(
                game_page(url, user=user, token=member_token(TOKEN, user), trial=trial, players=2)
            )
            context = browser.new_context(viewport={"width": 1280, "height": 800})
            opened.callback(context.close)
            context.set_default_timeout(seen.PATIENCE)
            pages.append(context.new_page())
            pages[-1].add_init_script(seen.WATCH)
            pages[-1].add_init_script(WATCH % seat)
            pages[-1].goto(address)
        for page in pages:
            seen.until(page, "draws", 20)
        both = [seen.Seen(), seen.Seen()]
        for page, one in zip(pages, both, strict=True):
            page.evaluate("benchSeen.ticks = []")
            seen.frames(page, pid, RATE, one)
            one.waits = seen.presses(page)
        ticks = [page.evaluate("benchSeen.ticks") for page in pages]
        return PairSeen([one.share[RATE] for one in both], [one.waits for one in both], apart(*ticks))


def apart(one: Sequence[Sequence[float]], other: Sequence[Sequence[float]]) -> list[int]:
    """Return, at each draw of either page, how many ticks lie between the pictures of the two.

    A draw is its time in ms and its tick. Draws before both pages have drawn are left out.
    """
    shown: list[int | None] = [None, None]
    found = []
    for _, page, tick in sorted((at, page, int(tick)) for page, draws in enumerate((one, other)) for at, tick in draws):
        shown[page] = tick
        if shown[0] is not None and shown[1] is not None:
            found.append(abs(shown[0] - shown[1]))
    return found


def judged_views(found: PairSeen) -> Iterator[Row]:
    """Yield the rows of what two participants saw."""
    yield row(
        f"ticks drawn at {RATE}/s in each of two browsers",
        min(found.shares),
        "of those due",
        at_least=0.99,
        bound="ours: participants see each tick",
    )
    yield row(
        "ticks between what two browsers of one game show, at most",
        max(found.apart),
        "ticks",
        at_most=1,
        bound="ours: both participants see the same tick, but for one",
        detail={"draws": len(found.apart), "of them further apart": sum(each > 1 for each in found.apart)},
    )
    for number, waits in enumerate(found.waits, 1):
        yield row(
            f"key to drawn effect at {RATE}/s, participant {number} of two, p50",
            statistics.median(waits),
            "ms",
            at_most=round(MAX_WAIT, 1),
            bound="ours: one tick and 5 ms",
            detail={"p95": statistics.quantiles(waits, n=20)[-1], "presses": len(waits)},
        )


def rows() -> Iterator[Row]:
    """Measure everything; about two minutes."""
    yield from each((on_sockets, one_core, in_two_browsers))


if __name__ == "__main__":
    for found_row in rows():
        print(json.dumps(found_row), flush=True)
