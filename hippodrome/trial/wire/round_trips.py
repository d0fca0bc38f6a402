"""Measures round trips to a browser with the pings of WebSocket.

A browser answers a ping by itself, without the page, "as soon as is practical" (RFC 6455, 5.5.2 and 5.5.3). A ping
waits until earlier data are sent, as the game's pictures do. So the round trip is the one that the participant
experiences, with the server's own delays. It takes 6 bytes to the browser and 10 back, without TCP and TLS.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

MAX_SECONDS = 10.0
"""The longest round trip that is reported. A ping without an answer counts as one of this length."""
EVERY_SECONDS = 5.0
"""The time from the answer to one ping to the next ping, after the first samples."""
_BETWEEN_SAMPLES = 0.1


async def measure(websocket: ServerConnection, samples: int, report: Callable[[float], None]) -> None:
    """Report round trips, in seconds, until the connection is closed.

    The first `samples` are measured at once, the others every `EVERY_SECONDS`. One ping is under way at a time. While
    it has no answer, for instance because a phone sleeps, `MAX_SECONDS` is reported every `MAX_SECONDS`.
    """
    count = 0
    try:
        while True:
            await _measure_one(websocket, report)
            count += 1
            await asyncio.sleep(_BETWEEN_SAMPLES if count < samples else EVERY_SECONDS)
    except ConnectionClosed:
        pass


async def _measure_one(websocket: ServerConnection, report: Callable[[float], None]) -> None:
    """Measure and report one round trip. Raises ConnectionClosed."""
    ping, late = asyncio.ensure_future(_round_trip(websocket)), False
    try:
        while True:
            await asyncio.wait({ping}, timeout=MAX_SECONDS)
            if ping.done():
                break
            late = True
            report(MAX_SECONDS)
    finally:
        ping.cancel()  # changes nothing once it is done
    seconds = ping.result()
    if not late:
        report(min(seconds, MAX_SECONDS))


async def _round_trip(websocket: ServerConnection) -> float:
    return await (await websocket.ping())
