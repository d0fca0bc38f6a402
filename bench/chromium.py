"""Measures what participants see in a real Chromium: each opens the link of a study that `make run` runs.

A block in the corner of each picture is white while the participant's action is "left". The page notes by its own clock
when it draws, and how long after a press the corner shows it.
"""

from __future__ import annotations

import contextlib
import random
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import psutil

from bench.row import Row, row
from bench.study import folder, running, write_game
from testing.browser import chromium

RATE = 30  # frames a second
SECONDS = 6.0  # for which frames are counted
PRESSES = 40  # presses of a key, each down and up
PATIENCE = 30_000  # ms to wait for anything
TICK = 1_000 / RATE + 5  # ms: the goal from a key to its effect is one tick, and five more
PLAYABLE = "whether a participant can play: late or missing pictures feel like a bad keyboard"

# Notes each picture that is put on the canvas, and the ms from a key event until the corner shows it.
WATCH = """(() => {
  const seen = (window.seen = { draws: [], waits: [], expected: null, since: 0 });
  const watch = (name, corner) => {
    const plain = CanvasRenderingContext2D.prototype[name];
    CanvasRenderingContext2D.prototype[name] = function (...parts) {
      plain.apply(this, parts);
      const now = performance.now();
      seen.draws.push(now);
      if (seen.expected === null || corner(this, parts[0]) > 128 !== seen.expected) return;
      seen.waits.push(now - seen.since);
      seen.expected = null;
    };
  };
  const at = 8;
  watch("putImageData", (_, image) => image.data[4 * (8 * image.width + at)]);
  watch("drawImage", (context) => context.getImageData(at, 8, 1, 1).data[0]);
  const press = (down) => (event) => {
    if (event.repeat || event.code !== "ArrowLeft") return;
    Object.assign(seen, { expected: down, since: event.timeStamp });
  };
  addEventListener("keydown", press(true), true);
  addEventListener("keyup", press(false), true);
})()"""
COUNT = """(ms) => new Promise((done) => {
  seen.draws = [];
  setTimeout(() => done(seen.draws.length), ms);
})"""
REACHED = """([kind, count]) => seen[kind].length >= count"""

# The games


CONFIG = """
trial:
  game: ALE/MsPacman-v5
  maxEpisodes: 1000
  startingFrameRate: 30
"""
EXAMPLE = """
import example
class Agent(example.Agent):
    action = 0
    def step(self, action):
        self.action = action
        return super().step(action)
    def render(self):
        picture = super().render().copy()
        picture[:16, :16] = 255 * (self.action == 4)
        return picture
"""
EXAMPLE_CONFIG = CONFIG + "  actionSpace: [noop, up, right, down, left]\n"

# Coloured noise that looks like grass and gravel, and scrolls, so that nearly all pixels change.
TEXTURE = """
import numpy as np
class Agent:
    def start(self, game):
        noise, mixed = np.random.default_rng(7), np.full((400, 4200, 3), (110.0, 120.0, 90.0))
        for size in (1, 2, 4, 8, 16):
            shape = (400 // size + 1, 4200 // size + 1)
            grey = noise.normal(scale=10, size=(*shape, 1)) + noise.normal(scale=2, size=(*shape, 3))
            mixed += grey.repeat(size, 0).repeat(size, 1)[:400, :4200]
        self.texture = mixed.clip(0, 255).astype(np.uint8)
    def reset(self):
        self.t = self.action = 0
    def step(self, action):
        self.t, self.action = self.t + 3, action
        return None, 0.0, False, False, {}
    def render(self):
        at = self.t % 3600
        picture = self.texture[:, at:at + 600].copy()
        picture[:16, :16] = 255 * (self.action == 1)
        return picture
    def close(self):
        pass
"""
TEXTURE_CONFIG = CONFIG + "  actionSpace: [noop, left]\n"

# Forty objects, of which twelve move.
OBJECTS = """
import math
class Agent:
    def start(self, game):
        pass
    def reset(self):
        self.t = 0
    def step(self, action):
        self.t += 1
        return None, 0.0, False, False, {}
    def render(self):
        shown = [{"id": f"tile{n}", "type": "rectangle", "x": n % 9 / 9, "y": n // 9 / 3, "width": 40, "height": 40,
                  "color": "#4f9d69"} for n in range(28)]
        for n in range(12):
            turn = self.t / 20 + n
            place = {"x": 0.5 + 0.4 * math.cos(turn), "y": 0.5 + 0.4 * math.sin(turn)}
            shown.append({"id": f"ball{n}", "type": "circle", **place, "radius": 12, "color": "#f6c445"})
        return shown
    def close(self):
        pass
"""
OBJECTS_CONFIG = TEXTURE_CONFIG + '  scene: {width: 600, height: 400, background: "#202830"}\n'

