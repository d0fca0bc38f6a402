"""The assumption of `hippodrome/trial/wire/connection.py`: a browser answers pings by itself, even while its page is busy."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from websockets.asyncio.server import ServerConnection, serve

from hippodrome.trial.wire import connection
from tests.browser.world import PATIENCE

WANTED = 10  # round trips while the page is busy


class Pinging(threading.Thread):
    """A server that pings each client ten times a second, and keeps the measured round trips."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.port = 0
        self.reports: list[float] = []
        self._loop = asyncio.new_event_loop()
        self._begun = threading.Event()
        self._over = asyncio.Event()
        self.start()
        assert self._begun.wait(60)

    def run(self) -> None:
        self._loop.run_until_complete(self._serve())

    async def _serve(self) -> None:
        async def handle(websocket: ServerConnection) -> None:
            await connection.measure_round_trips(websocket, 1000, self.reports.append)

        async with serve(handle, "127.0.0.1", 0, ping_interval=None) as server:
            self.port = server.sockets[0].getsockname()[1]
            self._begun.set()
            await self._over.wait()

    def end(self) -> None:
        self._loop.call_soon_threadsafe(self._over.set)
        self.join(60)


@pytest.fixture
def pinging() -> Iterator[Pinging]:
    server = Pinging()
    yield server
    server.end()


@pytest.fixture
def site(pinging: Pinging) -> Iterator[tuple[str, list[float]]]:
    """The address of a page, and the round trips that were measured while its request for `/held` was not answered.

    The site answers `/held` after WANTED round trips, or after PATIENCE.
    """
    meanwhile: list[float] = []

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

        def do_GET(self) -> None:
            if self.path == "/held":
                before, until = len(pinging.reports), time.monotonic() + PATIENCE / 1000
                while len(pinging.reports) < before + WANTED and time.monotonic() < until:
                    time.sleep(0.02)
                meanwhile.extend(pinging.reports[before:])
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()

    web = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=web.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{web.server_port}/", meanwhile
    web.shutdown()
    web.server_close()


def test_a_busy_page_does_not_delay_the_browsers_pongs(
    chromium: Any, pinging: Pinging, site: tuple[str, list[float]]
) -> None:
    """The page is busy with a synchronous request, which its site answers after WANTED round trips."""
    page, (address, meanwhile) = chromium.new_page(), site
    page.goto(address)
    page.evaluate(f"""() => new Promise((open) => {{
        window.socket = new WebSocket("ws://127.0.0.1:{pinging.port}/");
        window.socket.onopen = open;
    }})""")
    page.evaluate("""() => {
        const request = new XMLHttpRequest();
        request.open("GET", "/held", false);
        request.send();
    }""")
    page.close()
    assert len(meanwhile) >= WANTED
    assert max(meanwhile) < connection.MAX_ROUND_TRIP, "each was answered while the page was busy"
