"""How the tests' clients take messages from a trial server, whatever each client does with them."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed

from testing.waiting import PATIENCE

_TOLD = ("states", "state", "errors", "done", "acks")


class TakesMessages:
    """A client that receives its messages one by one, in `take`."""

    websocket: ClientConnection

    async def take(self) -> None:
        """Receive one message, and keep what it says."""
        raise NotImplementedError

    async def until(self, true: Any, seconds: float = PATIENCE) -> None:
        """Take messages until `true()` is true. Raises TimeoutError after `seconds`, with what the client has seen last."""
        try:
            async with asyncio.timeout(seconds):
                while not true():
                    await self.take()
        except TimeoutError as error:
            error.add_note(f"{ {name: seen for name, seen in vars(self).items() if name in _TOLD} }")
            raise

    async def watch(self, seconds: float) -> None:
        """Take messages for `seconds`."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while True:
                    await self.take()

    @contextlib.asynccontextmanager
    async def reading(self) -> AsyncIterator[None]:
        """Take messages meanwhile: a client that takes no pictures is away after some seconds, and the game is held for all."""
        task = asyncio.create_task(self.watch(600))
        try:
            yield
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                await task

    async def closed(self, seconds: float = PATIENCE) -> int | None:
        """Take messages until the connection is closed; return the code."""
        with contextlib.suppress(ConnectionClosed):
            await self.until(lambda: False, seconds)
        return self.websocket.close_code


async def play_to_the_end(server: Any, open_client: Any) -> None:
    """Let one client start the game of this server and watch it until the trial is over."""
    async with open_client(server.address) as client:
        await client.start()
        assert await client.closed() == 1000
