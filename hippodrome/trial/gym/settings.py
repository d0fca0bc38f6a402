"""The limits and settings of a server of environments. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

PATH = "/gym"
"""The path at which clients connect."""
HANDSHAKE_SECONDS = 10.0
"""The seconds that a client has for its handshake."""
FIRST_REQUEST_SECONDS = 60.0
"""The seconds that a client has for its first request, after the handshake."""
MAX_MESSAGE = 4 * 2**20
"""The most bytes of a request."""


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits that whoever starts a server may set. Each is the highest value that is allowed."""

    connections: int = 64
    """The connections at a time. Each has a process."""
    seconds: float = 60.0
    """The seconds for one request."""
    idle_seconds: float = 3600.0
    """The seconds without a request after which a connection is closed; 0: no limit."""
    megabytes: int = 2048
    """The memory of each process of a connection beyond what it begins with, and of all of them together."""
    processes: int = 64
    """The processes that the environments of a connection start."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What all connections of a server have in common."""

    limits: Limits
    modules: Sequence[str] = ()
    """Modules that register environments. They are imported in the process of each connection."""
    origins: Sequence[str] = ()
    """The origins of pages that may connect, beside those of this machine."""
    output: bool = False
    """Whether what environments print is shown."""
    record: Path | None = None
    """The folder for recordings, if steps are recorded."""
