"""Environments for programs: the path /gym of a trial server with `gym: environments` (docs/gym.md).

A separate process makes the environments (`trial/programs/environments_process.py`), as for `make gym`. The first
program starts it. It listens on no port: for each program that has the token, this process hands it one end of a socket
pair, and passes messages on between the other end and the program.
"""

from __future__ import annotations

import asyncio
import contextlib
import http
import logging
import os
import socket
import sys
from pathlib import Path

from websockets.asyncio.client import connect
from websockets.asyncio.connection import Connection
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.http11 import Request, Response

from protocol import environment
from trial.gym.errors import reason
from trial.gym.forms import GYMIE, SUBPROTOCOL, UNKNOWN_FORM, form_of

log = logging.getLogger("trial")

MAX_PROGRAMS = 4
"""The most programs that may be connected at a time."""
MAX_REQUEST = 2**20
"""The most bytes in a program's message."""
MAX_REPLY = 8 * 2**20
"""The most bytes of observations in one answer."""
REQUESTS_A_SECOND = 500
"""The most requests of all programs together that are passed on in a second. The others wait: the game comes first."""
_MAX_ANSWER = 8 * MAX_REPLY  # bytes of a message: JSON needs several bytes for one byte of an observation
_AHEAD_SECONDS = 0.02  # a request may be passed on this much sooner than an even rate allows
_START_SECONDS = 60.0
_CLOSE_SECONDS = 2.0
_SEND_SECONDS = 30.0  # the time in which a program must read an answer
_NOT_SENT = (1005, 1006, 1015)  # close codes that an endpoint must not send (RFC 6455, 7.4.1)
_GONE = "The process of the environments has ended."


def prepare(websocket: ServerConnection, request: Request) -> Response | None:
    """Set a program's connection up as `make gym` does. Return a refusal if its address names an unknown form."""
    if form_of(request.path) is None:
        return websocket.respond(http.HTTPStatus.BAD_REQUEST, UNKNOWN_FORM)
    websocket.protocol.max_message_size = MAX_REQUEST
    websocket.ping_timeout = None  # while requests wait for an environment, the pong waits behind them
    return None


class Environments:
    """Starts the process that makes environments, and connects programs to it. For the event loop."""

    def __init__(self, agent_dir: Path) -> None:
        self._agent_dir = agent_dir
        self._folder = Path.cwd()  # now, since the agent may change it later
        self._process: asyncio.subprocess.Process | None = None
        self._handing: socket.socket | None = None  # hands connections to the process
        self._starting = asyncio.Lock()
        self._next = 0.0  # when the next request may be passed on at an even rate
        self.connections = 0
        """The number of programs that are connected."""

    async def serve(self, websocket: ServerConnection) -> None:
        """Pass messages on between a program and the process until one of them closes; then close the other, too."""
        self.connections += 1
        try:
            await self._serve(websocket)
        finally:
            self.connections -= 1

    async def close(self) -> None:
        """End the process, and all processes that it has started."""
        process, self._process = self._process, None
        if self._handing is not None:
            self._handing.close()  # the process ends when it notices this
            self._handing = None
        if process is not None:
            try:
                async with asyncio.timeout(_CLOSE_SECONDS):
                    await process.wait()
            except TimeoutError:
                with contextlib.suppress(ProcessLookupError):
                    process.kill()

    async def _serve(self, websocket: ServerConnection) -> None:
        form = (form_of(websocket.request.path) if websocket.request is not None else None) or GYMIE
        ours: socket.socket | None = None
        try:
            ours = await self._connection()
            connecting = connect(
                f"ws://localhost/gym?form={form.name}",
                sock=ours,
                subprotocols=[SUBPROTOCOL] if websocket.subprotocol == SUBPROTOCOL else None,
                compression=None,
                max_size=_MAX_ANSWER,
                open_timeout=_START_SECONDS,
                close_timeout=_CLOSE_SECONDS,
                ping_interval=None,
                proxy=None,
            )
            process = await connecting
        except (OSError, TimeoutError, InvalidHandshake, EOFError) as error:
            log.error("no environments can be made: %s", type(error).__name__)
            if ours is not None:
                ours.close()
            await websocket.close(1011, "No environments can be made here; the server's log says why.")
            return
        requests = asyncio.create_task(self._pass_on(websocket, process, paced=True))
        try:
            await self._pass_on(process, websocket)
        except TimeoutError:
            websocket.transport.abort()
        finally:
            requests.cancel()
            await asyncio.wait({requests})
            process.transport.abort()

    async def _pass_on(self, source: Connection, target: Connection, *, paced: bool = False) -> None:
        """Pass on messages until one of the two is closed; then close the target with the source's code and reason.

        With `paced`, the source is a program, and its requests are limited to `REQUESTS_A_SECOND`. Raises TimeoutError
        if a program does not read its answers.
        """
        with contextlib.suppress(ConnectionClosed):
            while True:
                message = await source.recv()
                if paced:
                    await self._turn()
                async with asyncio.timeout(None if paced else _SEND_SECONDS):
                    await target.send(message)
        if source.close_code is None:
            return  # the target is closed: the other direction closes the source
        code, words = source.close_code, source.close_reason or ""
        if code in _NOT_SENT:
            code, words = (1000, "") if paced else (1011, _GONE)
        await target.close(code, reason(words))

    async def _turn(self) -> None:
        """Wait until the next request may be passed on."""
        now = asyncio.get_running_loop().time()
        self._next = max(self._next, now) + 1.0 / REQUESTS_A_SECOND
        if self._next - now > _AHEAD_SECONDS:
            await asyncio.sleep(self._next - now)

    async def _connection(self) -> socket.socket:
        """Return a connection to the process, which is started if it does not run. Raises OSError."""
        async with self._starting:
            if self._process is None or self._process.returncode is not None:
                await self._start()
            try:
                return self._hand_over()
            except BrokenPipeError:  # it has ended, and asyncio does not know it yet
                await self.close()
                await self._start()
                return self._hand_over()

    def _hand_over(self) -> socket.socket:
        """Hand one end of a socket pair to the process, and return the other. Raises OSError."""
        if self._handing is None:
            raise OSError("the process is ending")
        ours, theirs = socket.socketpair()
        with theirs:
            try:
                socket.send_fds(self._handing, [b"c"], [theirs.fileno()])
            except OSError:
                ours.close()
                raise
        ours.setblocking(False)
        return ours

    async def _start(self) -> None:
        if self._handing is not None:
            self._handing.close()
        self._handing, theirs = socket.socketpair()
        self._handing.setblocking(False)
        with theirs:
            command = (sys.executable, "-m", "trial.programs.environments_process", str(theirs.fileno()))
            variables = {name: value for name, value in os.environ.items() if name not in environment.SECRETS}
            self._process = await asyncio.create_subprocess_exec(
                *command,
                cwd=self._folder,
                env=variables | {environment.AGENT_DIR: str(self._agent_dir)},
                pass_fds=[theirs.fileno()],
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.DEVNULL,
            )
