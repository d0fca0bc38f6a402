"""A free port for a server that a test starts again at the same port."""

from __future__ import annotations

import contextlib
import random
import socket
from pathlib import Path

_EPHEMERAL = Path("/proc/sys/net/ipv4/ip_local_port_range")  # the system gives these to connections, and for port 0
_LOWEST = 10_000


def free() -> int:
    """Return a port of 127.0.0.1 on which no process listens. Raises AssertionError if there is none.

    Where the system tells its range of ephemeral ports, the port lies below that range, so that the system gives it to no
    other process between two starts of the server.
    """
    below = int(_EPHEMERAL.read_text().split()[0]) if _EPHEMERAL.exists() else 0
    for port in random.sample(range(_LOWEST, below), 100) if below > _LOWEST + 100 else [0] * 100:
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind(("127.0.0.1", port))
            return int(probe.getsockname()[1])
    raise AssertionError("no port is free")