# Two participants on one picture. They press their keys one after the other, so one block shows both.
PAIR = """
import numpy as np
class Agent:
    possible_agents = ["one", "two"]
    def start(self, game):
        pass
    def reset(self, seed=None):
        self.t, self.actions = 0, {"one": 0, "two": 0}
        return dict.fromkeys(self.possible_agents), {}
    def step(self, actions):
        self.t, self.actions = self.t + 1, actions
        over = dict.fromkeys(self.possible_agents, False)
        return dict.fromkeys(self.possible_agents), dict.fromkeys(self.possible_agents, 0.0), over, over, {}
    def render(self):
        picture = np.zeros((120, 160, 3), np.uint8)
        picture[60:70, self.t % 150:self.t % 150 + 10] = 200
        picture[:16, :16] = 255 * (1 in self.actions.values())
        return picture
    def close(self):
        pass
"""
PAIR_CONFIG = "  players: 2\n" + TEXTURE_CONFIG + "  countdown: 0\n  players: {one: human, two: human}\n"


# Watching


@dataclass
class Watched:
    """What one participant saw, and what their server cost."""

    share: float
    """The share of the frames that were due and were drawn."""
    waits: list[float]
    """The ms from each key event to the draw that shows its effect."""
    bytes_a_frame: float
    cpu: float
    """The server's processor time for each frame, in ms."""
    memory: float
    """The resident pages of the server, in MB."""


class Player:
    """A participant in a context of their own."""

    def __init__(self, browser: Any, address: str, user: str) -> None:
        self.context = browser.new_context(viewport={"width": 1280, "height": 800})
        self.context.set_default_timeout(PATIENCE)
        self.page = self.context.new_page()
        self.page.add_init_script(WATCH)
        self.server = 0  # the port of their server
        self.received: list[int] = []  # the bytes of each binary message
        self.page.on("websocket", self._connected)
        self.page.goto(f"{address}/next?projectId=bench&userId={user}")
        self.page.fill("input[name=word]", "hello")
        self.page.click("button")

    def _connected(self, socket: Any) -> None:
        self.server = int(urlsplit(socket.url).port or 0)
        socket.on("framereceived", lambda data: self.received.append(len(data)) if isinstance(data, bytes) else None)

    def begin(self) -> None:
        """Start the game when the server is there."""
        self.page.click("#overlay-button")

    def watch(self, *, drawn: bool = True) -> Watched:
        """Count frames for a while, then press keys. Without `drawn` only messages are counted."""
        if drawn:
            self.until("draws", 20)
        else:
            self.page.wait_for_timeout(2_000)
        process = serving(self.server)
        spent, before, begun = cpu_seconds(process.pid), len(self.received), time.perf_counter()
        draws = self.page.evaluate(COUNT, 1000 * SECONDS)
        seconds = time.perf_counter() - begun
        spent, sizes = cpu_seconds(process.pid) - spent, self.received[before:]
        frames = draws if drawn else len(sizes)
        return Watched(
            frames / (RATE * (SECONDS if drawn else seconds)),
            self.presses() if drawn else [],
            sum(sizes) / len(sizes),
            1000 * spent / frames,
            process.memory_info().rss / 2**20,
        )

    def presses(self) -> list[float]:
        """Press keys; return the milliseconds until each effect was drawn."""
        moments = random.Random(7)
        for number in range(2 * PRESSES):
            self.page.wait_for_timeout(moments.uniform(20, 120))  # so that keys come at any moment between two frames
            press = self.page.keyboard.down if number % 2 == 0 else self.page.keyboard.up
            press("ArrowLeft")
            self.until("waits", number + 1)
        waits: list[float] = self.page.evaluate("seen.waits")
        return waits

    def until(self, kind: str, count: int) -> None:
        """Wait until the page has noted so many `draws` or `waits`. Raises RuntimeError with the text of the page."""
        from playwright.sync_api import TimeoutError as TookTooLong

        try:
            self.page.wait_for_function(REACHED, arg=[kind, count], polling=10)
        except TookTooLong:
            raise RuntimeError(f"fewer than {count} {kind}; the page: {self.page.inner_text('body')}") from None


