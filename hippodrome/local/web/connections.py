"""HTTP connections with limits of time and number, so that silent or slow clients block no others."""

from __future__ import annotations

import asyncio
import resource
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

HEADER_SECONDS = 10.0  # from the connection, or the last response, until the headers of a request have come
REQUEST_SECONDS = 60.0  # from the headers of a request until its body has come and its response is sent
MAX_CONNECTIONS = 512  # connections at once
SHARE = 4  # of the files that this process may open, at most one in so many is a connection


def most() -> int:
    """Return how many connections there may be at once.

    It is computed anew each time, because the limit of open files may change.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return MAX_CONNECTIONS if soft == resource.RLIM_INFINITY else max(1, min(MAX_CONNECTIONS, soft // SHARE))


class HttpConnection(H11Protocol):
    """uvicorn's connection, which is closed when its client is too slow.

    If there are more connections than `most` allows, this closes the connection that has waited longest for a request;
    if all others have a request that is being answered, it closes the newest.
    """

    _timer: asyncio.TimerHandle | None = None
    _since = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._arm(HEADER_SECONDS)
        if len(self.connections) > most():
            waiting = [
                connection
                for connection in self.connections
                if isinstance(connection, HttpConnection) and not connection.answering
            ]
            oldest = min(waiting, key=lambda person: person._since)  # `waiting` has at least this connection
            self.connections.discard(oldest)  # `connection_lost` is called only later
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        super().connection_lost(exc)

    def handle_events(self) -> None:
        before = self.answering
        super().handle_events()
        if self.answering and not before:
            self._arm(REQUEST_SECONDS)

    def handle_websocket_upgrade(self, event: Any) -> None:
        if self._timer is not None:
            self._timer.cancel()
        super().handle_websocket_upgrade(event)

    def on_response_complete(self) -> None:
        self._arm(HEADER_SECONDS)
        super().on_response_complete()

    @property
    def answering(self) -> bool:
        """Whether a request's headers have come and its answer has not been sent to the end."""
        cycle: Any = self.cycle
        return cycle is not None and not cycle.response_complete

    def _arm(self, seconds: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._since = self.loop.time()
        self._timer = self.loop.call_later(seconds, self.transport.abort)
