"""The server: lets one participant in, hands them their trial, and ends when it is over or nobody comes.

A warm server does not know yet who that is: it lets nobody in and waits, until it is told (`trial/warm.py`).
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import http
import json
import logging
import os
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import Server as WebSocketServer
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from protocol import exits
from trial import messages, warm
from trial.agent import Player
from trial.certificate import RELOAD_SECONDS, Certificate
from trial.connection import SUBPROTOCOLS, Link
from trial.game import Refused
from trial.messages import BadMessage, NotAMessage
from trial.preauth_limit import Door
from trial.run import Trial
from trial.settings import Settings
from trial.spool import Spool, store_file
from trial.store import Store, open_store
from trial.tracebacks import report
from trial.watchdog import Watchdog
from trial.worker import Stuck, Worker

log = logging.getLogger("trial")

LARGEST_MESSAGE = 4096
MESSAGES_A_SECOND = 200
STRANGERS = 64
"""Connections that have not authenticated yet (`preauth_limit.py`) and speak WebSocket; one more closes the oldest."""
SHUT_MARGIN = 10.0
"""Storing what was recorded gives up so long before whoever asked the server to end kills it."""
HARD_MARGIN = 4.0
"""The same for ending in any case."""
TELL_SECONDS = 5.0
"""A trial that cannot begin is told to whoever comes within so long; then the process ends, to be replaced."""
_TOLD_SECONDS = 0.3  # the same once somebody was told
_CLOSE_SECONDS = 2.0
_STRANGER = "that token does not open this game"
_NOT_YET = "The game is not open yet. Please wait: it is tried again."
_SORRY_START = "The game cannot be started at the moment. Please wait: it is tried again."


class Closing(Exception):
    """The connection is to be closed with this code; the words are told before."""

    def __init__(self, code: int, words: str) -> None:
        super().__init__(words)
        self.code = code
        self.words = words


class Flood:
    """Counts messages by the second. Pure."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._since = 0.0
        self._count = 0

    def too_many(self, now: float) -> bool:
        """Count one message; whether it is one too many."""
        if now - self._since >= 1.0:
            self._since, self._count = now, 0
        self._count += 1
        return self._count > self._limit


