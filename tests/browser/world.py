"""A fake control plane and a fake trial server for the page in the browser, and what the tests of pages share."""

from __future__ import annotations

import json
import re
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import msgspec
import pytest
from websockets.sync.server import serve
from websockets.typing import Subprotocol

from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from hippodrome.control.participants import frame, pages
from testing.processes import ROOT
from testing.waiting import until

SHOTS = ROOT / "shots"
PATIENCE = 45_000  # ms
FLAWS = (Path(__file__).parent / "flaws.js").read_text()
MODULES = re.compile(r'(<script type="module" nonce="[^"]*")>.*?(</script>)', re.DOTALL)
NOWHERE = "ws://127.0.0.1:9/"  # no server listens there
PROJECT = Project(
    id="demo",
    name="Demo",
    steps=[Step("1", "a"), Step("2", "b"), Step("3", "game"), Step("4", "end")],
    researcher="Ada",
)
RED, BLUE = bytes((255, 0, 0)), bytes((0, 0, 255))
OLD_BROWSERS = {
    "Firefox before 113": "delete window.DecompressionStream",
    "Safari before 15": "delete window.DecompressionStream; delete window.createImageBitmap",
    "Chrome before 103": """const Newer = window.DecompressionStream;
        window.DecompressionStream = function (format) {
            if (format === "deflate-raw") throw new TypeError("unsupported format");
            return new Newer(format);
        }""",
}
"""What makes Chromium lack what these browsers lack, as scripts."""
LAST_PICTURE = 4_000  # ms for which the page shows it at the end, as hippodrome/web/game/overlay.js has it


def pack(frame_id: int, pixels: bytes, last: bytes | None = None) -> bytes:
    """Return a frame of 2 by 2 pixels."""
    body = pixels if last is None else bytes(a ^ b for a, b in zip(pixels, last, strict=True))
    deflate = zlib.compressobj(6, zlib.DEFLATED, -15)
    return struct.pack("!BIHHB", last is not None, frame_id, 2, 2, 3) + deflate.compress(body) + deflate.flush()


PLAYING = {"state": "playing", "episode": 1, "score": 70, "frameRate": 30}


@dataclass
class World:
    """A fake control plane, which shows the pages that a test sets, and a fake trial server, which notes what it receives."""

    step: int = 0
    source: str = "<p>Hi</p>"
    state: dict[str, Any] = field(default_factory=lambda: {"state": "queued", "seconds": 0, "attempt": 1})
    posts: list[dict[str, str]] = field(default_factory=list)
    received: list[dict[str, Any]] = field(default_factory=list)
    connections: list[Any] = field(default_factory=list)
    slow: float = 0.0
    may_answer: threading.Event = field(default_factory=threading.Event)
    """Forms are answered once this is set."""
    joined: bool = True
    """Whether the game page carries its script, or loads its modules one by one."""
    trial: dict[str, Any] = field(default_factory=dict)
    """The section `trial` of the study."""
    more: dict[str, Any] = field(default_factory=dict)
    """Other fields of the project."""
    closed: bool = False
    """Whether the study is closed."""
    polls: list[float] = field(default_factory=list)
    """The times (monotonic) at which the page has asked for the state."""
    texts: dict[str, str] = field(default_factory=dict)
    """The pages that the game page shows, by the key that names each."""
    controls: dict[str, Any] = field(default_factory=dict)
    """Fields of the trial server's first message that differ from the usual."""
    trial_state: dict[str, Any] = field(default_factory=lambda: PLAYING)
    """What the trial server answers to `requestUI`."""
    started: dict[str, Any] = field(default_factory=lambda: PLAYING)
    """What the trial server answers to `start`."""
    before_pictures: Callable[[], object] = lambda: None
    """What the trial server waits for between its first message and the first picture."""
    named: bool = True
    """Whether servers have names; else a page may reach the one server that is ready when the page is loaded."""
    ahead: float = 0.0
    """Seconds by which the control plane's clock is ahead of the browser's."""
    refusal: str = ""
    """What the trial server says instead if the game cannot begin on it."""
    url: str = ""
    game_url: str = ""

    def page(self) -> frame.Page:
        step = PROJECT.steps[self.step]
        if step.type.on_server:
            study = msgspec.structs.replace(PROJECT, trial=self.trial, **self.more)
            texts: dict[str, tuple[str, dict[str, Any]]] = {key: (text, {}) for key, text in self.texts.items()}
            sources = "ws://127.0.0.1:*" if self.named else self.state.get("url", "").rstrip("/")
            view = pages.GameView(study, step, "P1", self.state, "/?poll=1", "/", "T", sources, texts)
            page = pages.game_page(view)
            return page if self.joined else page._replace(html=MODULES.sub(r'\1 src="/game/main.js">\2', page.html))
        return pages.step_page(pages.StepView(PROJECT, step, "P1", self.source, {}, "T", "/", self.step == 3))

    def ready(self) -> None:
        self.state = {**self.state, "state": "ready", "url": self.game_url, "token": "TOKEN", "userId": "P1"}

    def commands(self, name: str) -> list[Any]:
        return [each[name] for each in list(self.received) if name in each]

    def player_commands(self) -> list[str]:
        """Return the participant's commands, without `requestUI`, which a page sends by itself when it hears nothing."""
        return [command for command in self.commands("command") if command != "requestUI"]

    def wait_for(self, message: dict[str, Any]) -> None:
        end = time.monotonic() + PATIENCE / 1000
        while message not in self.received:
            assert time.monotonic() < end, self.received
            time.sleep(0.02)

    # the trial server

    def play(self, connection: Any) -> None:
        self.connections.append(connection)
        assert connection.subprotocol == "hippodrome"
        controls = {
            "UI": ["left", "right", "up", "down", "start", "pause", "reset"],
            "actionSpace": ["noop", "fire", "left", "right", "upleft"],
            "frameRate": 30, "minFrameRate": 1, "maxFrameRate": 60, "allowFrameRateChange": False,
            "state": "ready", "episode": 1, "maxEpisodes": 2, "score": 0, **self.controls,
        }  # fmt: skip
        for text in connection:
            message = json.loads(text)
            self.received.append(message)
            if "token" in message and self.refusal:
                connection.send(json.dumps({"error": self.refusal}))
                connection.close(1011)
            elif "token" in message:
                connection.send(json.dumps(controls))
                self.before_pictures()
                connection.send(pack(1, RED * 4))
                connection.send(pack(2, BLUE * 4, RED * 4))
            elif message.get("command") == "requestUI":
                connection.send(json.dumps(self.trial_state))
            elif message.get("command") == "start":
                self.trial_state = self.started
                connection.send(json.dumps(self.started))
            elif message.get("command") == "pause":
                connection.send(json.dumps({"state": "paused", "episode": 1, "score": 70, "frameRate": 30}))


