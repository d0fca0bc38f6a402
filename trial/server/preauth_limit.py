"""The listening socket, which limits the accepted connections that are not authenticated yet."""

from __future__ import annotations

import contextlib
import socket
from asyncio.sslproto import SSLProtocol
from typing import Any

MAX_UNAUTHENTICATED_SOCKETS = 300
"""The most unauthenticated connections, counted from their acceptance on. One more shuts down the oldest."""

# asyncio has a buffer of this size for each connection with TLS. By default it is 256 KB, and a thousand connections
# take 300 MB (measured with Python 3.11; see CPython issue 109534). Clients' messages have at most 4 KB.
SSLProtocol.max_size = 16 * 1024


class PortNotPermitted(Exception):
    """The system does not let this process listen on the port."""


class PreauthLimitedSocket(socket.socket):
    """A listening socket that shuts down the oldest unauthenticated connection if there are too many.

    Raises PortNotPermitted if the port is for privileged processes, and OSError.
    """

    def __init__(self, host: str, port: int) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)  # otherwise asyncio does not set TCP_NODELAY
        self._unauthenticated: dict[Any, socket.socket] = {}  # connections by the client's address, the oldest first
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
            with contextlib.suppress(OSError):  # the connection may be closed already
                oldest.shutdown(socket.SHUT_RDWR)  # the event loop notices this, and closes it
        return connection, address

    def authenticated(self, address: Any) -> None:
        """Stop counting the connection from this address, since it has authenticated."""
        self._unauthenticated.pop(address, None)

    def _forget_closed(self) -> None:
        self._unauthenticated = {address: each for address, each in self._unauthenticated.items() if each.fileno() >= 0}
