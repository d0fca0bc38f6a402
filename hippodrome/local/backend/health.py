"""Finds out whether a server that was started answers."""

from __future__ import annotations

import contextlib
import http.client
import json
from pathlib import Path

from hippodrome.local.backend.task_record import HOST


def port_in(log: Path) -> int | None:
    """Return the port that the server has written into its log; None if there is none yet. Raises OSError."""
    try:
        text = log.read_bytes()
    except FileNotFoundError:
        return None
    for line in text.split(b"\n")[:-1]:
        if line.startswith(b'{"port"'):
            with contextlib.suppress(ValueError, KeyError, TypeError):
                return int(json.loads(line)["port"])
    return None


def is_healthy(port: int) -> bool:
    """Return whether the server at this port answers. Raises OSError if this machine refuses the connection."""
    connection = http.client.HTTPConnection(HOST, port, timeout=2)
    try:
        connection.request("GET", "/healthz")
        return connection.getresponse().status == 200
    except (ConnectionError, TimeoutError, http.client.HTTPException):
        return False
    finally:
        connection.close()
