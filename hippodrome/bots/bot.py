"""Simulated participants: they open the link, answer each page, wait for the game, play at random, and read their code.

A bot sends what a browser sends, over HTTP and the WebSocket of docs/wire.md, and writes a report (`BotReport`).
"""

from __future__ import annotations

import asyncio
import html
import json
import re
import time
from collections.abc import Mapping
from random import Random
from typing import Any
from urllib.parse import urlencode, urljoin, urlsplit

from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.typing import Subprotocol

from hippodrome.bots import form_filling, forms
from hippodrome.bots.addresses import PORTS, THIS_MACHINE, AllowedAddresses
from hippodrome.bots.game import GameConnection
from hippodrome.bots.http import BROWSER, Reply, ask
from hippodrome.bots.links import with_user
from hippodrome.bots.page import VisitedPage
from hippodrome.bots.report import BotReport, PlayedStep
from hippodrome.bots.steering import BROWSERS, Steering
from hippodrome.control.config.project_keys import MAX_STEPS
from hippodrome.trial.pictures.frames import FrameError

SUBPROTOCOL = Subprotocol("hippodrome")
DECODES = ("deflate", "jpeg", "objects")
MAX_FRAME_BYTES = 64 * 1024 * 1024

LOBBY, UNMATCHED, ENDED = "lobby", "unmatched", "ended"  # states of the game page (docs/pages.md)
POLL_SECONDS = 0.5  # between two polls for the server's state
LOBBY_SECONDS = 2.0  # between two polls of the lobby
RETRY_SECONDS = 0.5  # between two tries of a request that failed
MAX_RELOADS = 3  # further tries of a request after a status of 500 or more
MAX_RESTARTS = 3  # times that a bot presses "Try again" after its server has ended
MAX_PAGES = MAX_STEPS + 1  # the numbered steps and finalStep
KNOWN = 0.8  # how often a bot gives the right answers of a check


class Failed(Exception):
    """A bot cannot go on; `str()` says why."""


class _Connect(connect):
    """A WebSocket connection that does not follow redirects: only this address was allowed. A redirect is an error."""

    def process_redirect(self, exc: Exception) -> Exception | str:
        return exc


