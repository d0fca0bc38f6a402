"""A real `hippodrome run` in a folder of its own, with a study whose game is quick."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hippodrome.local.backend.processes import end_everything, marked
from testing import processes

ROOT = Path(__file__).resolve().parents[2]

CONFIG = """\
project:
  id: quick
  name: A quick study
  live: {live}
  maxRuntime: 5
{warm}  steps: {{1: hello, 2: game, 3: bye, finalStep: end}}
  events: {{startServerStep: {start}, stopServerStep: 3}}
trial:
  game: none
  maxEpisodes: 1
  startingFrameRate: 60
  maxFrameRate: 90
  actionSpace: [noop, left]
  ui: {{start: true, pause: true, stop: true, left: true}}
"""

AGENT = """\
import numpy as np

class Env:
    def reset(self, seed=None, options=None):
        self.n = 0
        return 0, {{}}
    def step(self, action):
        self.n += 1
        return 0, 1.0, self.n >= {frames}, False, {{}}
    def render(self):
        return np.zeros((16, 16, 3), np.uint8)
    def close(self):
        pass

class Agent:
    def start(self, game):
        self.env = Env()
        return self.env
    def reset(self, seed=None):
        return self.env.reset(seed=seed)
    def step(self, action):
        return self.env.step(action)
    def render(self):
        return self.env.render()
    def close(self):
        pass
"""


HOLDS = """
import os, time

class Env(Env):
    def step(self, action):
        while self.n == {holds} and os.path.exists({hold!r}):
            time.sleep(0.02)
        return super().step(action)
"""


def write_study(
    folder: Path, *, live: bool = True, start: int = 1, frames: int = 30, warm: int = 0, holds: int = 0
) -> Path:
    """Write a project folder: hello, a game of so many frames, bye, end; so many servers are kept warm.

    The game `holds` after so many frames, as long as there is the file `hold` beside the folder.
    """
    (folder / "steps").mkdir(parents=True)
    (folder / "config.yml").write_text(
        CONFIG.format(live=str(live).lower(), start=start, warm=f"  warmServers: {warm}\n" if warm else "")
    )
    hold = folder.parent / "hold"
    held = HOLDS.format(holds=holds, hold=str(hold)) if holds else ""
    (folder / "agent.py").write_text(AGENT.format(frames=frames) + held)
    if holds:
        hold.touch()
    for page in ("hello", "bye"):
        (folder / "steps" / f"{page}.html").write_text(f"<h1>{page}</h1><input name=word><button>Go on</button>")
    (folder / "steps" / "end.html").write_text(
        '<h1>end</h1><a href="https://recruiter.example/complete?cc=C1">Back</a>'
    )
    return folder


class Local:
    """A study that runs in a process of its own. After `kill`, `run` continues with the same folders."""

    def __init__(self, folder: Path, place: Path) -> None:
        self.folder = folder
        self.place = place
        self.data = place / "data"
        self.state = place / ".hippodrome" / "data"
        self.output = place / "output.txt"
        self.url = ""
        self.through_pipe = False  # so that what it says arrives even if it may write no file
        self.process: subprocess.Popen[str] | None = None

    def let_go_on(self) -> None:
        """Let a game that waits go on."""
        (self.folder.parent / "hold").unlink()

    def begin(self, *options: str) -> subprocess.Popen[str]:
        with self.output.open("wb") as file:
            cat = subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=file) if self.through_pipe else None
            output = cat.stdin if cat else file
            self.process = processes.start(
                "hippodrome",
                ["run", str(self.folder), "--data", "data", "--port", "0", *options],
                cwd=self.place,
                env={**os.environ, "PYTHONPATH": str(ROOT), "IDLE_SECONDS": "60"},
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        return self.process

    def run(self, *options: str) -> Local:
        self.begin(*options)
        self.url = self.wait_for_text(r"(http://127\.0\.0\.1:\d+)/next")[1]
        return self

    def text(self) -> str:
        return self.output.read_text()

    def wait_for_text(self, pattern: str, seconds: float = 60) -> re.Match[str]:
        """Wait until the terminal shows a match of this pattern."""
        until = time.monotonic() + seconds
        while not (found := re.search(pattern, self.text())):
            assert time.monotonic() < until, f"{pattern!r} was not printed:\n{self.text()}"
            time.sleep(0.05)
        return found

    def kill(self) -> None:
        assert self.process
        self.process.kill()
        self.process.wait()

    def end(self, number: int = signal.SIGINT) -> int:
        assert self.process
        self.process.send_signal(number)
        return self.process.wait(60)

    def servers(self) -> list[str]:
        """Return the names of servers that have a process."""
        return sorted(marked(self.state))


@pytest.fixture
def local(tmp_path: Path) -> Iterator[Callable[..., Local]]:
    """Makes a study and the folder in which it runs, and ends its processes after the test."""
    made: list[Local] = []

    def make(**options: object) -> Local:
        place = tmp_path / f"place{len(made)}"
        place.mkdir()
        made.append(Local(write_study(tmp_path / f"study{len(made)}", **options), place))  # type: ignore[arg-type]
        return made[-1]

    yield make
    for one in made:
        if one.process and one.process.poll() is None:
            one.process.kill()
            one.process.wait()
        end_everything(one.state)
