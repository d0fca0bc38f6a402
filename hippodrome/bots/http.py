"""Sends a bot's HTTP requests: only to addresses that `AllowedAddresses` allows. It does not follow redirects."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from dataclasses import dataclass
from urllib.parse import urlsplit, urlunsplit

import h11

from hippodrome.bots.addresses import PORTS, THIS_MACHINE, AllowedAddresses

BROWSER = "rehearsal"
ASK_SECONDS = 20.0  # the most seconds from a request to the end of its response


@dataclass(frozen=True)
class Reply:
    """An HTTP response."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def text(self) -> str:
        return self.body.decode("utf-8", "replace")


async def ask(
    address: str, body: bytes | None = None, *, allowed: AllowedAddresses = THIS_MACHINE, browser: str = BROWSER
) -> Reply:
    """Send one request and return its response. With a `body`, the request is a POST of the form in it.

    `browser` is the name that a browser gives itself.

    Raises AddressRefused if `allowed` does not have the address, and OSError if there is no whole response within
    ASK_SECONDS.
    """
    parts = urlsplit(allowed.page(address))
    target = urlunsplit(("", "", parts.path or "/", parts.query, ""))
    headers = [("Host", parts.netloc), ("Accept", "text/html"), ("Connection", "close"), ("User-Agent", browser)]
    if body is not None:
        headers += [("Content-Type", "application/x-www-form-urlencoded"), ("Content-Length", str(len(body)))]
    request = h11.Request(method="GET" if body is None else "POST", target=target, headers=headers)
    try:
        async with asyncio.timeout(ASK_SECONDS):
            name = parts.hostname or ""
            host, port = allowed.dial(name, parts.port or PORTS[parts.scheme])
            tls = allowed.tls if parts.scheme == "https" else None
            return await _exchange(host, port, request, body or b"", tls=tls, name=name)
    except h11.ProtocolError as error:
        raise ConnectionError(f"not HTTP: {error}") from error


async def _exchange(
    host: str, port: int, request: h11.Request, body: bytes, *, tls: ssl.SSLContext | None, name: str
) -> Reply:
    reader, writer = await asyncio.open_connection(host, port, ssl=tls, server_hostname=name if tls else None)
    try:
        http = h11.Connection(h11.CLIENT)
        for part in (request, h11.Data(data=body), h11.EndOfMessage()):
            writer.write(http.send(part) or b"")
        await writer.drain()
        head: h11.Response | None = None
        parts: list[bytes] = []
        while True:
            event = http.next_event()
            if event is h11.NEED_DATA:
                http.receive_data(await reader.read(65536))
            elif isinstance(event, h11.Response):
                head = event
            elif isinstance(event, h11.Data):
                parts.append(bytes(event.data))
            elif isinstance(event, h11.EndOfMessage) and head is not None:
                fields = {bytes(name).decode().lower(): bytes(value).decode("latin-1") for name, value in head.headers}
                return Reply(head.status_code, fields, b"".join(parts))
            elif isinstance(event, h11.ConnectionClosed):
                raise ConnectionError("the connection was closed before a response")
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()
