"""Simulated participants: they open the link, answer each page, wait for the game, play at random, and read their code.

A bot does what a browser does, over HTTP and the WebSocket of docs/wire.md, and keeps an account of it.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import json
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any
from urllib.parse import parse_qsl, urlencode, urljoin, urlsplit, urlunsplit

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.typing import Subprotocol

from bots import form_filling
from bots.addresses import PORTS, THIS_MACHINE, AllowedAddresses
from bots.http import Reply, ask
from trial.frames import Decoder, FrameError

SUBPROTOCOLS = [Subprotocol("hippodrome.2"), Subprotocol("hippodrome.1")]
LARGEST_FRAME = 64 * 1024 * 1024

QUIET_SECONDS = 20.0  # a playing game that shows nothing for so long is taken for lost
POLL_SECONDS = 0.5
AGAIN_SECONDS = 0.5  # between tries when nobody answers
RELOADS = 3  # how often a bot tries again on a page of apology
RESTARTS = 3  # how often a bot presses "Try again"
PAGES = 200  # more than any study has


class Failed(Exception):
    """Why a bot cannot go on."""


def with_project(link: str, project_id: str) -> str:
    """The link of the study, if the address names only the machine."""
    parts = urlsplit(link)
    if parts.path not in ("", "/"):
        return link
    return urlunsplit(parts._replace(path="/next", query=urlencode({"projectId": project_id})))


def with_user(link: str, user_id: str) -> str:
    """A study's link for one participant."""
    parts = urlsplit(link)
    kept = [(name, value) for name, value in parse_qsl(parts.query) if name != "userId"]
    return urlunsplit(parts._replace(query=urlencode([*kept, ("userId", user_id)])))


# What a bot has done


@dataclass
class Play:
    """One game step."""

    step: str
    addresses: list[str] = field(default_factory=list)
    waited: float = 0.0  # seconds on the waiting page
    frames: int = 0  # received, after the first picture of each connection
    frame_rate: int = 0  # as the server says
    seconds: float = 0.0  # of playing, from the first to the last frame
    seen: int = 0  # frames received in these seconds
    bytes: int = 0
    score: float = 0
    episodes: int = 0
    done: bool = False

    @property
    def received_rate(self) -> float | None:
        """Frames per second while playing; None after too short a game."""
        return self.seen / self.seconds if self.seconds >= 1 else None


@dataclass
class Account:
    """What one bot has sent, seen and run into."""

    user_id: str
    stage: str = "waits for its turn"
    finished: bool = False
    answers: dict[str, dict[str, str | list[str]]] = field(default_factory=dict)  # by step
    plays: list[Play] = field(default_factory=list)
    final_page: str = ""
    code: str | None = None
    errors: list[str] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)  # connections lost and the like, which it got over
    seconds: float = 0.0


# Pages


@dataclass(frozen=True)
class Page:
    """A page of the study."""

    address: str
    text: str

    @property
    def game(self) -> dict[str, Any] | None:
        """What the game page was told; None on other pages."""
        found = re.search(r'<script type="application/json" id="data">(.*?)</script>', self.text, re.DOTALL)
        data = json.loads(found[1]) if found else None
        return data if isinstance(data, dict) else None

    @property
    def form(self) -> form_filling.Form | None:
        return form_filling.to_answer(self.text)

    @property
    def step(self) -> str:
        """The key of the step that the page shows."""
        found = re.search(r'<body[^>]*\bdata-step="([^"]*)"', self.text)
        return html.unescape(found[1]) if found else ""

    @property
    def is_last(self) -> bool:
        """Whether the study ends with this page."""
        return re.search(r"<body[^>]*\bdata-done\b", self.text) is not None

    @property
    def code(self) -> str | None:
        """The completion code, where a page shows one as the example does."""
        found = re.search(r'class="code"[^>]*>([^<]+)<', self.text)
        return html.unescape(found[1]).strip() if found else None


# The game


