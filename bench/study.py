"""A study that `hippodrome run` runs, and visitors who open its pages."""

from __future__ import annotations

import contextlib
import gzip
import html
import http.client
import json
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import hippodrome

ROOT = Path(hippodrome.__file__).resolve().parents[1]
"""The tree that is measured."""
PATIENCE = 60.0  # seconds to wait for anything
ANSWERS: Mapping[str, Mapping[str, object]] = {  # of a participant of the example study, by step
    "1": {"adult": "yes", "consent": "yes"},
    "2": {"age": "33", "games": "weekly"},
    "4": {"fun": 4, "control": 5, "learned": 3, "effort": 4, "trouble": "no", "notes": "The ghosts were fast. " * 5},
}
GAME = """
project:
  id: bench
  live: true
  maxRuntime: 10
  steps: {1: hello, 2: game, finalStep: end}
  events: {startServerStep: 2}
"""
"""The project of a study with a page before and after its game; a measure adds more keys, and `trial`."""


def copy_example(folder: Path) -> None:
    """Copy the example study into the folder."""
    for name in ("config.yml", "agent.py"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(ROOT / "steps", folder / "steps")


def write_game(folder: Path, config: str, agent: str) -> None:
    """Write a study with a page, a game and a last page into the folder."""
    (folder / "config.yml").write_text(GAME + config, encoding="utf-8")
    (folder / "agent.py").write_text(agent, encoding="utf-8")
    shutil.copy(ROOT / "agent.py", folder / "example.py")
    (folder / "steps").mkdir()
    (folder / "steps/hello.html").write_text("<h1>Hello</h1><input name=word><button>Go on</button>", encoding="utf-8")
    (folder / "steps/end.html").write_text("<h1>The end</h1>", encoding="utf-8")


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    """Make a folder for the block."""
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        yield Path(name)


@contextlib.contextmanager
def running(study: Path) -> Iterator[str]:
    """Run the study in this folder within the block; give the address of its site."""
    command = [sys.executable, "-u", "-m", "hippodrome", "run", ".", "--port", "0"]
    with subprocess.Popen(command, cwd=study, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            assert process.stdout is not None
            output = ""
            while not (address := re.search(r"http://127\.0\.0\.1:\d+", output)):
                line = process.stdout.readline()
                if not line:
                    raise RuntimeError(f"the study did not start: {output}")
                output += line
            threading.Thread(target=process.stdout.read, daemon=True).start()  # so that the pipe never fills
            yield address[0]
        finally:
            process.send_signal(signal.SIGTERM)


class Visitor:
    """A participant's browser without a screen, with one connection. `waits` has the seconds of each request."""

    def __init__(self, address: str, project: str, user: str) -> None:
        url = urlsplit(address)
        self._line = http.client.HTTPConnection(str(url.hostname), url.port, timeout=PATIENCE)
        self.target = f"/next?projectId={project}&userId={user}"
        self.waits: list[float] = []
        self.page = ""
        self.weight = 0  # the bytes of the page, as they came

    def open(self) -> str:
        """Open the link; return the step of the page, `final` for the last one."""
        self.page = self._ask("GET").decode()
        step = re.search(r'name="hippodrome-step" value="([^"]*)"', self.page)
        return step[1] if step else "final"

    def answer(self, fields: Mapping[str, object]) -> None:
        """Submit the form of the page with these answers."""
        hidden = re.findall(r'<input type="hidden" name="([^"]+)" value="([^"]*)"', self.page)
        sent = {**{name: html.unescape(value) for name, value in hidden}, **fields}
        self._ask("POST", body=urlencode(sent), status=303)

    def poll(self, step: str) -> dict[str, Any]:
        """Ask what the waiting page of the game asks."""
        state: dict[str, Any] = json.loads(self._ask("GET", f"&poll={step}", accept="application/json"))
        return state

    def _ask(
        self, method: str, more: str = "", *, body: str | None = None, accept: str = "text/html", status: int = 200
    ) -> bytes:
        headers = {"Accept": accept, "Accept-Encoding": "gzip"}
        if body is not None:
            headers["Content-Type"] = "application/x-www-form-urlencoded"
        begun = time.perf_counter()
        self._line.request(method, self.target + more, body, headers)
        response = self._line.getresponse()
        raw = response.read()
        self.waits.append(time.perf_counter() - begun)
        self.weight = len(raw)
        if response.status != status:
            raise RuntimeError(f"{method} was answered with {response.status}: {raw[:300]!r}")
        return gzip.decompress(raw) if response.headers.get("Content-Encoding") == "gzip" else raw
