"""The addresses that bots may send requests to. Pure.

Bots check every address before they send anything to it: that of a link, a redirect, a page's form or a server's state.
An attacker who can write one of these must not be able to send simulated participants, their answers or a server's
token anywhere else.
"""

from __future__ import annotations

import ssl
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol
from urllib.parse import SplitResult, parse_qs, urlsplit

from hippodrome.model import ids

HOST = "127.0.0.1"
PORTS = {"http": 80, "ws": 80, "https": 443, "wss": 443}

Dial = Callable[[str, int], tuple[str, int]]


class AddressRefused(ValueError):
    """An address that bots do not go to."""


class AllowedAddresses(Protocol):
    """The addresses that bots may go to."""

    @property
    def tls(self) -> ssl.SSLContext | None:
        """Whom to believe; None where nothing is encrypted."""

    def page(self, address: str) -> str:
        """The address, if it is one of the study's pages. Raises AddressRefused."""

    def server(self, address: str) -> str:
        """The address, if it is one of the study's servers. Raises AddressRefused."""

    def dial(self, host: str, port: int) -> tuple[str, int]:
        """AllowedAddresses to connect for an address that was allowed: the address itself, but in tests."""


@dataclass(frozen=True)
class ThisMachine:
    """Studies that are held here, whatever their ports: simulated participants have no business in a real study."""

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


def _as_it_is(host: str, port: int) -> tuple[str, int]:
    return host, port


@dataclass(frozen=True)
class OneSite:
    """One installation's own site, one project's pages there, and its servers by their own names: nothing else.

    `site` is an https address; `servers` are what the pages let the game connect to, as their Content-Security-Policy
    has it (`wss://*.example.org:443`): one label in the place of the asterisk, which must be a server's own name.
    """

    site: str
    servers: Sequence[str]
    project_id: str
    tls: ssl.SSLContext | None = None
    connect: Dial = field(default=_as_it_is, repr=False)

    def page(self, address: str) -> str:
        parts, own = _split(address), _split(self.site)
        there = parts is not None and own is not None and parts.scheme == "https" and _origin(parts) == _origin(own)
        if parts is None or not there:
            raise AddressRefused(f"bots only go to {self.site}, not to {_named(parts)}")
        if parts.path != "/next" or parse_qs(parts.query).get("projectId") != [self.project_id]:
            raise AddressRefused(
                f"bots only go to the pages of their own project, not to {parts.path or '/'} of another"
            )
        return address

    def server(self, address: str) -> str:
        parts = _split(address)
        if parts is None or parts.scheme != "wss" or not any(_fits(parts, source) for source in self.servers):
            raise AddressRefused(f"bots only go to servers of {self.site}, not to {_named(parts)}")
        return address

    def dial(self, host: str, port: int) -> tuple[str, int]:
        return self.connect(host, port)


def _fits(parts: SplitResult, source: str) -> bool:
    """Whether the address has one server's name in the place of the source's asterisk, and the source's port."""
    allowed = _split(source.replace("*.", "any.", 1))
    first, _, rest = (parts.hostname or "").partition(".")
    if allowed is None or not source.startswith("wss://*.") or ids.parse_server_name(first) is None:
        return False
    return rest == (allowed.hostname or "").removeprefix("any.") and _origin(parts)[2] == _origin(allowed)[2]


def _split(address: str) -> SplitResult | None:
    """The parts of an address that says plainly where it leads; None for one that might be read in two ways."""
    try:
        parts = urlsplit(address)
        port = parts.port
    except ValueError:
        return None
    odd = parts.username is not None or parts.password is not None or port == 0
    odd = odd or any(character.isspace() or character == "\\" or ord(character) < 32 for character in address)
    return None if odd or not parts.hostname else parts


def _origin(parts: SplitResult) -> tuple[str, str, int]:
    return parts.scheme, parts.hostname or "", parts.port or PORTS.get(parts.scheme, 0)


def _named(parts: SplitResult | None) -> str:
    """Which address was refused, without its query, which may hold a token."""
    return f"{parts.scheme}://{parts.netloc}" if parts else "an address that cannot be read"
