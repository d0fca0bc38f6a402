"""How long a message to a browser and back takes, measured with the WebSocket's own pings.

A browser answers a ping by itself, without the page, "as soon as is practical" (RFC 6455, 5.5.2 and 5.5.3). A ping
waits behind what was written before it, as the game's pictures do. So what is measured is what the participant has, the
server's own delays included. It costs 6 bytes to the browser and 10 back, beside TCP's and TLS's own.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

LONGEST_SECONDS = 10.0
"""A ping that is not answered within so many seconds counts as one that took so long."""
EVERY_SECONDS = 5.0
"""From the answer to one ping to the next ping, while the game goes on."""
_BETWEEN_SAMPLES = 0.1


async def measure(websocket: ServerConnection, samples: int, report: Callable[[float], None]) -> None:
    """Report round trips in seconds until the connection is closed: so many `samples` one after the other, then others.

    There is one ping under way at a time. While one is not answered, because a phone sleeps for instance,
    `LONGEST_SECONDS` are reported each time that so many seconds have passed.
    """
    count = 0
    try:
        while True:
            await _one(websocket, report)
            count += 1
            await asyncio.sleep(_BETWEEN_SAMPLES if count < samples else EVERY_SECONDS)
    except ConnectionClosed:
        pass


async def _one(websocket: ServerConnection, report: Callable[[float], None]) -> None:
    """Report one round trip. Raises ConnectionClosed."""
    ping, late = asyncio.ensure_future(_round_trip(websocket)), False
    try:
        while True:
            await asyncio.wait({ping}, timeout=LONGEST_SECONDS)
            if ping.done():
                break
            late = True
            report(LONGEST_SECONDS)
    finally:
        ping.cancel()  # changes nothing once it is done
    seconds = ping.result()
    if not late:
        report(min(seconds, LONGEST_SECONDS))


async def _round_trip(websocket: ServerConnection) -> float:
    return await (await websocket.ping())
