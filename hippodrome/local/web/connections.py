"""HTTP connections with limits of time and number, so that silent or slow clients block no others."""

from __future__ import annotations

import asyncio
import resource
from collections.abc import Iterable
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

HEADER_SECONDS = 10.0  # from the connection, or the last response, until the headers of a request have come
REQUEST_SECONDS = 60.0  # from the headers of a request until its body has come and its response is sent
MAX_CONNECTIONS = 512  # connections at once
ADDRESS_CONNECTIONS = 64  # connections at once for pages from one address of another machine
LOOPBACK = "127."  # here all clients of this machine, such as bots and a proxy, have one address
SHARE = 4  # of the files that this process may open, at most one in so many is a connection


def most() -> int:
    """Return how many connections there may be at once.

    It is computed anew each time, because the limit of open files may change.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return MAX_CONNECTIONS if soft == resource.RLIM_INFINITY else max(1, min(MAX_CONNECTIONS, soft // SHARE))


class HttpConnection(H11Protocol):
    """uvicorn's connection, which is closed when its client is too slow.

    If there are more connections than `most` allows, or more than ADDRESS_CONNECTIONS from one other machine, this
    closes the one of them that has waited longest for a whole request; if all others have a request that is being
    answered, it closes the newest.
    """

    _timer: asyncio.TimerHandle | None = None
    _since = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._arm(HEADER_SECONDS)
        others = [connection for connection in self.connections if isinstance(connection, HttpConnection)]
        same = [connection for connection in others if connection.address == self.address]
        if len(self.connections) > most():
            _close_oldest(others)
        elif len(same) > ADDRESS_CONNECTIONS and not self.address.startswith(LOOPBACK):
            _close_oldest(same)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        super().connection_lost(exc)

    def handle_events(self) -> None:
        before = self.cycle
        super().handle_events()
        if self.cycle is not before:
            self._arm(REQUEST_SECONDS)

    def handle_websocket_upgrade(self, event: Any) -> None:
        if self._timer is not None:
            self._timer.cancel()
        super().handle_websocket_upgrade(event)

    def on_response_complete(self) -> None:
        self._arm(HEADER_SECONDS)
        super().on_response_complete()

    def shutdown(self) -> None:
        """Close the connection since the server ends; if a request is being answered, after the answer."""
        if self.waits and self.cycle is not None and not self.cycle.response_complete:
            self.transport.abort()  # its body has not come: uvicorn would wait for it, and print a traceback
        else:
            super().shutdown()

    @property
    def address(self) -> str:
        """The client's IPv4 address."""
        return self.client[0] if self.client else ""

    @property
    def waits(self) -> bool:
        """Whether no request has come with its whole body since the last answer was sent."""
        cycle: Any = self.cycle
        return cycle is None or cycle.response_complete or cycle.more_body

    @property
    def since(self) -> float:
        """When it was made, or got the headers of its last request, or sent its last answer."""
        return self._since

    def _arm(self, seconds: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._since = self.loop.time()
        self._timer = self.loop.call_later(seconds, self.transport.abort)


def _close_oldest(crowd: Iterable[HttpConnection]) -> None:
    """Close the connection that waits longest. At least one of the crowd must wait, as the newest does."""
    oldest = min((connection for connection in crowd if connection.waits), key=lambda connection: connection.since)
    oldest.connections.discard(oldest)  # `connection_lost` is called only later
    oldest.transport.abort()