class Bot:
    """One simulated participant. `run` sends it through the study, and `report` says what happened.

    After `play` seconds of a game the bot stops the game, if its controls have "stop"; with 0 it plays to the end.
    `patience` is how many seconds the bot waits for one thing: for a response, a server, or the end of a game.
    `allowed` are the addresses that it may send requests to. Raises AddressRefused if the link is none of them.
    `right` are the right answers of checks, by step and field: of five answers the bot gives four that are right. With
    `steering` it gives the answers that lead where that says.
    """

    def __init__(
        self,
        link: str,
        user_id: str,
        random: Random,
        *,
        play: float = 8.0,
        patience: float = 300.0,
        allowed: AllowedAddresses = THIS_MACHINE,
        right: Mapping[str, Mapping[str, str]] | None = None,
        steering: Steering | None = None,
    ) -> None:
        self.allowed = allowed
        self.address = allowed.page(with_user(link, user_id))
        self.random = random
        self.play = play
        self.patience = patience
        self.report = BotReport(user_id)
        self._right = right or {}
        self._steering = steering
        self._browser = BROWSERS.get(steering.participant.get("device", ""), BROWSER) if steering else BROWSER
        self._restarts = 0

    async def run(self) -> BotReport:
        """Walk through the whole study and return the report.

        A failure is written into the report, and not raised.
        """
        report, began = self.report, time.monotonic()
        try:
            page = await self.open()
            for _ in range(MAX_PAGES):
                following = await self.do(page)
                if following is None:
                    break
                page = following
            else:
                raise Failed(f"the study does not end: after {MAX_PAGES} pages there is another one")
        except Failed as failed:
            report.errors.append(str(failed))
            report.stage = "failed"
        except Exception as error:  # noqa: BLE001 - the other bots go on
            report.errors.append(f"{type(error).__name__}: {error}")
            report.stage = "failed"
        report.seconds = time.monotonic() - began
        return report

    async def do(self, page: VisitedPage) -> VisitedPage | None:
        """Answer the page or play its game, and return the next page. Raises Failed.

        Return None after the last page, and after one that has no button to press: it may screen participants out.
        """
        if page.end:
            self.report.end, self.report.stage = page.end, "ended"
            return None
        if page.game is not None:
            return await self.game(page)
        form = page.form
        if form is not None and form.can_be_sent:
            return await self.answer(page, form)
        if form is not None:
            self.report.ended, self.report.stage = page.step, "ended"
            return None
        if not page.is_last:
            raise Failed(f"no page of a study: {_words(page.text)}")
        self.report.final_page, self.report.code = page.text, page.code
        self.report.finished, self.report.stage = True, "finished"
        return None

    # Pages

    async def open(self) -> VisitedPage:
        """Open the participant's link and return the page of the step that is due. Raises Failed."""
        return VisitedPage(self.address, (await self._ask(self.address)).text)

    async def answer(self, page: VisitedPage, form: forms.Form) -> VisitedPage:
        """Fill in the form, send it, and return the page after it. Raises Failed if the step was answered before."""
        step = dict(forms.hidden(form)).get("hippodrome-step", page.step)
        right = self._right.get(step, self._right.get(step.partition("-")[0], {}))
        if step in self.report.answers and not right:
            raise Failed(f"step {step} was answered, and its page is shown once more")
        self.report.stage = f"answers step {step}"
        await asyncio.sleep(page.least_seconds)
        pairs = form_filling.fill(form, self.random)
        if self._steering:
            pairs = self._steering.fill(step, form, pairs)
        elif self.random.random() < KNOWN:
            pairs = [(name, right.get(name, value)) for name, value in pairs]
            pairs += [(name, value) for name, value in right.items() if name not in dict(pairs)]
        self.report.answers[step] = form_filling.gathered(pairs)
        return await self.post(urljoin(page.address, form.action or page.address), pairs)

    async def post(self, address: str, pairs: form_filling.Pairs) -> VisitedPage:
        """Send a form, follow the redirect, and return its page. Raises Failed if the response is no redirect.

        A form may be sent twice, since Hippodrome keeps the first answer.
        """
        reply = await self._ask(address, urlencode(pairs).encode())
        if reply.status not in (302, 303) or "location" not in reply.headers:
            raise Failed(f"a form was answered with status {reply.status} instead of 303")
        following = urljoin(address, reply.headers["location"])
        return VisitedPage(following, (await self._ask(following)).text)

    async def _ask(self, address: str, body: bytes | None = None) -> Reply:
        """Send one request, again after a failure, and return the first response with a status below 400.

        Raises Failed if there is no response within `patience`, after MAX_RELOADS further tries with a status of
        500 or more, and at once after a status from 400 to 499.
        """
        until, tries = time.monotonic() + self.patience, 0
        complaints: list[str] = []
        while True:
            try:
                reply = await ask(address, body, allowed=self.allowed, browser=self._browser)
            except OSError as error:  # a TimeoutError is one
                complaint = f"no answer from {_without_query(address)}: {_reason(error)}"
                if time.monotonic() > until:
                    raise Failed(complaint) from error
                tries += 1
                if tries == 1:
                    self.report.troubles.append(complaint)
                await asyncio.sleep(RETRY_SECONDS)
                continue
            if reply.status < 400:
                self.report.troubles += dict.fromkeys(complaints)
                return reply
            complaints.append(f"status {reply.status} {self._current_page()}: {_words(reply.text)}")
            if reply.status < 500 or len(complaints) > MAX_RELOADS:
                self.report.troubles += [
                    complaint for complaint in dict.fromkeys(complaints) if complaint != complaints[-1]
                ]
                raise Failed(complaints[-1])
            await asyncio.sleep(RETRY_SECONDS)

    def _current_page(self) -> str:
        """Names the page that the bot asks for, by the last step that it has finished."""
        done = [*self.report.answers, *(play.step for play in self.report.plays if play.done)]
        return f"on the page after step {done[-1]}" if done else "on the first page"

    # The game

    async def game(self, page: VisitedPage) -> VisitedPage:
        """Wait for the server, play, and return the page after the game. Raises Failed."""
        data, step = page.game or {}, page.step
        play = PlayedStep(step)
        self.report.plays.append(play)
        until = time.monotonic() + self.patience + self.play
        while True:
            state = await self._ready(page, data, play, until)
            if state["state"] == ENDED:  # matched; whoever plays together has an order of their own
                page = await self.open()
                data = page.game or {}
                play.step = step = data.get("step", step)
                continue
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
            await asyncio.sleep(RETRY_SECONDS)

    async def _ready(self, page: VisitedPage, data: dict[str, Any], play: PlayedStep, until: float) -> dict[str, Any]:
        """Wait for the server as the game page does.

        Return the state in which it is ready, `unmatched`, or `ended` if the page is to be loaded again.
        """
        state, poll = data["state"], urljoin(page.address, data["poll"])
        if state["state"] == LOBBY:
            state = await self._lobby(state, poll, play)
            if state["state"] == ENDED:
                return dict(state)
        if state["state"] == UNMATCHED:
            play.unmatched, play.outcome = True, UNMATCHED
            return dict(state)
        self.report.stage = "waits for its server"
        play.members = state.get("members", play.members)
        began, until = time.monotonic(), max(until, time.monotonic() + self.patience + self.play)
        while state["state"] != "ready":
            if time.monotonic() > until:
                raise Failed(f"the server is not ready in time: its state is still {state['state']}")
            if state["state"] in ("ended", "failed"):
                await self._restart(page, state)
            await asyncio.sleep(POLL_SECONDS)
            state = json.loads((await self._ask(poll)).text)
        play.waited += time.monotonic() - began
        return dict(state)

    async def _lobby(self, state: dict[str, Any], poll: str, play: PlayedStep) -> dict[str, Any]:
        """Wait for other participants as the lobby's page does; return the first state after the lobby."""
        self.report.stage = "waits for others"
        began = time.monotonic()
        until = began + state["patience"] + self.patience
        while state["state"] == LOBBY:
            if time.monotonic() > until:
                raise Failed(f"it waits in the lobby for longer than the study's {state['patience']:g} s of patience")
            await asyncio.sleep(POLL_SECONDS if state["proposed"] else LOBBY_SECONDS)
            state = json.loads((await self._ask(poll)).text)
        play.lobby = time.monotonic() - began
        return state

    async def _restart(self, page: VisitedPage, state: dict[str, Any]) -> None:
        """Press "Try again" on the page of a server that has ended or failed. Raises Failed if that is not offered."""
        form = page.form
        if not state.get("again") or form is None or self._restarts >= MAX_RESTARTS:
            raise Failed(f"there is no server: the last one was {state['state']} ({state.get('reason')})")
        self._restarts += 1
        self.report.troubles.append(f"the server was {state['state']} ({state.get('reason')}): started again")
        again = [*forms.hidden(form), ("hippodrome-action", "restart")]
        await self.post(urljoin(page.address, form.action), again)

    async def _connect(self, state: dict[str, Any], play: PlayedStep) -> None:
        """Connect to the server and play until the connection ends. Raises Failed if the server refuses the bot."""
        self.report.stage = "plays"
        address = self.allowed.server(state["url"])
        parts = urlsplit(address)
        host, port = self.allowed.dial(parts.hostname or "", parts.port or PORTS[parts.scheme])
        if address not in play.addresses:
            play.addresses.append(address)
        hello = {"userId": self.report.user_id, "token": state["token"], "step": play.step, "decodes": DECODES}
        try:
            async with (
                asyncio.timeout(self.patience + self.play),
                _Connect(
                    address,
                    host=host,
                    port=port,
                    ssl=self.allowed.tls if parts.scheme == "wss" else None,
                    subprotocols=[SUBPROTOCOL],
                    compression=None,
                    max_size=MAX_FRAME_BYTES,
                    proxy=None,
                    close_timeout=2,
                ) as websocket,
            ):
                if websocket.subprotocol != SUBPROTOCOL:
                    raise Failed(f"the server does not speak the subprotocol {SUBPROTOCOL}")
                await GameConnection(websocket, play, self.report, self.random, self.play).run(hello)
        except ConnectionClosed as closed:
            code = closed.rcvd.code if closed.rcvd else 1006
            if code >= 4400:
                raise Failed(f"the server closed with {code} {closed.rcvd.reason if closed.rcvd else ''}") from closed
            if not play.done:
                self.report.troubles.append(f"the game's connection ended with {code}")
        except FrameError as error:
            self.report.errors.append(str(error))
        except (OSError, WebSocketException) as error:
            self.report.troubles.append(f"the game's connection failed: {_reason(error)}")


def _reason(error: Exception) -> str:
    """The error's text; its type if it has none, as a TimeoutError."""
    return str(error) or type(error).__name__


def _without_query(address: str) -> str:
    parts = urlsplit(address)
    return f"{parts.netloc}{parts.path}"


def _words(page: str) -> str:
    """The text of a page without its markup: its first 200 characters."""
    text = re.sub(r"<(style|script)\b.*?</\1>|<[^>]*>", " ", page, flags=re.DOTALL)
    return " ".join(html.unescape(text).split())[:200]
