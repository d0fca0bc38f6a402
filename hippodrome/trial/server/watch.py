"""Programs that watch a trial, and advise if the project allows it: the path /gym of a trial server (docs/gym.md).

Their messages have Gymie's form, `{"method", "params"}`. They have no effect on participants' connections, and an idle
server ends although programs are connected.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable, Iterator
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from hippodrome.trial.core.messages import CloseConnection, CommandRefused
from hippodrome.trial.wire.inbound import MESSAGES_A_SECOND, RateLimit

PATH = "/gym"
MAX_PROGRAMS = 8
"""The most programs that may be connected at a time."""
_UNREAD = 1000  # the most lines that wait for a program; one more ends its connection
_UNREAD_BYTES = 16 * 1024**2  # the most bytes of these lines; a single line may be longer

Advise = Callable[[int, str | None], None]
"""A function that gets an action's number and a player or None, like `Choices.advise`. It raises CommandRefused."""


class Watchers:
    """Passes each line of the recording on to the programs that watch. For the event loop."""

    def __init__(self) -> None:
        self._waiting: dict[Lines, Callable[[], None]] = {}

    def tell(self, line: bytes) -> None:
        """Pass on a line without waiting: the connection of a program that does not read its lines is cut."""
        if not self._waiting:
            return
        for lines, cut_off in [*self._waiting.items()]:
            if not lines.put(line):
                del self._waiting[lines]
                cut_off()

    @contextlib.contextmanager
    def lines(self, cut_off: Callable[[], None]) -> Iterator[Lines]:
        """Collect all lines from now on, for one program. `cut_off` is called if too many wait."""
        lines = Lines()
        self._waiting[lines] = cut_off
        try:
            yield lines
        finally:
            self._waiting.pop(lines, None)


class Lines:
    """Holds the lines that wait for a program."""

    def __init__(self) -> None:
        self._waiting: asyncio.Queue[bytes] = asyncio.Queue()
        self._bytes = 0

    def put(self, line: bytes) -> bool:
        """Add a line; return False if too many wait."""
        if len(self) >= _UNREAD or (self._bytes and self._bytes + len(line) > _UNREAD_BYTES):
            return False
        self._waiting.put_nowait(line)
        self._bytes += len(line)
        return True

    async def get(self) -> bytes:
        """Wait for the next line, and return it."""
        line = await self._waiting.get()
        self._bytes -= len(line)
        return line

    def __len__(self) -> int:
        return self._waiting.qsize()


class Watching:
    """Serves one program that watches.

    `actions` returns the names of a player's actions. `advise` is None if the project allows no advice.
    """

    def __init__(
        self,
        websocket: ServerConnection,
        watchers: Watchers,
        actions: Callable[[str | None], tuple[str, ...]],
        advise: Advise | None,
    ) -> None:
        self._websocket = websocket
        self._watchers = watchers
        self._actions = actions
        self._advise = advise
        self._sending: asyncio.Task[None] | None = None

    async def run(self) -> None:
        """Answer requests until the program closes its connection. Raises CloseConnection and ConnectionClosed."""
        rate, loop = RateLimit(MESSAGES_A_SECOND), asyncio.get_running_loop()
        try:
            async for data in self._websocket:
                if rate.exceeded(loop.time()):
                    raise CloseConnection(4429, f"too many messages: at most {MESSAGES_A_SECOND} a second")
                try:
                    answer = self._answer(data)
                except CommandRefused as error:
                    answer = {"error": {"type": "Refused", "message": str(error)}}
                await self._websocket.send(json.dumps(answer))
        finally:
            if self._sending is not None:
                self._sending.cancel()

    def _answer(self, data: str | bytes) -> Any:
        try:
            message = json.loads(data)
            method, params = message["method"], message["params"]
        except (ValueError, TypeError, KeyError, RecursionError):
            raise CommandRefused('a request is {"method": ..., "params": {...}}') from None
        if method == "watch":
            if self._sending is None:
                self._sending = asyncio.create_task(self._send_lines())
            return True
        if method == "action_space":
            names = self._actions(_player_in(params))
            return {"name": "Discrete", "n": len(names), "names": list(names)}
        if method == "advise":
            return self._take_advice(params)
        raise CommandRefused("there are the methods watch, action_space and advise")

    def _take_advice(self, params: Any) -> bool:
        if self._advise is None:
            raise CommandRefused("the project allows no advice (gym: advise, in the section trial of config.yml)")
        action = params.get("action") if isinstance(params, dict) else None
        if type(action) is not int:
            raise CommandRefused("action must be the number of an action")
        self._advise(action, _player_in(params))
        return True

    async def _send_lines(self) -> None:
        with self._watchers.lines(self._websocket.transport.abort) as lines, contextlib.suppress(ConnectionClosed):
            while True:
                await self._websocket.send((await lines.get()).decode().rstrip("\n"))


def _player_in(params: Any) -> str | None:
    player = params.get("player") if isinstance(params, dict) else None
    if player is not None and not isinstance(player, str):
        raise CommandRefused("player must be the name of a player")
    return player