class Hands:
    """Presses keys at random: some are held, some are single presses."""

    def __init__(self, random: Random, controls: dict[str, Any]) -> None:
        self._random = random
        shown: Sequence[str] = controls.get("UI", ())
        self._keys = [key for key in ("left", "right", "up", "down", "fire") if key in shown]
        self._actions = [name for name in controls.get("actionSpace", ()) if name != "noop" and _offered(name, shown)]
        self._words = [word for word in ("good", "bad") if word in shown]
        self._held: list[str] = []

    def move(self) -> list[dict[str, Any]]:
        """The next messages."""
        random = self._random
        said: list[dict[str, Any]] = [{"action": key, "held": False} for key in self._held]
        self._held = []
        if self._keys and random.random() < 0.7:
            self._held = random.sample(self._keys, min(len(self._keys), random.choice((1, 1, 1, 2))))
            said += [{"action": key, "held": True} for key in self._held]
        elif self._actions:
            said.append({"action": random.choice(self._actions)})
        if self._words and random.random() < 0.1:
            said.append({"command": random.choice(self._words)})
        return said


def _offered(action: str, shown: Sequence[str]) -> bool:
    """Whether the page has the keys that make this action; those that are no directions it always has."""
    if re.fullmatch("(up|down|left|right|fire)+", action) is None:
        return True
    return all(key in shown for key in re.findall("up|down|left|right", action))


