"""What `trial/wire/round_trips.py` takes for granted of a browser: it answers pings by itself, whatever its page does."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from websockets.asyncio.server import ServerConnection, serve

from trial.wire import round_trips

BUSY_SECONDS = 2.0


class Pinging(threading.Thread):
    """A server that pings each client ten times a second, and keeps what it is told."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.port = 0
        self.reports: list[tuple[float, float]] = []
        self._loop = asyncio.new_event_loop()
        self._begun = threading.Event()
        self._over = asyncio.Event()
        self.start()
        assert self._begun.wait(10)

    def run(self) -> None:
        self._loop.run_until_complete(self._serve())

    async def _serve(self) -> None:
        async def handle(websocket: ServerConnection) -> None:
            await round_trips.measure(websocket, 1000, lambda took: self.reports.append((time.monotonic(), took)))

        async with serve(handle, "127.0.0.1", 0, ping_interval=None) as server:
            self.port = server.sockets[0].getsockname()[1]
            self._begun.set()
            await self._over.wait()

    def end(self) -> None:
        self._loop.call_soon_threadsafe(self._over.set)
        self.join(10)


@pytest.fixture
def pinging() -> Iterator[Pinging]:
    server = Pinging()
    yield server
    server.end()


def test_a_page_that_is_busy_does_not_hold_up_the_browsers_answer(chromium: Any, pinging: Pinging) -> None:
    page = chromium.new_page()
    page.evaluate(f"""() => new Promise((open) => {{
        window.socket = new WebSocket("ws://127.0.0.1:{pinging.port}/");
        window.socket.onopen = open;
    }})""")
    began = time.monotonic()
    page.evaluate(f"() => {{ const end = Date.now() + {BUSY_SECONDS * 1000}; while (Date.now() < end) {{}} }}")
    over = time.monotonic()
    meanwhile = [took for when, took in pinging.reports if began < when < over]
    page.close()
    assert over - began >= BUSY_SECONDS
    assert len(meanwhile) >= 3
    assert sorted(meanwhile)[len(meanwhile) // 2] < BUSY_SECONDS / 4, "the page was busy for all of this time"