class Server:
    """One participant's server. `run` returns the process's exit status."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._store: Store
        self._spool: Spool
        self._worker = Worker()
        self._player = Player(settings.agent_dir, settings.trial.game, settings.trial.action_space)
        self._agent: asyncio.Task[bool]
        self._trial: Trial | None = None
        self._failure = 1  # the exit status if it ends because it cannot go on
        self._done: set[str] = set()
        self._search: warm.Search
        self._door: Door
        self._strangers: dict[ServerConnection, None] = {}
        self._links: dict[Link, asyncio.Task[None]] = {}
        self._termination: asyncio.Future[str]
        self._watchdog_timer: asyncio.TimerHandle | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def run(self) -> int:
        """Serve until the trial is over, nobody comes, the deadline is there, or `end` is called."""
        settings, loop = self.settings, asyncio.get_running_loop()
        self._termination = loop.create_future()
        # The clock of the deadline is the wall's; everything else counts seconds of the loop's clock.
        deadline = None if settings.deadline is None else loop.time() + settings.deadline - time.time()
        self._watchdog = Watchdog(
            now=None if settings.warm_server else loop.time(),
            idle=settings.idle_seconds,
            grace=settings.grace_seconds,
            deadline=deadline,
        )
        self._store = await asyncio.to_thread(open_store, settings.store, settings.server, settings.credential)
        self._spool = await asyncio.to_thread(Spool, settings, self._store)
        certificate = None
        if settings.tls:
            certificate = Certificate(settings, self._store)
            await asyncio.to_thread(certificate.load)
        self._door = Door(settings.host, settings.port)
        server = await serve(
            self._connected,
            sock=self._door,
            open_timeout=settings.hello_seconds,
            ssl=certificate.context if certificate is not None else None,
            ssl_handshake_timeout=settings.hello_seconds if certificate is not None else None,
            subprotocols=[Subprotocol(name) for name in SUBPROTOCOLS],
            select_subprotocol=_subprotocol,
            process_request=_answer_plain_http,
            server_header=None,
            compression=None,
            max_size=LARGEST_MESSAGE,
            write_limit=(1, 0),  # so that sending returns only when nothing is left in the buffer
            ping_interval=15,
            ping_timeout=15,
            close_timeout=_CLOSE_SECONDS,
            logger=_silent(),
        )
        port = server.sockets[0].getsockname()[1]
        print(json.dumps({"port": port}), flush=True)
        log.info("listening on port %d", port)
        self._agent = asyncio.create_task(self._start_agent())
        if settings.warm_server:
            place = warm.key(settings.project_id, settings.server)
            self._search = warm.Search(self._store, place, settings.warm_server_seconds)
            self._keep(self._search.run(self._give))
        else:
            self._keep(self._store_files(await self._leftovers(settings)))
        if certificate is not None:
            self._keep(_renew(certificate))
        self._watch()
        reason = await self._termination
        log.info("ending: %s", reason)
        exit_hard_after(self.settings.stop_seconds - HARD_MARGIN)
        await self._shut(server, reason)
        return self._failure if reason == "error" else 0

    def end(self, reason: str) -> None:
        """Ask the server to end; from the event loop."""
        if not self._termination.done():
            self._termination.set_result(reason)

    @property
    def stuck(self) -> bool:
        """The researcher's code is still running and may never return."""
        return self._worker.busy

    async def _shut(self, server: WebSocketServer, reason: str) -> None:
        if self._watchdog_timer is not None:
            self._watchdog_timer.cancel()
        for task in self._tasks:
            task.cancel()
        words = "the trial is done" if reason == "done" else "the server is going away"
        server.close(code=1001, reason=words)
        if self._trial is not None:
            await self._trial.shut(self.settings.stop_seconds - SHUT_MARGIN)
        if not self._agent.done():
            self._agent.cancel()
        if not self._worker.busy:
            with contextlib.suppress(Exception):  # the game is over; nothing hangs on how the agent ends
                await self._worker.call(self._player.close, limit=_CLOSE_SECONDS)
        self._worker.close()
        for link in self._links:
            link.abort()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(server.wait_closed(), _CLOSE_SECONDS)

    def _keep(self, work: object) -> None:
        task: asyncio.Task[None] = asyncio.create_task(work)  # type: ignore[arg-type]
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _start_agent(self) -> bool:
        try:
            await self._worker.call(self._player.start, limit=self.settings.start_seconds)
        except Exception as error:  # noqa: BLE001 - the researcher's code may raise anything
            settings = self.settings  # as they are now: a warm server may have been given to somebody
            self._failure = exits.LATE_AGENT if isinstance(error, Stuck) else exits.NO_AGENT
            log.error("the agent cannot be started\n%s", report(error, settings.agent_dir, settings.user_id))
            self._end_in(TELL_SECONDS)
            return False
        log.info("the agent is ready")
        return True

    def _end_in(self, seconds: float) -> None:
        """End as a server that could not do its work; another takes its place."""
        asyncio.get_running_loop().call_later(seconds, self.end, "error")

    async def _leftovers(self, settings: Settings) -> list[tuple[str, Path]]:
        """Recordings that an earlier process of this server left. To be asked before it makes any of its own."""
        if not self._spool.keep:
            prefix = f"{settings.project_id}/users/{settings.user_id}/trials/{settings.server}"
            with contextlib.suppress(OSError):
                return await asyncio.to_thread(self._spool.leftovers, prefix)
        return []

    async def _store_files(self, left: list[tuple[str, Path]]) -> None:
        for key, path in left:
            log.warning("storing a recording that an earlier process left")
            await store_file(self._store, key, path)

    async def _give(self, given: warm.Given) -> None:
        """From here on this is the server of that participant, like any other."""
        settings = warm.taken(self.settings, given)
        self._keep(self._store_files(await self._leftovers(settings)))
        warm.tell_agent(os.environ, given)
        self.settings = settings
        self._watchdog.expected(asyncio.get_running_loop().time())
        self._watch()
        log.info("this server is somebody's now")

    # ---- who is connected

    def _watch(self) -> None:
        """Look at the watchdog when it can have something to say, and not before."""
        loop = asyncio.get_running_loop()
        if self._watchdog_timer is not None:
            self._watchdog_timer.cancel()
        verdict = self._watchdog.verdict(loop.time())
        saving = self._trial is not None and self._trial.game.over and not self._trial.finished.is_set()
        if verdict == "deadline" or (verdict == "idle" and not saving):
            self.end(verdict)
            return
        expires = self._watchdog.expires() if verdict is None else loop.time() + 5.0
        if expires < float("inf"):
            # A day at most: the loop refuses to wait for ever.
            self._watchdog_timer = loop.call_at(min(expires + 0.01, loop.time() + 86400), self._watch)

    async def _connected(self, websocket: ServerConnection) -> None:
        self._strangers[websocket] = None
        if len(self._strangers) > STRANGERS:
            oldest = next(iter(self._strangers))
            del self._strangers[oldest]
            oldest.transport.abort()
        try:
            await self._talk(websocket)
        except ConnectionClosed:
            pass
        except Closing as closing:
            try:
                async with asyncio.timeout(2 * _CLOSE_SECONDS):
                    await websocket.send(messages.error(closing.words))
                    await websocket.close(closing.code)
            except (TimeoutError, ConnectionClosed):
                websocket.transport.abort()
        except Exception:
            log.exception("a connection failed")
            await websocket.close(1011)
        finally:
            self._strangers.pop(websocket, None)

    async def _talk(self, websocket: ServerConnection) -> None:
        step = await self._welcome(websocket)
        self._strangers.pop(websocket, None)
        self._door.known(websocket.remote_address)
        trial = self._trial_for(step)
        link = Link(websocket, lossless=self.settings.trial.lossless)
        sender = asyncio.create_task(link.run())
        self._links[link] = sender
        self._watchdog.came()
        self._watch()
        try:
            await self._attach(trial, link)
            await self._listen(trial, link)
        except Closing as closing:
            link.end(closing.code, messages.error(closing.words))
            if closing.code == 1011:
                sender.add_done_callback(lambda _: self._end_in(_TOLD_SECONDS))
        finally:
            trial.detach(link)
            if websocket.close_code is None:  # ended by us: what was to be said goes first
                await asyncio.wait({sender}, timeout=2 * _CLOSE_SECONDS)
                if not sender.done():
                    link.abort()
            sender.cancel()
            del self._links[link]
            if not self._links:
                self._watchdog.left(asyncio.get_running_loop().time())
                self._watch()

    async def _welcome(self, websocket: ServerConnection) -> str | None:
        """The step that a client with the right token asks for. Raises Closing."""
        try:
            async with asyncio.timeout(self.settings.hello_seconds):
                data = await websocket.recv()
        except TimeoutError:
            raise Closing(4408, "no first message within the time allowed") from None
        try:
            hello = messages.parse_hello(data)
        except (NotAMessage, BadMessage) as error:
            raise Closing(4401, f"the first message must say who you are: {error}") from None
        token = hello.token if hello.token is not None else _token_of(websocket)
        if not _same(token or "", self.settings.token):
            raise Closing(4401, _STRANGER)
        if self.settings.warm_server:
            await self._whose(websocket)
        if not _same(hello.user_id or "", self.settings.user_id):
            raise Closing(4401, _STRANGER)
        if hello.step is not None and hello.step not in self.settings.game_steps:
            raise Closing(4404, "that is not a game step of this server")
        return hello.step

    async def _whose(self, websocket: ServerConnection) -> None:
        """Let a warm server see whose it is. Raises Closing if it is still nobody's, or cannot be seen in time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self.settings.hello_seconds):
                await _either(self._search.asked(), websocket.wait_closed())
        if self.settings.warm_server:
            raise Closing(1013, _NOT_YET)

    def _trial_for(self, step: str | None) -> Trial:
        """The trial of this step, begun if need be. Raises Closing."""
        trial = self._trial
        if trial is not None and trial.broken:
            return trial
        if step is None:
            steps = self.settings.game_steps
            running = trial is not None and not trial.finished.is_set()
            step = (
                trial.step
                if trial is not None and running
                else next((s for s in steps if s not in self._done), steps[-1])
            )
        if trial is not None and trial.step == step:
            return trial
        if trial is not None and not trial.finished.is_set():
            raise Closing(4404, "another step's game is still going on")
        trial = self._trial = Trial(
            self.settings, step, worker=self._worker, player=self._player, store=self._store, spool=self._spool
        )
        trial.begin(asyncio.shield(self._agent)).add_done_callback(self._played)
        return trial

    def _played(self, task: asyncio.Task[None]) -> None:
        if task.cancelled():
            return
        trial = self._trial
        if task.exception() is not None:
            log.error("the trial broke", exc_info=task.exception())
            self.end("error")
        elif trial is not None and trial.broken:
            self._end_in(TELL_SECONDS)
        elif trial is not None and trial.finished.is_set():
            self._done.add(trial.step)
            if trial.step == self.settings.game_steps[-1]:
                asyncio.get_running_loop().call_later(self.settings.linger_seconds, self.end, "done")

    async def _attach(self, trial: Trial, link: Link) -> None:
        await _either(trial.ready.wait(), link.websocket.wait_closed())
        if link.websocket.close_code is not None:
            return  # gone before the game was ready; whoever plays now is not disturbed
        if trial.broken:
            raise Closing(1011, _SORRY_START)
        present = trial.link
        if present is not None:
            present.end(4409, messages.error("the game was opened in another tab or device, and goes on there"))
        trial.attach(link)

    async def _listen(self, trial: Trial, link: Link) -> None:
        """Take a client's messages until it goes. Raises Closing and ConnectionClosed."""
        loop = asyncio.get_running_loop()
        flood, nonsense = Flood(MESSAGES_A_SECOND), 0
        async for data in link.websocket:
            if flood.too_many(loop.time()):
                raise Closing(4429, "too many messages")
            if trial.link is not link:
                continue  # replaced by another tab; it is being closed
            try:
                message = messages.parse(data)
                if message.ack is not None and link.binary:
                    if message.ack > link.window.newest:
                        raise BadMessage("ack of a frame that was not sent")
                    link.acknowledged(message.ack, loop.time())
                trial.handle(message, link)
            except NotAMessage as error:
                nonsense += 1
                if nonsense >= 3:
                    raise Closing(4400, str(error)) from None
                link.say(messages.error(str(error)))
            except (BadMessage, Refused) as error:
                link.say(messages.error(str(error)))


