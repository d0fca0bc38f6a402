"""Measures what a participant sees: drawn frames and the effects of keys, timed in the page by its own clock."""

from __future__ import annotations

import contextlib
import io
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from bench.bare import PAGE
from bench.pictures import GAME, KINDS, ROOT
from bench.trial_server import trial_server
from testing.browser import game_page, html_page
from trial.pictures.frames import Frame

SECONDS = 6.0
PRESSES = 60  # presses of a key, each down and up
PATIENCE = 20_000  # ms to wait for any condition
BLOCK = 16  # pixels: the side of the block in the corner that shows whether the key is down

# Runs in the page before its own scripts. Notes each draw on the canvas, and the ms from a key event until the corner
# shows it.
WATCH = """(() => {
  const seen = (window.benchSeen = { draws: [], drawn: 0, waits: [], wanted: null, since: 0 });
  const draw = (name, corner) => {
    const plain = CanvasRenderingContext2D.prototype[name];
    CanvasRenderingContext2D.prototype[name] = function (...parts) {
      plain.apply(this, parts);
      const now = performance.now();  // before the corner is read, which takes longer on one of the two pages
      seen.draws.push(now);
      seen.drawn++;
      if (seen.wanted === null || corner(this, parts[0]) > 128 !== seen.wanted) return;
      seen.waits.push(now - seen.since);
      seen.wanted = null;
    };
  };
  draw("putImageData", (_, image) => image.data[4 * (8 * image.width + 8)]);
  draw("drawImage", (context) => context.getImageData(8, 8, 1, 1).data[0]);
  const press = (down) => (event) => {
    if (event.repeat || event.code !== "ArrowLeft") return;
    Object.assign(seen, { wanted: down, since: event.timeStamp });
  };
  addEventListener("keydown", press(true), true);
  addEventListener("keyup", press(false), true);
})()"""

# The example's game, Gymnasium's CartPole, and a scrolling texture, each with a block in the corner that is white while
# the action is "left".
AGENTS = {
    "Ms. Pac-Man": """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("example_agent", ROOT + "/agent.py")
example = importlib.util.module_from_spec(spec)
spec.loader.exec_module(example)
class Agent(example.Agent):
    action = 0
    def step(self, action):
        self.action = action
        return super().step(action)
    def render(self):
        picture = super().render().copy()
        picture[:16, :16] = 255 * (self.action == LEFT)
        return picture
""",
    "CartPole, 600 x 400": """
import gymnasium
class Agent:
    def start(self, game):
        self.env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    def reset(self):
        self.action = 0
        self.env.reset(seed=7)
    def step(self, action):
        self.action = action
        _, _, terminated, truncated, _ = self.env.step(action)
        if terminated or truncated:  # the trial's episode goes on, so that the page shows nothing else in between
            self.env.reset(seed=7)
        return None, 0.0, False, False, {}
    def render(self):
        picture = self.env.render().copy()
        picture[:16, :16] = 255 * (self.action == LEFT)
        return picture
    def close(self):
        self.env.close()
""",
    "scrolling texture, 600 x 400": """
import sys
sys.path.insert(0, ROOT)
from bench.pictures import texture
class Agent:
    def start(self, game):
        self.texture = texture(4200)
    def reset(self):
        self.t = self.action = 0
    def step(self, action):
        self.t, self.action = self.t + 3, action
        return None, 0.0, False, False, {}
    def render(self):
        at = self.t % 3600
        picture = self.texture[:, at:at + 600].copy()
        picture[:16, :16] = 255 * (self.action == LEFT)
        return picture
    def close(self):
        pass
""",
}
LEFT = {"Ms. Pac-Man": 3, "CartPole, 600 x 400": 1, "scrolling texture, 600 x 400": 1}


@dataclass
class Seen:
    """The figures of one page, by frames per second. Times are milliseconds."""

    share: dict[int, float] = field(default_factory=dict)
    """The share of the frames that were due; above 1 if earlier frames were drawn late."""
    gaps: dict[int, float] = field(default_factory=dict)
    """The 99th percentile of the time between two draws."""
    cpu: dict[int, float] = field(default_factory=dict)
    """The server's processor time per drawn frame."""
    waits: list[float] = field(default_factory=list)
    """The times from each key event to the draw that shows its effect, at one rate."""
    since_opened: dict[int, float] = field(default_factory=dict)
    """The number of all draws, as a share of the frames that were due since the page was opened."""


@contextlib.contextmanager
def server(agent_dir: Path, *, store: Path | None = None, **trial: Any) -> Iterator[tuple[str, int]]:
    """Run a trial server within the block; give its address and process id. `store` is the folder of its recordings."""
    with tempfile.TemporaryDirectory() as folder:
        section = {"game": GAME, "maxEpisodes": 1000, **trial}
        with trial_server(agent_dir, str(store or folder), section, USER_ID="bench") as (port, process):
            yield f"ws://127.0.0.1:{port}/", process.pid


def cpu_seconds(pid: int) -> float:
    """Return the processor seconds of a process, user and system, from the clock that clock_getcpuclockid(3) names.

    `/proc/PID/stat` counts in hundredths of a second, which is too coarse: a server can send dozens of pictures in one.
    """
    return time.clock_gettime((~pid << 3) | 2)


