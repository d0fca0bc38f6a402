"""The WebSocket server: its port, its certificate, and its limits for connections that are not authenticated yet."""

from __future__ import annotations

import asyncio
import logging
import os
import ssl
import tempfile
from collections.abc import Awaitable, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from websockets.asyncio.server import Server as WebSocketServer
from websockets.asyncio.server import ServerConnection, serve
from websockets.frames import Frame, Opcode
from websockets.protocol import Event
from websockets.typing import Subprotocol

from hippodrome.trial.recordings.store import Store
from hippodrome.trial.server.handshake import process_request, select_subprotocol
from hippodrome.trial.server.own_certificate import CertificateAndKey
from hippodrome.trial.settings import SettingsError, TrialSettings
from hippodrome.trial.wire.connection import SUBPROTOCOL
from hippodrome.trial.wire.inbound import RateLimit

RELOAD_SECONDS = 3600.0


class CertificatePair(NamedTuple):
    """A certificate chain and a key (PEM) that fit each other, and the contents of the two files that held them."""

    chain: bytes
    key: bytes
    files: tuple[bytes | None, bytes]


class Certificate:
    """A server's certificate, and the SSL context with it. `context` stays the same object.

    The key's file may hold the chain, too, as in the certificates that Hippodrome orders. This chain is used if the
    chain's own file is missing or does not fit, because the files were read while a new certificate replaced them.
    """

    def __init__(self, settings: TrialSettings, store: Store) -> None:
        self._chain_key = settings.ssl_fullchain
        self._private_key = settings.ssl_privkey
        self._store = store
        self._files: tuple[bytes | None, bytes] | None = None
        self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self.context.minimum_version = ssl.TLSVersion.TLSv1_2

    def load(self) -> bool:
        """Fetch the certificate and use it, before there are connections. Return False if it is in use already.

        It blocks, and raises as `fetch` does.
        """
        fetched = self.fetch()
        if fetched is not None:
            self.use(fetched)
        return fetched is not None

    def fetch(self) -> CertificatePair | None:
        """Fetch the files, and return the chain and key to use; None if they are in use already. It blocks.

        Raises SettingsError if a file is missing, ssl.SSLError if the files do not fit, and the store's errors.
        """
        with ThreadPoolExecutor(2) as pool:  # both files at once: each takes two round trips, and participants wait
            chain, key = pool.map(self._store.get, (self._chain_key, self._private_key))
        key_has_chain = key is not None and b"-----BEGIN CERTIFICATE" in key
        if key is None or (chain is None and not key_has_chain):
            raise SettingsError("the certificate's files are not where SSL_FULLCHAIN and SSL_PRIVKEY say")
        if (chain, key) == self._files:
            return None
        # Tried on another context: if OpenSSL is given a chain that does not fit, the context loses its key, and the
        # server would refuse every connection.
        probe = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            _load(probe, chain or key, key)
        except ssl.SSLError:
            if not key_has_chain:
                raise
            _load(probe, key, key)
            return CertificatePair(key, key, (chain, key))
        return CertificatePair(chain or key, key, (chain, key))

    def use(self, pair: CertificatePair) -> None:
        """Use the pair for connections from now on. Once the server listens, call it on the event loop only.

        It takes about a millisecond, in which the context has a chain without its key: no client may connect then.
        """
        _load(self.context, pair.chain, pair.key)
        self._files = pair.files


def _load(context: ssl.SSLContext, chain: bytes, key: bytes) -> None:
    # load_cert_chain reads files only. These can be read by this user alone (0700, 0600), and are deleted at once.
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder, name) for name in ("chain.pem", "key.pem")]
        for path, data in zip(paths, (chain, key), strict=True):
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
                out.write(data)
        context.load_cert_chain(*map(str, paths))


log = logging.getLogger("trial")

MAX_MESSAGE = 4096
"""The most bytes in a client's message."""
PINGS_A_SECOND = 50
"""The most pings and pongs that a client may send in a second. Browsers only answer the server's few pings."""
MAX_UNAUTHENTICATED_WEBSOCKETS = 64
"""The most WebSockets that have not authenticated. One more closes the oldest."""
CLOSE_SECONDS = 2.0
"""The time that a client has to answer a close."""


class PortNotPermitted(Exception):
    """The system does not let this process listen on the port."""