@pytest.fixture
def world() -> Iterator[World]:
    here = World()
    here.may_answer.set()

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

        def date_time_string(self, timestamp: float | None = None) -> str:
            return super().date_time_string(time.time() + here.ahead)

        def reply(self, status: int, kind: str, body: str, headers: dict[str, str]) -> None:
            self.send_response(status)
            for name, value in {"Content-Type": kind, **headers}.items():
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body.encode())

        def do_GET(self) -> None:
            if "poll" in self.path:
                here.polls.append(time.monotonic())
                time.sleep(here.slow)
                self.reply(400 if here.closed else 200, "application/json", json.dumps(here.state), {})
            elif here.closed:
                self.reply(404, "text/html; charset=utf-8", "<h1>Study not found</h1>", {})
            else:
                page = here.page()
                self.reply(200, "text/html; charset=utf-8", page.html, page.headers)

        do_HEAD = do_GET

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"])).decode()
            time.sleep(here.slow)
            here.may_answer.wait(PATIENCE / 1000)
            here.posts.append(dict(parse_qsl(body, keep_blank_values=True)))
            action = here.posts[-1].get("hippodrome-action")
            if action == "leave":
                return self.reply(204, "text/plain", "", {})
            here.step += action != "restart"
            self.reply(303, "text/plain", "", {"Location": "/"})

    web = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    game = serve(
        lambda connection: here.play(connection),  # noqa: PLW0108 - a test may put another `play` there
        "127.0.0.1",
        0,
        subprotocols=[Subprotocol("hippodrome")],
    )
    here.url = f"http://127.0.0.1:{web.server_port}/"
    here.game_url = f"ws://127.0.0.1:{game.socket.getsockname()[1]}/"
    threads = [threading.Thread(target=server.serve_forever, daemon=True) for server in (web, game)]
    for thread in threads:
        thread.start()
    yield here
    web.shutdown()
    web.server_close()
    game.shutdown()


def shot(tab: Any, name: str) -> None:
    """A picture of the page, for people to look at."""
    SHOTS.mkdir(exist_ok=True)
    tab.screenshot(path=SHOTS / f"{name}.png", full_page=True)


def play(world: World, tab: Any) -> None:
    world.step = 2
    world.ready()
    tab.goto(world.url)
    tab.wait_for_selector("#overlay-button:visible")


def tell(world: World, **said: Any) -> None:
    said = {"frameRate": 30, "episode": 1, "score": 70, "episodeScore": 30, **said}
    if "state" in said:
        # Times would have passed until the page asks: then nothing has changed.
        world.trial_state = {} if said.keys() & {"nextIn", "startsIn", "timeLeft", "turnEndsIn"} else said
    until(lambda: world.connections)  # the page shows the game before it is connected
    world.connections[0].send(json.dumps(said))


def deflated_zeros(number: int) -> bytes:
    """Compressed data that unpack to so many zeros. Each megabyte is complete by itself, so only one has to be compressed."""
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    megabytes, rest = divmod(number, 1 << 20)
    megabyte = deflate.compress(bytes(1 << 20)) + deflate.flush(zlib.Z_FULL_FLUSH)
    return megabyte * megabytes + deflate.compress(bytes(rest)) + deflate.flush()


def wait_for_reconnection(world: World, tab: Any) -> None:
    """Wait until the page has closed its connection and plays on another."""
    end = time.monotonic() + 60
    while len(world.connections) < 2:
        assert time.monotonic() < end
        tab.wait_for_timeout(50)
    tab.wait_for_selector("#overlay-button:visible")