@contextlib.contextmanager
def ours(picture: str, rate: int) -> Iterator[tuple[str, int]]:
    """Run Hippodrome's game page and trial server for the block; give the page's address and the server's pid."""
    with tempfile.TemporaryDirectory() as folder:
        source = f"ROOT, LEFT = {str(ROOT)!r}, {LEFT[picture]}\n{AGENTS[picture]}"
        Path(folder, "agent.py").write_text(source, encoding="utf-8")
        space: dict[str, Any] = {"actionSpace": ["noop", "left"]} if LEFT[picture] == 1 else {}
        with (
            server(Path(folder), startingFrameRate=rate, **space) as (url, pid),
            game_page(url, user="bench", token="bench") as address,
        ):
            yield address, pid


@contextlib.contextmanager
def bare(picture: str, rate: int) -> Iterator[tuple[str, int]]:
    """Run the yardstick's page and server, which show the same kind of picture as JPEGs; give the same as `ours`."""
    frames = KINDS[picture]()[:8]
    with tempfile.TemporaryDirectory() as folder:
        names = []
        for value in (0, 255):
            for number, frame in enumerate(frames):
                names.append(f"{folder}/{value}-{number}.jpg")
                Path(names[-1]).write_bytes(_jpeg(frame, value))
        process = subprocess.Popen(
            [sys.executable, "-m", "bench.bare", str(rate), *names], cwd=ROOT, stdout=subprocess.PIPE
        )
        try:
            assert process.stdout is not None
            port = int(process.stdout.readline())
            with html_page(PAGE % f"ws://127.0.0.1:{port}/") as address:
                yield address, process.pid
        finally:
            process.terminate()
            process.wait(30)


def _jpeg(frame: Frame, corner: int) -> bytes:
    frame = frame.copy()
    frame[:BLOCK, :BLOCK] = corner
    out = io.BytesIO()
    Image.fromarray(frame).save(out, "JPEG")
    return out.getvalue()


def look(browser: Any, setting: Any, picture: str, rates: tuple[int, ...], pressed_at: int) -> Seen:
    """Play in a page at each rate, and press keys at the rate `pressed_at`. `setting` is `ours` or `bare`."""
    seen = Seen()
    for rate in rates:
        with setting(picture, rate) as (address, pid):
            context = browser.new_context(viewport={"width": 1280, "height": 800})
            context.set_default_timeout(PATIENCE)
            try:
                page = context.new_page()
                page.add_init_script(WATCH)
                page.goto(address)
                page.click("#overlay-button")
                until(page, "draws", 20)
                frames(page, pid, rate, seen)
                if rate == pressed_at:
                    seen.waits = presses(page)
            finally:
                context.close()
    return seen


def until(page: Any, kind: str, count: int) -> None:
    """Wait until the page has noted so many `draws` or `waits`. Raises Playwright's Error after PATIENCE."""
    page.evaluate(
        """([kind, count, patience]) => new Promise((done, fail) => {
            const end = performance.now() + patience;
            const missing = () => new Error(`fewer than ${count} ${kind}: ${document.body.innerText}`);
            const look = () => {
                if (benchSeen[kind].length >= count) done();
                else if (performance.now() > end) fail(missing());
                else setTimeout(look, 10);
            };
            look();
        })""",
        [kind, count, PATIENCE],
    )


def frames(page: Any, pid: int, rate: int, seen: Seen) -> None:
    """Watch the page for SECONDS, or longer until there are two draws, and enter the figures in `seen`.

    Draws after SECONDS do not count, even if the page's timer is late. Raises Playwright's Error, with the page's text,
    after PATIENCE more without two draws.
    """
    cpu = cpu_seconds(pid)
    draws, watched = page.evaluate(
        """([ms, patience]) => new Promise((done, fail) => {
            benchSeen.draws = [];
            const begun = performance.now();
            const look = () => {
                const draws = benchSeen.draws.map((at) => at - begun);
                const until = Math.max(ms, draws[1] ?? Infinity);
                if (until === Infinity && performance.now() > begun + ms + patience)
                    fail(new Error(`fewer than 2 draws: ${document.body.innerText}`));
                else if (until === Infinity) setTimeout(look, 10);
                else done([draws.filter((at) => at <= until), until]);
            };
            setTimeout(look, ms);
        })""",
        [1000 * (SECONDS + 0.5 / rate), PATIENCE],
    )
    spent = cpu_seconds(pid) - cpu
    seen.share[rate] = len(draws) / (rate * watched / 1000 - 0.5)
    drawn, opened = page.evaluate("[benchSeen.drawn, performance.now()]")
    seen.since_opened[rate] = drawn / (rate * opened / 1000)
    seen.gaps[rate] = float(np.percentile(np.diff(draws), 99))
    seen.cpu[rate] = 1000 * spent / len(draws)


def presses(page: Any) -> list[float]:
    """Press keys; return the milliseconds until each effect was drawn."""
    moments = random.Random(7)
    for number in range(2 * PRESSES):
        page.wait_for_timeout(moments.uniform(20, 120))  # so that keys come at any moment between two frames
        press = page.keyboard.down if number % 2 == 0 else page.keyboard.up
        press("ArrowLeft")
        until(page, "waits", number + 1)
    waits: list[float] = page.evaluate("benchSeen.waits")
    return waits
