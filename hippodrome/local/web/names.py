"""Names of servers on one machine, as on AWS: `wss://{name}.localhost:5000/` leads to the server of that name.

All names below localhost are this machine (RFC 6761, 6.3), and all servers share one port. So this module terminates
TLS: the name in the client's TLS hello (SNI) says which server gets the connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
import threading
from collections.abc import Callable

from hippodrome.local.backend.authority import Authority
from hippodrome.local.web import connections

PORT = 5000
"""The port of HIPPO's servers, to which its front end connects."""
_PIECE = 16_384  # bytes that may wait here; so a trial server notices when its client is slow
_BACKLOG = 100
_PAUSE = 0.5  # seconds until the next try, after a connection could not be accepted

Find = Callable[[str], int | None]


class Names:
    """Leads TLS connections to the servers of their names, in a thread of its own.

    `find` returns the port of the server with a name; None if there is none.
    """

    def __init__(self, listener: socket.socket, authority: Authority, find: Find) -> None:
        self.port: int = listener.getsockname()[1]
        self._listener = listener
        self._authority = authority
        self._find = find
        self._contexts: dict[str, ssl.SSLContext] = {}
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="names", daemon=True)
        self._ended = asyncio.Event()
        self._context = authority.context("localhost")
        self._all: set[asyncio.Task[None]] = set()
        self._handshakes: dict[asyncio.Task[None], None] = {}  # tasks in the TLS handshake, the oldest first

    def start(self) -> None:
        """Serve until `close`."""
        self._thread.start()

    def close(self) -> None:
        """Close the port and all connections."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._ended.set)
            self._thread.join(4)
        self._listener.close()

    def _run(self) -> None:
        with contextlib.suppress(asyncio.CancelledError):
            self._loop.run_until_complete(self._serve())
        self._loop.close()

    async def _serve(self) -> None:
        accepting = self._loop.create_task(self._accept())
        await self._ended.wait()
        accepting.cancel()
        for task in asyncio.all_tasks() - {asyncio.current_task()}:
            task.cancel()

    async def _accept(self) -> None:
        """Accept connections. If there are `connections.most`, close the oldest in its handshake; else the new one."""
        self._context.sni_callback = self._choose
        self._listener.setblocking(False)
        self._listener.listen(_BACKLOG)
        while True:
            try:
                accepted, _ = await self._loop.sock_accept(self._listener)
            except OSError:  # such as no more open files
                await asyncio.sleep(_PAUSE)
                continue
            if len(self._all) >= connections.most() and not self._drop_oldest():
                accepted.close()
                continue
            task = self._loop.create_task(self._handle(accepted))
            self._all.add(task)
            self._handshakes[task] = None
            task.add_done_callback(self._forget)
            await asyncio.sleep(0)  # so the task begins, and owns the socket

    def _drop_oldest(self) -> bool:
        """Close the oldest connection in its handshake; return False if there is none."""
        oldest = next(iter(self._handshakes), None)
        if oldest is not None:
            self._forget(oldest)
            oldest.cancel()
        return oldest is not None

    def _forget(self, task: asyncio.Task[None]) -> None:
        self._all.discard(task)
        self._handshakes.pop(task, None)

    async def _handle(self, accepted: socket.socket) -> None:
        """Do the TLS handshake, then connect the client with its server until one side closes."""
        reader = asyncio.StreamReader(_PIECE)
        protocol = asyncio.StreamReaderProtocol(reader)
        try:
            transport, _ = await self._loop.connect_accepted_socket(
                lambda: protocol, accepted, ssl=self._context, ssl_handshake_timeout=connections.HANDSHAKE_SECONDS
            )
        except OSError:  # no TLS, a name without a server, or a handshake that took too long
            return
        task = asyncio.current_task()
        assert task is not None
        self._handshakes.pop(task, None)
        await self._relay(reader, asyncio.StreamWriter(transport, protocol, reader, self._loop))

    def _choose(self, connection: ssl.SSLObject, name: str | None, _: ssl.SSLContext) -> int | None:
        """Choose the certificate of the name that the client asks for; refuse names that no server has."""
        server_name = (name or "").lower()
        if self._find(server_name) is None:
            return ssl.ALERT_DESCRIPTION_UNRECOGNIZED_NAME
        if server_name not in self._contexts:
            self._contexts[server_name] = self._authority.context(server_name)
        connection.context = self._contexts[server_name]
        return None

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        chosen = writer.get_extra_info("ssl_object").context
        port = next((self._find(name) for name, context in self._contexts.items() if context is chosen), None)
        try:
            if port is not None:
                server = await asyncio.open_connection("127.0.0.1", port, limit=_PIECE)
                await _join((reader, writer), server)
        except OSError:
            pass  # the server is gone; the client sees its connection closed
        finally:
            writer.close()


Stream = tuple[asyncio.StreamReader, asyncio.StreamWriter]


async def _join(stream: Stream, other: Stream) -> None:
    """Copy bytes both ways until one side closes."""
    ways = [asyncio.create_task(_copy(stream[0], other[1])), asyncio.create_task(_copy(other[0], stream[1]))]
    try:
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for way in ways:
            way.cancel()
        other[1].close()


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.transport.set_write_buffer_limits(high=_PIECE)
    with contextlib.suppress(OSError):
        while piece := await reader.read(_PIECE):
            writer.write(piece)
            await writer.drain()
