"""Names of servers on one machine, as on AWS: `wss://{name}.localhost:5000/` leads to the server of that name.

All names below localhost are this machine (RFC 6761, 6.3), and all servers share one port.
"""

from __future__ import annotations

import socket
import ssl
from collections.abc import Callable

from hippodrome.local.backend.authority import Authority
from hippodrome.local.web.app import App
from hippodrome.local.web.server import Report, WebServer

PORT = 5000
"""The port of HIPPO's servers, to which its front end connects."""

Find = Callable[[str], int | None]


def names_server(listener: socket.socket, authority: Authority, find: Find, report: Report | None = None) -> WebServer:
    """Return a web server that leads to the servers of games by their names.

    `find` returns the port of the server with a name; None if there is none. Then the TLS handshake fails.
    """
    contexts: dict[str, ssl.SSLContext] = {}

    def choose(connection: ssl.SSLObject, name: str | None, _: ssl.SSLContext) -> int | None:
        """Choose the certificate of the name that the client asks for."""
        server_name = (name or "").lower()
        if find(server_name) is None:
            return ssl.ALERT_DESCRIPTION_UNRECOGNIZED_NAME
        if server_name not in contexts:
            contexts[server_name] = authority.context(server_name)
        connection.context = contexts[server_name]
        return None

    def route(path: str, host: str) -> tuple[int, str] | None:
        port = find(host)
        return None if port is None else (port, path)

    context = authority.context("localhost")
    context.sni_callback = choose
    return WebServer(App({}, lambda _: None), listener, report, context, route=route)
