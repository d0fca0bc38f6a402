"""Simulated participants: they open the link, answer each page, wait for the game, play at random, and read their code.

A bot does what a browser does, over HTTP and the WebSocket of docs/wire.md, and keeps an account of it.
"""

from __future__ import annotations

import asyncio
import html
import json
import re
import time
from random import Random
from typing import Any
from urllib.parse import urlencode, urljoin, urlsplit

from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.typing import Subprotocol

from bots import form_filling, forms
from bots.account import BotReport, PlayedStep
from bots.addresses import PORTS, THIS_MACHINE, AllowedAddresses
from bots.game import GameConnection
from bots.http import Reply, ask
from bots.links import with_user
from bots.page import VisitedPage
from trial.pictures.frames import FrameError

SUBPROTOCOLS = [Subprotocol(f"hippodrome.{version}") for version in (3, 2, 1)]
LARGEST_FRAME = 64 * 1024 * 1024

LOBBY, UNMATCHED = "lobby", "unmatched"  # states of the game page (docs/pages.md)
POLL_SECONDS = 0.5
LOBBY_SECONDS = 2.0  # from one poll of the lobby to the next
AGAIN_SECONDS = 0.5  # between tries when there is no answer
RELOADS = 3  # how often a bot tries again on a page of apology
RESTARTS = 3  # how often a bot presses "Try again"
PAGES = 200  # more than any study has


class Failed(Exception):
    """Why a bot cannot go on."""


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
        self.account = BotReport(user_id)
        self._restarts = 0

    async def run(self) -> BotReport:
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

    async def do(self, page: VisitedPage) -> VisitedPage | None:
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

    async def open(self) -> VisitedPage:
        """The page where the participant stands."""
        return VisitedPage(self.address, (await self._ask(self.address)).text)

    async def answer(self, page: VisitedPage, form: forms.Form) -> VisitedPage:
        """Fill in the form, send it, and go where that leads."""
        step = dict(forms.hidden(form)).get("hippodrome-step", page.step)
        if step in self.account.answers:
            raise Failed(f"step {step} was answered, and its page is shown once more")
        self.account.stage = f"answers step {step}"
        pairs = form_filling.fill(form, self.random)
        self.account.answers[step] = form_filling.gathered(pairs)
        return await self.post(urljoin(page.address, form.action or page.address), pairs)

    async def post(self, address: str, pairs: form_filling.Pairs) -> VisitedPage:
        """Send a form and follow the redirect. Sending it twice does no harm."""
        reply = await self._ask(address, urlencode(pairs).encode())
        if reply.status not in (302, 303) or "location" not in reply.headers:
            raise Failed(f"a form was answered with status {reply.status} instead of 303")
        following = urljoin(address, reply.headers["location"])
        return VisitedPage(following, (await self._ask(following)).text)

    async def _ask(self, address: str, body: bytes | None = None) -> Reply:
        """One request, repeated until there is an answer."""
        until, tries = time.monotonic() + self.patience, 0
        complaints: list[str] = []
        while True:
            try:
                reply = await ask(address, body, where=self.where)
            except OSError as error:  # a TimeoutError is one
                if time.monotonic() > until:
                    raise Failed(f"no answer from {_place(address)}: {error}") from error
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

    async def game(self, page: VisitedPage) -> VisitedPage:
        """Wait for the server, play, and go on; the page after the game."""
        data, step = page.game or {}, page.step
        play = PlayedStep(step)
        self.account.plays.append(play)
        until = time.monotonic() + self.patience + self.play
        while True:
            state = await self._ready(page, data, play, until)
            if not play.unmatched:
                await self._connect(state, play)
            page = await self.open()
            data = page.game or {}
            if not data or data.get("step") != step:
                return page
            if play.done or play.unmatched:
                raise Failed(f"the game said that it was {play.outcome or 'done'}, and its page is shown once more")
            if time.monotonic() > until:
                raise Failed("the game does not end")
            await asyncio.sleep(AGAIN_SECONDS)

    async def _ready(self, page: VisitedPage, data: dict[str, Any], play: PlayedStep, until: float) -> dict[str, Any]:
        """Wait for the server as the game page does; its state when it is ready."""
        state, poll = data["state"], urljoin(page.address, data["poll"])
        if state["state"] == LOBBY:
            state = await self._lobby(state, poll, play)
        if state["state"] == UNMATCHED:
            play.unmatched, play.outcome = True, UNMATCHED
            return dict(state)
        self.account.stage = "waits for its server"
        play.members = state.get("members", play.members)
        began, until = time.monotonic(), max(until, time.monotonic() + self.patience + self.play)
        while state["state"] != "ready":
            if time.monotonic() > until:
                raise Failed(f"no server: still {state['state']}")
            if state["state"] in ("ended", "failed"):
                await self._restart(page, state)
            await asyncio.sleep(POLL_SECONDS)
            state = json.loads((await self._ask(poll)).text)
        play.waited += time.monotonic() - began
        return dict(state)

    async def _lobby(self, state: dict[str, Any], poll: str, play: PlayedStep) -> dict[str, Any]:
        """Wait for others to play with, as the lobby's page does; the first state after it."""
        self.account.stage = "waits for others"
        began = time.monotonic()
        until = began + state["patience"] + self.patience
        while state["state"] == LOBBY:
            if time.monotonic() > until:
                raise Failed(f"it waits in the lobby for longer than the {state['patience']:g} s of its patience")
            await asyncio.sleep(POLL_SECONDS if state["proposed"] else LOBBY_SECONDS)
            state = json.loads((await self._ask(poll)).text)
        play.lobby = time.monotonic() - began
        return state

    async def _restart(self, page: VisitedPage, state: dict[str, Any]) -> None:
        form = page.form
        if not state.get("again") or form is None or self._restarts >= RESTARTS:
            raise Failed(f"no server: {state['state']} ({state.get('reason')})")
        self._restarts += 1
        self.account.troubles.append(f"the server was {state['state']} ({state.get('reason')}): started again")
        await self.post(urljoin(page.address, form.action), form_filling.fill(form, self.random))

    async def _connect(self, state: dict[str, Any], play: PlayedStep) -> None:
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
                    raise Failed("the server speaks none of hippodrome.3, hippodrome.2 and hippodrome.1")
                await GameConnection(websocket, play, self.account, self.random, self.play).run(hello)
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
