"""A request of a bot's, and its answer: it goes where `AllowedAddresses` allows, and follows no redirect by itself."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from dataclasses import dataclass
from urllib.parse import urlsplit, urlunsplit

import h11

from bots.addresses import PORTS, THIS_MACHINE, AllowedAddresses

ASK_SECONDS = 20.0  # for the answer to a request


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
    address: str, body: bytes | None = None, *, seconds: float = ASK_SECONDS, where: AllowedAddresses = THIS_MACHINE
) -> Reply:
    """One request, a POST of a form if there is a body.

    Raises AddressRefused for an address that bots do not go to, OSError if there is no (whole) answer in time.
    """
    parts = urlsplit(where.page(address))
    target = urlunsplit(("", "", parts.path or "/", parts.query, ""))
    headers = [("Host", parts.netloc), ("Accept", "text/html"), ("Connection", "close"), ("User-Agent", "rehearsal")]
    if body is not None:
        headers += [("Content-Type", "application/x-www-form-urlencoded"), ("Content-Length", str(len(body)))]
    request = h11.Request(method="GET" if body is None else "POST", target=target, headers=headers)
    try:
        async with asyncio.timeout(seconds):
            host = parts.hostname or ""
            tls = where.tls if parts.scheme == "https" else None
            return await _exchange(
                *where.dial(host, parts.port or PORTS[parts.scheme]), request, body or b"", tls=tls, name=host
            )
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
                raise ConnectionError("closed without an answer")
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()