class _Connection(ServerConnection):
    """Cuts off a client that sends too many pings: to answer them would keep the server from the others' game."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._pings = RateLimit(PINGS_A_SECOND)

    def data_received(self, data: bytes) -> None:
        """Read received bytes in parts, so that of a flood only the first part is read."""
        for start in range(0, len(data), MAX_MESSAGE):
            if self.transport.is_closing():
                return
            super().data_received(data[start : start + MAX_MESSAGE])

    def process_event(self, event: Event) -> None:
        """Count a ping or pong."""
        pings = isinstance(event, Frame) and event.opcode in (Opcode.PING, Opcode.PONG)
        if pings and self._pings.exceeded(self.loop.time()):
            self.transport.abort()
        super().process_event(event)


class Listener:
    """Accepts connections. `handle` is called for each one whose WebSocket handshake is done."""

    def __init__(
        self,
        settings: TrialSettings,
        store: Store,
        handle: Callable[[ServerConnection], Awaitable[None]],
        own: Future[CertificateAndKey] | None = None,
    ) -> None:
        """`own`: the certificate for the server's address, if it gets one; else it is in the store."""
        self._settings = settings
        self._handle = handle
        self._certificate = Certificate(settings, store) if settings.tls else None
        self._own = own
        self._server: WebSocketServer
        self._unauthenticated: dict[ServerConnection, None] = {}

    async def open(self) -> int:
        """Begin to listen, and return the port.

        Raises PortNotPermitted, OSError, and for the certificate NoCertificate, SettingsError, ssl.SSLError and the
        store's errors.
        """
        settings, certificate = self._settings, self._certificate
        if certificate is not None and self._own is not None:
            own = await asyncio.wrap_future(self._own)
            certificate.use(CertificatePair(own.chain, own.key, (own.chain, own.key)))
        elif certificate is not None:
            await asyncio.to_thread(certificate.load)
        try:
            self._server = await self._serve()
        except PermissionError as error:
            raise PortNotPermitted(f"port {settings.port} is for privileged processes") from error
        port: int = self._server.sockets[0].getsockname()[1]
        return port

    async def _serve(self) -> WebSocketServer:
        settings, certificate = self._settings, self._certificate
        return await serve(
            self._connected,
            settings.host,
            settings.port,
            open_timeout=settings.hello_seconds,
            ssl=certificate.context if certificate is not None else None,
            ssl_handshake_timeout=settings.hello_seconds if certificate is not None else None,
            subprotocols=[Subprotocol(SUBPROTOCOL)],
            select_subprotocol=select_subprotocol,
            process_request=partial(process_request, gym=settings.trial.gym),
            create_connection=_Connection,
            server_header=None,
            compression=None,
            max_size=MAX_MESSAGE,
            write_limit=(1, 0),  # so that `send` returns only when the write buffer is empty
            ping_interval=15,
            ping_timeout=15,
            close_timeout=CLOSE_SECONDS,
            logger=_silent(),
        )

    def authenticated(self, websocket: ServerConnection) -> None:
        """Take a connection that has authenticated out of the limit."""
        self._unauthenticated.pop(websocket, None)

    async def renew_certificate(self) -> None:
        """Look for a renewed certificate every `RELOAD_SECONDS`, until cancelled.

        Without TLS, or with a certificate of its own, which lives longer than any server, return at once.
        """
        certificate = self._certificate
        if certificate is None or self._own is not None:
            return
        while True:
            await asyncio.sleep(RELOAD_SECONDS)
            try:
                renewed = await asyncio.to_thread(certificate.fetch)
                if renewed is not None:
                    certificate.use(renewed)
                    log.info("a renewed certificate is in use")
            except Exception:
                log.exception("the certificate cannot be renewed; the present one stays")

    def close(self, reason: str) -> None:
        """Accept no more connections, and close the open ones with code 1001."""
        self._server.close(code=1001, reason=reason)

    async def wait_closed(self) -> None:
        """Wait until all connections are closed."""
        await self._server.wait_closed()

    async def _connected(self, websocket: ServerConnection) -> None:
        self._unauthenticated[websocket] = None
        if len(self._unauthenticated) > MAX_UNAUTHENTICATED_WEBSOCKETS:
            oldest = next(iter(self._unauthenticated))
            del self._unauthenticated[oldest]
            oldest.transport.abort()
        try:
            await self._handle(websocket)
        finally:
            self._unauthenticated.pop(websocket, None)


def _silent() -> logging.Logger:
    """Return a logger that logs nothing: unauthenticated clients could write to the log by what they send."""
    logger = logging.getLogger("trial.websockets")
    logger.setLevel(logging.CRITICAL + 1)
    return logger
