"""A port for a server that is started again where it was."""

from __future__ import annotations

import contextlib
import random
import socket
from pathlib import Path

_GIVEN = Path("/proc/sys/net/ipv4/ip_local_port_range")  # to whoever asks for any port, and to connections
_LOWEST = 10_000


def free() -> int:
    """A port of 127.0.0.1 that nobody listens on.

    If the system says which ports it gives to others by itself, it is none of these: between two starts of the server nobody gets it.
    """
    given = int(_GIVEN.read_text().split()[0]) if _GIVEN.exists() else 0
    for port in random.sample(range(_LOWEST, given), 100) if given > _LOWEST + 100 else [0] * 100:
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind(("127.0.0.1", port))
            return int(probe.getsockname()[1])
    raise AssertionError("no port is free")