async def _renew(certificate: Certificate) -> None:
    while True:
        await asyncio.sleep(RELOAD_SECONDS)
        try:
            renewed = await asyncio.to_thread(certificate.fetch)
            if renewed is not None:
                certificate.use(renewed)
                log.info("a renewed certificate is in use")
        except Exception:
            log.exception("the certificate cannot be renewed; the present one stays")


async def _either(*waits: object) -> None:
    """Until the first of these is done."""
    tasks = [asyncio.ensure_future(wait) for wait in waits]  # type: ignore[call-overload]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()


def _same(given: str, right: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "surrogatepass"), right.encode())


def _token_of(websocket: ServerConnection) -> str | None:
    request = websocket.request
    tokens = parse_qs(urlsplit(request.path).query).get("token") if request is not None else None
    return tokens[0] if tokens else None


def _subprotocol(_: ServerConnection, offered: Sequence[Subprotocol]) -> Subprotocol | None:
    return next((Subprotocol(name) for name in SUBPROTOCOLS if name in offered), None)


def _answer_plain_http(websocket: ServerConnection, request: Request) -> Response | None:
    path = urlsplit(request.path).path
    if path == "/healthz":
        return websocket.respond(http.HTTPStatus.OK, "ok\n")
    if path != "/":
        return websocket.respond(http.HTTPStatus.NOT_FOUND, "There is nothing here. The game's WebSocket is at /.\n")
    if "websocket" not in request.headers.get("Upgrade", "").lower():
        return websocket.respond(
            http.HTTPStatus.UPGRADE_REQUIRED, "This is a game's server; it speaks WebSocket only.\n"
        )
    return None


def _silent() -> logging.Logger:
    """A logger that says nothing: what strangers send does not belong in the log."""
    logger = logging.getLogger("trial.websockets")
    logger.setLevel(logging.CRITICAL + 1)
    return logger


def exit_hard_after(seconds: float) -> None:
    """End the process in any case, whatever still runs then."""

    def end() -> None:
        print("trial: had to be ended", file=sys.stderr, flush=True)
        os._exit(1)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
