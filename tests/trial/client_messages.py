"""What every client on a trial server does with messages, whatever it makes of them."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed


class TakesMessages:
    """A client that takes its messages one by one, by `take`."""

    websocket: ClientConnection

    async def take(self) -> None:
        """Receive one message, and keep what it says."""
        raise NotImplementedError

    async def until(self, true: Any, seconds: float = 15) -> None:
        """Take messages until something is true."""
        async with asyncio.timeout(seconds):
            while not true():
                await self.take()

    async def watch(self, seconds: float) -> None:
        """Take messages for so long."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while True:
                    await self.take()

    @contextlib.asynccontextmanager
    async def reading(self) -> AsyncIterator[None]:
        """Take what comes meanwhile: who takes no pictures is away after some seconds, and the game of all is held."""
        task = asyncio.create_task(self.watch(600))
        try:
            yield
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                await task

    async def closed(self, seconds: float = 15) -> int | None:
        """Take messages until the connection is closed; the code."""
        with contextlib.suppress(ConnectionClosed):
            await self.until(lambda: False, seconds)
        return self.websocket.close_code


def play_to_the_end(server: Any, open_client: Any) -> None:
    """One client starts the game of this server and watches it until the trial is over."""

    async def play() -> None:
        async with open_client(server.address) as client:
            await client.hello()
            await client.until(lambda: client.controls)
            await client.say(command="start")
            assert await client.closed() == 1000

    asyncio.run(play())
