"""Connects browsers with games that share one port: a `Route` says which server a request is for.

In a lab it is the port of the pages, where `/game/{name}/` leads to the server `name`; on one machine with TLS it is
the port of all names (`names.py`). The servers of games listen on loopback addresses, where other machines cannot reach
them. Bytes are copied as they are; so the game's server notices when its browser is slow or silent, and defends itself
(`trial/server/listener.py`).
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Collection
from typing import Any

from hippodrome.local.web import connections

_PATH = re.compile(r"/game/([A-Za-z0-9-]{1,63})(/.*)")
_REQUEST = re.compile(rb"GET (/[!-~]*) HTTP/1\.1\r\n(.*)", re.DOTALL)
_HOST = re.compile(rb"^host: *([^:\s]+)", re.IGNORECASE | re.MULTILINE)
_PIECE = 16_384  # bytes that may wait here on each side
_CONNECT_SECONDS = 5.0
_CLOSE_SECONDS = 5.0  # in which a browser must take the last bytes

Find = Callable[[str], int | None]
Route = Callable[[str, str], tuple[int, str] | None]
"""Of a request's path and host, the port of its server and the path there; None if there is no such server."""


def by_path(find: Find) -> Route:
    """Return the route of a lab. `find` returns the port of the server of this name; None if there is none."""

    def route(path: str, _host: str) -> tuple[int, str] | None:
        match = _PATH.fullmatch(path)
        port = find(match[1]) if match else None
        return (port, match[2]) if match and port is not None else None

    return route


class Relay(asyncio.Protocol):
    """The browser's side of a connection. uvicorn makes one for each request for a WebSocket."""

    def __init__(self, route: Route, *, config: Any, server_state: Any, app_state: Any) -> None:
        self._route = route
        self._connections: set[Any] = server_state.connections
        self._waiting = bytearray()  # what the browser has sent before the server is connected
        self._connecting: asyncio.Task[None] | None = None
        self._browser: asyncio.Transport
        self.server: asyncio.Transport | None = None

    # What uvicorn calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._browser = transport
        self._connections.add(self)
        transport.set_write_buffer_limits(high=_PIECE)

    def data_received(self, data: bytes) -> None:
        if self.server is not None:
            self.server.write(data)
            return
        self._waiting += data
        if len(self._waiting) > 4 * _PIECE:
            self._browser.abort()
        elif self._connecting is None:
            self._begin()

    def pause_writing(self) -> None:
        if self.server is not None:
            self.server.pause_reading()

    def resume_writing(self) -> None:
        if self.server is not None:
            self.server.resume_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        self._connections.discard(self)
        if self._connecting is not None:
            self._connecting.cancel()
        if self.server is not None:
            self.server.close()

    def shutdown(self) -> None:
        """Close the connection, since the web server ends."""
        self.close()

    # What the server's side calls

    def connected(self, server: asyncio.Transport) -> None:
        """Send the server what has waited, and read on."""
        self.server = server
        server.set_write_buffer_limits(high=_PIECE)
        server.write(bytes(self._waiting))
        self._waiting.clear()
        if not self._browser.is_closing():
            self._browser.resume_reading()

    def write(self, data: bytes) -> None:
        """Send bytes to the browser."""
        self._browser.write(data)

    def read(self, goes_on: bool) -> None:
        """Stop reading from the browser, or go on, as the server takes its bytes."""
        if not self._browser.is_closing():
            (self._browser.resume_reading if goes_on else self._browser.pause_reading)()

    def close(self) -> None:
        """Close the browser's connection once it has taken the last bytes, after some seconds in any case."""
        self._browser.close()
        asyncio.get_running_loop().call_later(_CLOSE_SECONDS, self._browser.abort)

    def _begin(self) -> None:
        """Find the server that the request names, and connect to it."""
        request = _REQUEST.fullmatch(bytes(self._waiting))
        host = _HOST.search(request[2]) if request else None
        found = self._route(request[1].decode(), host[1].decode("latin-1").lower()) if request and host else None
        if request is None or found is None:
            self._refuse("404 Not Found")
        elif _number(self._connections) > connections.most() // 2:  # the others are for pages
            self._refuse("503 Service Unavailable")
        else:
            port, path = found
            self._waiting = bytearray(b"GET %b HTTP/1.1\r\n%b" % (path.encode(), request[2]))
            self._browser.pause_reading()
            self._connecting = asyncio.get_running_loop().create_task(self._connect(port))

    async def _connect(self, port: int) -> None:
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(_CONNECT_SECONDS):
                await loop.create_connection(lambda: _ServerSide(self), "127.0.0.1", port)
        except OSError:  # a TimeoutError is one
            self._refuse("502 Bad Gateway")

    def _refuse(self, status: str) -> None:
        self._browser.write(f"HTTP/1.1 {status}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n".encode())
        self.close()


class _ServerSide(asyncio.Protocol):
    """The server's side of a connection."""

    def __init__(self, relay: Relay) -> None:
        self._relay = relay

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._relay.connected(transport)

    def data_received(self, data: bytes) -> None:
        self._relay.write(data)

    def pause_writing(self) -> None:
        self._relay.read(False)

    def resume_writing(self) -> None:
        self._relay.read(True)

    def connection_lost(self, exc: Exception | None) -> None:
        self._relay.close()


def _number(all_connections: Collection[object]) -> int:
    return sum(isinstance(all_connection, Relay) for all_connection in all_connections)