def serving(port: int) -> psutil.Process:
    """Return the process that listens at this port of this machine."""
    for connection in psutil.net_connections("tcp"):
        place = connection.laddr
        if connection.status == psutil.CONN_LISTEN and connection.pid and place and place.port == port:
            return psutil.Process(connection.pid)
    raise RuntimeError(f"no process listens at the port {port}")


def cpu_seconds(pid: int) -> float:
    """Return the processor seconds of a process, from the clock that clock_getcpuclockid(3) names.

    `/proc/PID/stat` counts in hundredths of a second, which is too coarse: a server can send dozens of pictures in one.
    """
    return time.clock_gettime((~pid << 3) | 2)


@contextlib.contextmanager
def playing(config: str, agent: str, players: int = 1) -> Iterator[list[Player]]:
    """Run a study in which so many participants have begun to play."""
    with folder() as study, chromium() as browser:
        write_game(study, config, agent)
        with running(study) as address:
            present = [Player(browser, address, f"P{number}") for number in range(players)]
            if players == 1:
                present[0].begin()
            yield present


# The measures


def frames_drawn(name: str, share: float, which: str = "") -> Row:
    """Return the row of the frames that a page has drawn. `which` says whose page, if there are several."""
    return row(f"{name}: frames drawn{which}", share, "of those due", at_least=0.99, better="more", decides=PLAYABLE)


def key_to_effect(name: str, median: float, detail: dict[str, float] | None = None, which: str = "") -> Row:
    """Return the row of the milliseconds from a key to its drawn effect."""
    return row(
        f"{name}: key to drawn effect, p50{which}",
        median,
        "ms",
        at_most=round(TICK, 1),
        decides=PLAYABLE,
        detail=detail,
    )


def example() -> Iterator[Row]:
    """Measure the example's game, Ms. Pac-Man."""
    with playing(EXAMPLE_CONFIG, EXAMPLE) as (player,):
        watched = player.watch()
    name = f"Ms. Pac-Man at {RATE}/s"
    p95 = statistics.quantiles(watched.waits, n=20)[-1]
    yield frames_drawn(name, watched.share)
    yield key_to_effect(name, statistics.median(watched.waits), {"p95": p95, "presses": len(watched.waits)})
    yield row(
        f"{name}: bytes of a frame",
        watched.bytes_a_frame,
        "bytes",
        decides="whether a participant with bad Wi-Fi can play; the bill counts data that leave AWS",
    )
    yield row(
        f"{name}: server's CPU for a frame, with game and recording",
        watched.cpu,
        "ms",
        at_most=1000 / RATE / 4,
        decides="the bill: whether 0.25 vCPU, the smallest server, can be enough",
    )
    yield row(
        f"{name}: memory of the server",
        watched.memory,
        "MB",
        at_most=256,
        decides="the bill: whether 0.5 GB, the smallest server, can be enough, half of it for the study's own packages",
    )


def texture() -> Iterator[Row]:
    """Measure a large picture in which everything changes, which is sent with loss."""
    with playing(TEXTURE_CONFIG, TEXTURE) as (player,):
        watched = player.watch()
    name = f"scrolling texture of 600 x 400 at {RATE}/s"
    yield frames_drawn(name, watched.share)
    yield key_to_effect(name, statistics.median(watched.waits))
    yield row(
        f"{name}: bytes of a frame", watched.bytes_a_frame, "bytes", decides="what a 3D environment asks of a network"
    )
    yield row(f"{name}: server's CPU for a frame", watched.cpu, "ms", decides="the server's size for a 3D environment")


def objects() -> Iterator[Row]:
    """Measure a game that is drawn by objects."""
    with playing(OBJECTS_CONFIG, OBJECTS) as (player,):
        watched = player.watch(drawn=False)
    yield row(
        f"forty objects, twelve of them move, at {RATE}/s: bytes of a tick",
        watched.bytes_a_frame,
        "bytes",
        at_most=500,
        decides="whether to draw by objects: docs/objects.md promises about 400 bytes",
        detail={"ticks received, of those due": watched.share, "server's CPU for a tick, ms": watched.cpu},
    )


def two_players() -> Iterator[Row]:
    """Measure two participants of one game."""
    with playing(PAIR_CONFIG, PAIR, 2) as players:
        watched = [player.watch() for player in players]
    name = f"two players at {RATE}/s"
    yield frames_drawn(name, min(view.share for view in watched), ", the one who sees less")
    yield key_to_effect(
        name, max(statistics.median(view.waits) for view in watched), which=", the one who waits longer"
    )
