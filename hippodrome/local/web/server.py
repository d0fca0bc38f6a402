"""The web server: uvicorn in a thread, at a port of this machine."""

from __future__ import annotations

import asyncio
import errno
import socket
import ssl
import threading
import time
from collections.abc import Callable, Collection
from functools import partial
from typing import Any

import uvicorn

from hippodrome.local.web.app import App
from hippodrome.local.web.connections import HttpConnection
from hippodrome.local.web.relay import Relay, Route

HOST = "127.0.0.1"
PORTS_TRIED = 20
_NO_ROOM = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)  # errors of accept(2) that pass

Report = Callable[[BaseException], None]
HIGHEST_PORT = 65535


class NoPort(Exception):
    """The number is no port, or no port that was tried is free; the text is a sentence for the researcher."""


def listen(port: int, host: str = HOST) -> socket.socket:
    """Return a socket that listens at this port of the address `host`, or at the next free one. 0 means any port.

    Without `host` only this machine can reach it. Raises `NoPort`.
    """
    if not 0 <= port <= HIGHEST_PORT:
        raise NoPort(f"{port} is no port: a port is a number from 1 to {HIGHEST_PORT} (PORT=, --port)")
    last = min(port + PORTS_TRIED, HIGHEST_PORT)
    for number in range(port, last + 1):
        if port and _answers(number, host):  # macOS would let us listen beside a server that listens on every address
            continue
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, number))
            listener.listen(1024)
        except OSError:
            listener.close()
            continue
        return listener
    tried = f"The port {port} is" if last == port else f"The ports {port} to {last} are all"
    raise NoPort(f"{tried} in use or not allowed; choose another (PORT=, --port)")


def address_of(listener: socket.socket, tls: ssl.SSLContext | None, host: str | None = None) -> str:
    """Return the address of a web server. `host` is the name in it, unless it is only for this machine."""
    name = host or ("localhost" if tls else HOST)
    return f"{'https' if tls else 'http'}://{name}:{listener.getsockname()[1]}"


def _answers(port: int, host: str) -> bool:
    """Whether a server accepts connections at this port."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.2)
        return probe.connect_ex((host, port)) == 0  # 0.0.0.0 leads to this machine


class _Server(uvicorn.Server):
    """uvicorn's server. `report` gets the error if this machine refuses a connection; it is accepted later."""

    def __init__(self, config: uvicorn.Config, report: Report | None) -> None:
        super().__init__(config)
        self._report = report

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        asyncio.get_running_loop().set_exception_handler(self._tell)
        await super().serve(sockets)

    def _tell(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if self._report is not None and isinstance(error, OSError) and error.errno in _NO_ROOM:
            self._report(error)
        else:
            loop.default_exception_handler(context)


class WebServer:
    """uvicorn in a thread of its own, so that the main thread can wait for signals. `url` is its address.

    It may be given, with another name than this machine's own. With `route`, browsers reach servers of games at this
    port, too.
    """

    def __init__(
        self,
        app: App,
        listener: socket.socket,
        report: Report | None = None,
        tls: ssl.SSLContext | None = None,
        *,
        url: str | None = None,
        route: Route | None = None,
    ) -> None:
        self._app = app
        self._listener = listener
        self.url = url or address_of(listener, tls)
        relay: Any = partial(Relay, route) if route is not None else "none"
        config = uvicorn.Config(
            app,
            http=HttpConnection,
            lifespan="off",
            access_log=False,
            log_level="error",
            server_header=False,
            ws=relay,
            timeout_graceful_shutdown=2,
            timeout_keep_alive=5,
        )
        config.load()
        config.ssl = tls
        self._server = _Server(config, report)
        self._thread = threading.Thread(target=self._server.run, args=[[listener]], name="web", daemon=True)

    @property
    def connections(self) -> Collection[object]:
        """The open connections."""
        return self._server.server_state.connections

    def start(self) -> None:
        """Start the thread, and wait until it answers requests."""
        self._thread.start()
        while not self._server.started and self._thread.is_alive():
            time.sleep(0.01)

    def close(self) -> None:
        """End the server and close its port. Requests that are being answered get two seconds to end."""
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(4)
        self._app.close()
        self._listener.close()
