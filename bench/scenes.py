"""Compares a game drawn by objects with the same game drawn by frames, in a real Chromium: `python -m bench.scenes`.

The game has forty objects, of which twelve move, on 600 x 400 pixels at 30 ticks a second. The page times drawn ticks
and the effects of keys by its own clock, as in `bench/seen.py`.
"""

from __future__ import annotations

import contextlib
import gzip
import json
import statistics
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench import seen
from bench.pictures import ROOT
from bench.table import Row, each, row
from testing.browser import chromium, game_page

RATE = 30  # ticks a second
MAX_WAIT = 1_000 / RATE + 5
"""The goal of the median time from a key to its effect, in milliseconds: one tick and 5 ms."""
MAX_WEIGHT = 40_000
"""The goal of the size of the game page, compressed and without the study's images, in bytes."""
SCENE = {"width": 600, "height": 400, "background": "#202830"}

# The last object is a block in the corner that is white while the action is "left". For frames the server draws the
# same objects, as it does for clients that cannot draw objects.
AGENT = """
import math, sys
sys.path.insert(0, ROOT)
from protocol.trial_sections import SceneSection
from trial.pictures.assets import Assets
from trial.pictures.scene import as_scene
class Agent:
    def start(self, game):
        if not OBJECTS:
            from trial.pictures.raster import Raster
            self.raster = Raster(SceneSection(width=600, height=400, background="#202830"), Assets())
    def reset(self):
        self.t = self.action = 0
    def step(self, action):
        self.t, self.action = self.t + 1, action
        return None, 0.0, False, False, {}
    def render(self):
        found = [{"id": f"tile{n}", "type": "rectangle", "x": n % 9 / 9, "y": n // 9 / 3, "width": 40, "height": 40,
                  "color": "#4f9d69"} for n in range(27)]
        for n in range(12):
            turn = self.t / 20 + n
            place = {"x": 0.5 + 0.4 * math.cos(turn), "y": 0.5 + 0.4 * math.sin(turn)}
            found.append({"id": f"ball{n}", "type": "circle", **place, "radius": 12, "color": "#f6c445"})
        found.append({"id": "mark", "type": "rectangle", "x": 0, "y": 0, "width": 16, "height": 16,
                      "color": "#ffffff" if self.action else "#000000"})
        return found if OBJECTS else self.raster.draw(as_scene(found))
    def close(self):
        pass
"""

# Notes each draw of a scene, which begins with its background, and the ms from a key event until the corner shows it.
WATCH = """(() => {
  const { fillRect, fill } = CanvasRenderingContext2D.prototype;
  CanvasRenderingContext2D.prototype.fillRect = function (...box) {
    fillRect.apply(this, box);
    if (box[2] === this.canvas.width) benchSeen.draws.push(performance.now());
  };
  CanvasRenderingContext2D.prototype.fill = function () {
    fill.apply(this);
    if (benchSeen.wanted === null || this.getImageData(4, 4, 1, 1).data[0] > 128 !== benchSeen.wanted) return;
    benchSeen.waits.push(performance.now() - benchSeen.since);
    benchSeen.wanted = null;
  };
})()"""


@dataclass
class Shown:
    """The figures of one way to draw the game."""

    seen: seen.Seen = field(default_factory=seen.Seen)
    bytes_a_tick: float = 0.0
    weight: int = 0
    """The size of the page in bytes, compressed."""


def look(browser: Any, *, objects: bool) -> Shown:
    """Play in a page, then press keys; return the figures."""
    found = Shown()
    with _game(objects) as (address, pid):
        context = browser.new_context(viewport={"width": 1280, "height": 800})
        context.set_default_timeout(seen.PATIENCE)
        try:
            page = context.new_page()
            sizes: list[int] = []
            page.on("websocket", lambda socket: socket.on("framereceived", lambda data: sizes.append(_size(data))))
            page.add_init_script(seen.WATCH)
            if objects:
                page.add_init_script(WATCH)
            answer = page.goto(address)
            found.weight = len(gzip.compress(answer.body(), 6))
            page.click("#overlay-button")
            seen.until(page, "draws", 20)
            sizes.clear()
            seen.frames(page, pid, RATE, found.seen)
            found.bytes_a_tick = sum(sizes) / (RATE * seen.SECONDS)
            found.seen.waits = seen.presses(page)
        finally:
            context.close()
    return found


def _size(data: Any) -> int:
    return len(data.encode() if isinstance(data, str) else data)


@contextlib.contextmanager
def _game(objects: bool) -> Iterator[tuple[str, int]]:
    """Run the game's page and server within the block; give the page's address and the server's process id."""
    trial: dict[str, Any] = {"scene": SCENE} if objects else {}
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "agent.py").write_text(f"ROOT, OBJECTS = {str(ROOT)!r}, {objects}\n{AGENT}", encoding="utf-8")
        space: dict[str, Any] = {"actionSpace": ["noop", "left"], "startingFrameRate": RATE}
        with (
            seen.server(Path(folder), **space, **trial) as (url, pid),
            game_page(url, user="bench", token="bench", trial=trial) as address,
        ):
            yield address, pid


def in_chromium() -> Iterator[Row]:
    """Measure what participants see of the game in both ways. Raises NoChromium."""
    with chromium() as browser:
        yield from judged(look(browser, objects=True), look(browser, objects=False))


def judged(objects: Shown, frames: Shown) -> Iterator[Row]:
    """Yield the rows of both ways."""
    for name, shown in (("objects", objects), ("frames", frames)):
        yield row(
            f"ticks drawn at {RATE}/s, {name}",
            shown.seen.share[RATE],
            "of those due",
            at_least=0.99,
            bound="ours: participants see each tick",
        )
        yield row(
            f"key to drawn effect at {RATE}/s, {name}, p50",
            statistics.median(shown.seen.waits),
            "ms",
            at_most=round(MAX_WAIT, 1),
            bound="ours: one tick and 5 ms",
        )
        yield row(f"server's CPU per drawn tick at {RATE}/s, {name}", shown.seen.cpu[RATE], "ms")
    yield row(
        f"bytes per tick at {RATE}/s, objects, against frames of the same game",
        objects.bytes_a_tick,
        "bytes",
        yardstick=frames.bytes_a_tick,
        at_most=0.5,
    )
    yield row(
        "the game page with the modules of objects, compressed",
        objects.weight,
        "bytes",
        at_most=MAX_WEIGHT,
        bound="ours: the size of the game page over the network",
        detail={"without them": frames.weight},
    )


def rows() -> Iterator[Row]:
    """Measure everything; about half a minute."""
    yield from each((in_chromium,))


if __name__ == "__main__":
    for found in rows():
        print(json.dumps(found), flush=True)
