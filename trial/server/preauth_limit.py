"""The listening socket. It limits the connections that are accepted and not authenticated yet."""

from __future__ import annotations

import contextlib
import socket
from asyncio.sslproto import SSLProtocol
from typing import Any

MAX_UNAUTHENTICATED_SOCKETS = 300
"""Unauthenticated connections, counted from the first packet on. One more shuts down the oldest."""

# asyncio keeps a buffer of this size for every connection with TLS, and 256 KB as it comes: a thousand of them would
# cost 300 MB (measured with Python 3.11; see CPython issue 109534). Clients' messages are 4 KB at most.
SSLProtocol.max_size = 16 * 1024


class PortNotPermitted(Exception):
    """The system does not let this process listen on that port."""


class PreauthLimitedSocket(socket.socket):
    """Listens at an address. The event loop accepts from it as from any socket.

    Raises `PortNotPermitted` where the port is for privileged processes, and OSError.
    """

    def __init__(self, host: str, port: int) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)  # said, or asyncio does not set TCP_NODELAY
        self._unauthenticated: dict[Any, socket.socket] = {}  # by the address they come from, oldest first
        self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self.bind((host, port))
        except OSError as error:
            self.close()
            if isinstance(error, PermissionError):
                raise PortNotPermitted(f"port {port} is for privileged processes") from error
            raise

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection. Shuts down the oldest unauthenticated one if there are too many."""
        connection, address = super().accept()
        self._unauthenticated.pop(address, None)
        self._unauthenticated[address] = connection
        if len(self._unauthenticated) > MAX_UNAUTHENTICATED_SOCKETS:
            self._forget_closed()
        while len(self._unauthenticated) > MAX_UNAUTHENTICATED_SOCKETS:
            oldest = self._unauthenticated.pop(next(iter(self._unauthenticated)))
            with contextlib.suppress(OSError):  # it is closed already
                oldest.shutdown(socket.SHUT_RDWR)  # the event loop notices, and closes it
        return connection, address

    def authenticated(self, address: Any) -> None:
        """The connection from this address has authenticated, and is no longer counted."""
        self._unauthenticated.pop(address, None)

    def _forget_closed(self) -> None:
        self._unauthenticated = {each: kept for each, kept in self._unauthenticated.items() if kept.fileno() >= 0}