class Game:
    """One connection to a trial server."""

    def __init__(self, websocket: ClientConnection, play: Play, bot: Bot) -> None:
        self._websocket = websocket
        self._play = play
        self._bot = bot
        self._screen = Decoder()
        self._hands: Hands | None = None
        self._state = ""
        self._first = True
        self._last_frame: float | None = None
        self._may_stop = False
        self._break_seconds = 0.0

    async def run(self, hello: dict[str, Any]) -> None:
        """Play until the server closes. Raises ConnectionClosed, TimeoutError, Failed."""
        await self._say(hello)
        moving: asyncio.Task[None] | None = None
        try:
            while True:
                async with asyncio.timeout(QUIET_SECONDS + self._break_seconds):
                    data = await self._websocket.recv()
                if isinstance(data, bytes):
                    await self._frame(data)
                else:
                    await self._told(json.loads(data))
                if self._hands is not None and moving is None:
                    moving = asyncio.create_task(self._move(self._hands))
        finally:
            if moving is not None:
                moving.cancel()
                await asyncio.wait({moving})

    async def _say(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(ConnectionClosed):  # what came before the end is still to be heard
            await self._websocket.send(json.dumps(message))

    async def _frame(self, data: bytes) -> None:
        frame_id, _ = self._screen.decode(data)
        await self._say({"ack": frame_id})
        play, now = self._play, time.monotonic()
        play.bytes += len(data)
        if not self._first:  # the first picture may be one that an earlier connection has shown
            play.frames += 1
        self._first = False
        if self._state == "playing":
            if self._last_frame is not None:
                play.seen += 1
                play.seconds += now - self._last_frame
            self._last_frame = now
        else:
            self._last_frame = None

    async def _told(self, message: dict[str, Any]) -> None:
        play = self._play
        if "error" in message:
            self._bot.account.troubles.append(f"the game says: {message['error']}")
        if "UI" in message:
            self._hands = Hands(self._bot.random, message)
            self._may_stop = "stop" in message["UI"]
        if message.get("done"):
            play.done, play.score, play.episodes = True, message.get("score", 0), message.get("episodes", 0)
        if "state" in message:
            self._state, play.score = message["state"], message.get("score", 0)
            play.frame_rate = message.get("frameRate", play.frame_rate)
            self._break_seconds = message.get("nextIn", 0.0)
            if self._state in ("ready", "paused", "break"):
                self._last_frame = None
            # Of those who are offered a break, every second one waits for its end.
            if self._state in ("ready", "paused") or (self._state == "break" and self._bot.random.random() < 0.5):
                await self._say({"command": "start"})

    async def _move(self, hands: Hands) -> None:
        while True:
            await asyncio.sleep(self._bot.random.uniform(0.1, 0.5))
            if self._state != "playing":
                continue
            if self._bot.play and self._play.seconds >= self._bot.play and self._may_stop:
                await self._say({"command": "stop"})
                return
            for message in hands.move():
                await self._say(message)


class _Connect(connect):
    """A connection to the very address that was allowed: a redirect is an error, and is not followed."""

    def process_redirect(self, exc: Exception) -> Exception | str:
        return exc


class Bot:
    """One simulated participant. `run` never raises but for being cancelled; `account` tells what happened.

    `play` is for how many seconds it plays where the game may be stopped; 0 plays to the end. `patience` is how many
    seconds it waits for any one thing: an answer, a server, the end of a game.
    """

    def __init__(
        self,
        link: str,
        user_id: str,
        random: Random,
        *,
        play: float = 8.0,
        patience: float = 300.0,
        where: AllowedAddresses = THIS_MACHINE,
    ) -> None:
        self.where = where
        self.address = where.page(with_user(link, user_id))
        self.random = random
        self.play = play
        self.patience = patience
        self.account = Account(user_id)
        self._restarts = 0

    async def run(self) -> Account:
        """Walk through the whole study."""
        account, began = self.account, time.monotonic()
        try:
            page = await self.open()
            for _ in range(PAGES):
                following = await self.do(page)
                if following is None:
                    break
                page = following
            else:
                raise Failed("the study does not end")
        except Failed as failed:
            account.errors.append(str(failed))
            account.stage = "failed"
        except Exception as error:  # noqa: BLE001 - one bot's trouble is not the others'
            account.errors.append(f"{type(error).__name__}: {error}")
            account.stage = "failed"
        account.seconds = time.monotonic() - began
        return account

    async def do(self, page: Page) -> Page | None:
        """What the page asks for; the next page, or None after the last. Raises Failed."""
        if page.game is not None:
            return await self.game(page)
        form = page.form
        if form is not None:
            return await self.answer(page, form)
        if not page.is_last:
            raise Failed(f"no page of a study: {_said(page.text)}")
        self.account.final_page, self.account.code = page.text, page.code
        self.account.finished, self.account.stage = True, "finished"
        return None

    # Pages

    async def open(self) -> Page:
        """The page where the participant stands."""
        return Page(self.address, (await self._ask(self.address)).text)

    async def answer(self, page: Page, form: form_filling.Form) -> Page:
        """Fill in the form, send it, and go where that leads."""
        step = dict(form_filling.hidden(form)).get("hippodrome-step", page.step)
        if step in self.account.answers:
            raise Failed(f"step {step} was answered, and its page is shown once more")
        self.account.stage = f"answers step {step}"
        pairs = form_filling.fill(form, self.random)
        self.account.answers[step] = form_filling.gathered(pairs)
        return await self.post(urljoin(page.address, form.action or page.address), pairs)

    async def post(self, address: str, pairs: form_filling.Pairs) -> Page:
        """Send a form and follow the redirect. Sending it twice does no harm."""
        reply = await self._ask(address, urlencode(pairs).encode())
        if reply.status not in (302, 303) or "location" not in reply.headers:
            raise Failed(f"a form was answered with status {reply.status} instead of 303")
        following = urljoin(address, reply.headers["location"])
        return Page(following, (await self._ask(following)).text)

    async def _ask(self, address: str, body: bytes | None = None) -> Reply:
        """One request, repeated while nobody answers."""
        until, tries = time.monotonic() + self.patience, 0
        complaints: list[str] = []
        while True:
            try:
                reply = await ask(address, body, where=self.where)
            except OSError as error:  # a TimeoutError is one
                if time.monotonic() > until:
                    raise Failed(f"nobody answers at {_place(address)}: {error}") from error
                tries += 1
                if tries == 1:
                    self.account.troubles.append(f"no answer at {_place(address)}: {error or type(error).__name__}")
                await asyncio.sleep(AGAIN_SECONDS)
                continue
            if reply.status < 400:
                self.account.troubles += dict.fromkeys(complaints)
                return reply
            complaints.append(f"status {reply.status} {self._where()}: {_said(reply.text)}")
            if reply.status < 500 or len(complaints) > RELOADS:
                self.account.troubles += [each for each in dict.fromkeys(complaints) if each != complaints[-1]]
                raise Failed(complaints[-1])
            await asyncio.sleep(AGAIN_SECONDS)

    def _where(self) -> str:
        """Which page of the study it asks for, as far as a participant can know."""
        done = [*self.account.answers, *(play.step for play in self.account.plays if play.done)]
        return f"on the page after step {done[-1]}" if done else "on the first page"

    # The game

    async def game(self, page: Page) -> Page:
        """Wait for the server, play, and go on; the page after the game."""
        data, step = page.game or {}, page.step
        play = Play(step)
        self.account.plays.append(play)
        until = time.monotonic() + self.patience + self.play
        while True:
            await self._connect(await self._ready(page, data, play, until), play)
            page = await self.open()
            data = page.game or {}
            if not data or data.get("step") != step:
                return page
            if play.done:
                raise Failed("the game said that it was done, and its page is shown once more")
            if time.monotonic() > until:
                raise Failed("the game does not end")
            await asyncio.sleep(AGAIN_SECONDS)

    async def _ready(self, page: Page, data: dict[str, Any], play: Play, until: float) -> dict[str, Any]:
        """Wait for the server as the game page does; its state when it is ready."""
        self.account.stage = "waits for its server"
        began, state, poll = time.monotonic(), data["state"], urljoin(page.address, data["poll"])
        while state["state"] != "ready":
            if time.monotonic() > until:
                raise Failed(f"no server: still {state['state']}")
            if state["state"] in ("ended", "failed"):
                await self._restart(page, state)
            await asyncio.sleep(POLL_SECONDS)
            state = json.loads((await self._ask(poll)).text)
        play.waited += time.monotonic() - began
        return dict(state)

    async def _restart(self, page: Page, state: dict[str, Any]) -> None:
        form = page.form
        if not state.get("again") or form is None or self._restarts >= RESTARTS:
            raise Failed(f"no server: {state['state']} ({state.get('reason')})")
        self._restarts += 1
        self.account.troubles.append(f"the server was {state['state']} ({state.get('reason')}): started again")
        await self.post(urljoin(page.address, form.action), form_filling.fill(form, self.random))

    async def _connect(self, state: dict[str, Any], play: Play) -> None:
        """Play on one connection until it ends."""
        self.account.stage = "plays"
        address = self.where.server(state["url"])
        parts = urlsplit(address)
        host, port = self.where.dial(parts.hostname or "", parts.port or PORTS[parts.scheme])
        if address not in play.addresses:
            play.addresses.append(address)
        hello = {"userId": self.account.user_id, "token": state["token"], "step": play.step}
        try:
            async with (
                asyncio.timeout(self.patience + self.play),
                _Connect(
                    address,
                    host=host,
                    port=port,
                    ssl=self.where.tls if parts.scheme == "wss" else None,
                    subprotocols=SUBPROTOCOLS,
                    compression=None,
                    max_size=LARGEST_FRAME,
                    proxy=None,
                    close_timeout=2,
                ) as websocket,
            ):
                if websocket.subprotocol not in SUBPROTOCOLS:
                    raise Failed("the server speaks neither hippodrome.2 nor hippodrome.1")
                await Game(websocket, play, self).run(hello)
        except ConnectionClosed as closed:
            code = closed.rcvd.code if closed.rcvd else 1006
            if code >= 4400:
                raise Failed(f"the server closed with {code} {closed.rcvd.reason if closed.rcvd else ''}") from closed
            if not play.done:
                self.account.troubles.append(f"the game's connection ended with {code}")
        except FrameError as error:
            self.account.errors.append(str(error))
        except (OSError, WebSocketException) as error:
            self.account.troubles.append(f"the game's connection failed: {error or type(error).__name__}")


def _place(address: str) -> str:
    parts = urlsplit(address)
    return f"{parts.netloc}{parts.path}"


def _said(page: str) -> str:
    """The words of a page, shortened."""
    text = re.sub(r"<(style|script)\b.*?</\1>|<[^>]*>", " ", page, flags=re.DOTALL)
    return " ".join(html.unescape(text).split())[:200]
