"""The addresses that bots may send requests to. Pure.

Bots check each address before they send anything to it, whether it comes from a link, a redirect, a page's form or a
server's state. An attacker who can write one of these must not be able to direct bots, their answers or a server's
token to another site.
"""

from __future__ import annotations

import ssl
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from ipaddress import IPv4Address
from typing import Protocol
from urllib.parse import SplitResult, parse_qs, urlsplit

from hippodrome.control.model import ids

HOST = "127.0.0.1"
PORTS = {"http": 80, "ws": 80, "https": 443, "wss": 443}

Dial = Callable[[str, int], tuple[str, int]]


class AddressRefused(ValueError):
    """Bots may not send requests to this address. `str()` names the address, without its query."""


class AllowedAddresses(Protocol):
    """The addresses that bots may go to."""

    @property
    def tls(self) -> ssl.SSLContext | None:
        """The TLS context that verifies the certificates of pages and servers; None if addresses are not encrypted."""

    def page(self, address: str) -> str:
        """Return the address if it is one of the study's pages. Raises AddressRefused for any other."""

    def server(self, address: str) -> str:
        """Return the address if it is one of the study's trial servers. Raises AddressRefused for any other."""

    def dial(self, host: str, port: int) -> tuple[str, int]:
        """Return the host and port to which to open the TCP connection for an allowed address.

        They are the address's own, except in tests.
        """


class ThisMachine:
    """Allows all studies on this machine, on any port, and nothing else: bots must not take part in a real study."""

    tls: ssl.SSLContext | None = None

    def page(self, address: str) -> str:
        return self._here(address, "http")

    def server(self, address: str) -> str:
        return self._here(address, "ws")

    def dial(self, host: str, port: int) -> tuple[str, int]:
        return host, port

    def _here(self, address: str, scheme: str) -> str:
        parts = _split(address)
        if parts is None or parts.scheme != scheme or parts.hostname != HOST:
            raise AddressRefused(f"bots only go to {scheme}://{HOST}:…, not to {address}")
        return address


THIS_MACHINE = ThisMachine()


def _unchanged(host: str, port: int) -> tuple[str, int]:
    return host, port


@dataclass(frozen=True)
class OneSite:
    """Allows the pages of one project on one installation's site, and the installation's trial servers.

    `site` is an https address. `servers` are the sources for trial servers in the pages' Content-Security-Policy, such
    as `wss://*.example.org:443`. An allowed address has the name of a server (`ids.parse_server_name`) in the place of
    the asterisk. Without sources servers have no names, and any public IPv4 address is allowed: its certificate proves
    it. `connect` is the function behind `dial`.
    """

    site: str
    servers: Sequence[str]
    project_id: str
    tls: ssl.SSLContext | None = None
    connect: Dial = field(default=_unchanged, repr=False)

    def page(self, address: str) -> str:
        parts, own = _split(address), _split(self.site)
        if parts is None or own is None or parts.scheme != "https" or _origin(parts) != _origin(own):
            raise AddressRefused(f"bots only go to {self.site}, not to {_without_path(parts)}")
        if parts.path != "/next" or parse_qs(parts.query).get("projectId") != [self.project_id]:
            raise AddressRefused(
                f"bots only go to the pages of their own project, not to {parts.path or '/'} of another"
            )
        return address

    def server(self, address: str) -> str:
        parts = _split(address)
        if parts is None or parts.scheme != "wss" or not self._is_server(parts):
            raise AddressRefused(f"bots only go to servers of {self.site}, not to {_without_path(parts)}")
        return address

    def dial(self, host: str, port: int) -> tuple[str, int]:
        return self.connect(host, port)

    def _is_server(self, parts: SplitResult) -> bool:
        if self.servers:
            return any(_matches(parts, source) for source in self.servers)
        return _is_public(parts.hostname or "")


def _matches(parts: SplitResult, source: str) -> bool:
    """Whether the address has a server's name in the place of the source's asterisk, and the source's port."""
    allowed = _split(source.replace("*.", "any.", 1))
    first, _, rest = (parts.hostname or "").partition(".")
    if allowed is None or not source.startswith("wss://*.") or ids.parse_server_name(first) is None:
        return False
    return rest == (allowed.hostname or "").removeprefix("any.") and _origin(parts)[2] == _origin(allowed)[2]


def _is_public(host: str) -> bool:
    try:
        return IPv4Address(host).is_global
    except ValueError:
        return False


def _split(address: str) -> SplitResult | None:
    """The parts of an address; None if two programs may read it differently (credentials, port 0, spaces, `\\`)."""
    try:
        parts = urlsplit(address)
        port = parts.port
    except ValueError:
        return None
    ambiguous = parts.username is not None or parts.password is not None or port == 0
    ambiguous = ambiguous or any(
        character.isspace() or character == "\\" or ord(character) < 32 for character in address
    )
    return None if ambiguous or not parts.hostname else parts


def _origin(parts: SplitResult) -> tuple[str, str, int]:
    return parts.scheme, parts.hostname or "", parts.port or PORTS.get(parts.scheme, 0)


def _without_path(parts: SplitResult | None) -> str:
    """The scheme, host and port of a refused address. Its query may hold a token."""
    return f"{parts.scheme}://{parts.netloc}" if parts else "an address that cannot be read"
