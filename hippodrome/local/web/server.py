"""The web server: uvicorn in a thread, at a port of this machine."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import ssl
import threading
import time
from collections.abc import Callable, Collection
from functools import partial
from typing import Any

import uvicorn

from hippodrome.local.web import connections
from hippodrome.local.web.app import App
from hippodrome.local.web.connections import HttpConnection
from hippodrome.local.web.relay import Find, Relay

HOST = "127.0.0.1"
PORTS_TRIED = 20
_NO_ROOM = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)  # errors of accept(2) that pass

Report = Callable[[BaseException], None]
HIGHEST_PORT = 65535
_PAUSE = 0.5  # seconds until the next try, after a connection could not be accepted


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
    """uvicorn's server. `report` gets the error if this machine refuses a connection; it is accepted later.

    With `tls` it accepts connections itself, since uvicorn limits neither the time nor the number of TLS handshakes.
    """

    def __init__(self, config: uvicorn.Config, report: Report | None, tls: ssl.SSLContext | None) -> None:
        super().__init__(config)
        self._report = report
        self._tls = tls
        self._accepting: asyncio.Task[None] | None = None
        self._handshakes: dict[asyncio.Task[None], None] = {}  # the oldest first

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        asyncio.get_running_loop().set_exception_handler(self._tell)
        await super().serve(sockets)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        if self._tls is None or sockets is None:
            await super().startup(sockets)
            return
        await super().startup([])
        (listener,) = sockets
        self._accepting = asyncio.get_running_loop().create_task(self._accept(listener, self._tls))

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        tasks = [*([self._accepting] if self._accepting else []), *self._handshakes]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await super().shutdown(sockets)

    async def _accept(self, listener: socket.socket, tls: ssl.SSLContext) -> None:
        """Accept connections. If as many as `connections.most` are in their handshake, close the oldest of them."""
        loop = asyncio.get_running_loop()
        listener.setblocking(False)
        while True:
            try:
                accepted, _ = await loop.sock_accept(listener)
            except OSError as error:  # such as no more open files
                if self._report is not None and error.errno in _NO_ROOM:
                    self._report(error)
                await asyncio.sleep(_PAUSE)
                continue
            if len(self._handshakes) >= connections.most():
                oldest = next(iter(self._handshakes))
                self._handshakes.pop(oldest)
                oldest.cancel()
            task = loop.create_task(self._shake_hands(accepted, tls))
            self._handshakes[task] = None
            task.add_done_callback(lambda done: self._handshakes.pop(done, None))
            await asyncio.sleep(0)  # so the task begins, and owns the socket

    async def _shake_hands(self, accepted: socket.socket, tls: ssl.SSLContext) -> None:
        with contextlib.suppress(OSError):  # no TLS, or a handshake that took too long
            await asyncio.get_running_loop().connect_accepted_socket(
                self._protocol, accepted, ssl=tls, ssl_handshake_timeout=connections.HANDSHAKE_SECONDS
            )

    def _protocol(self) -> HttpConnection:
        return HttpConnection(self.config, self.server_state, self.lifespan.state)

    def _tell(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if self._report is not None and isinstance(error, OSError) and error.errno in _NO_ROOM:
            self._report(error)
        else:
            loop.default_exception_handler(context)


class WebServer:
    """uvicorn in a thread of its own, so that the main thread can wait for signals. `url` is its address.

    It may be given, with another name than this machine's own. `find` returns the port of the game's server of a name:
    then browsers reach the servers of games at this port, too.
    """

    def __init__(
        self,
        app: App,
        listener: socket.socket,
        report: Report | None = None,
        tls: ssl.SSLContext | None = None,
        *,
        url: str | None = None,
        find: Find | None = None,
    ) -> None:
        self._app = app
        self._listener = listener
        self.url = url or address_of(listener, tls)
        relay: Any = partial(Relay, find) if find is not None else "none"
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
        self._server = _Server(config, report, tls)
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
