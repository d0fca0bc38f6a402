"""What one connection may use. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from trial.gym.errors import LimitReached


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of a server; 0 stands for none, where a limit may be left out."""

    connections: int = 1000
    """Connections of the whole server."""
    workers: int = 64
    """Connections of the whole server that have a process, since they have made a request."""
    environments: int = 256
    """Environments of a connection, those of vectors counted one by one."""
    seconds: float = 60.0
    """For one request."""
    idle_seconds: float = 3600.0
    """Without a request, until a connection with environments is closed."""
    megabytes: int = 2048
    """Of memory, for each process of a connection beyond what it begins with, and for all of them together."""
    processes: int = 64
    """That the environments of a connection start."""
    steps_per_second: int = 0
    """Of a connection; 0: as many as it can take."""
    message_bytes: int = 4 * 2**20
    """In one message of a client."""
    reply_bytes: int = 256 * 2**20
    """In the observations of one reply."""


class Rate:
    """Counts the steps of a connection by the second."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._since = 0.0
        self._count = 0

    def take(self, steps: int, now: float) -> None:
        """Count `steps` at the moment `now`, in seconds. Raises LimitReached if they are too many."""
        if now - self._since >= 1.0:
            self._since, self._count = now, 0
        if self._count + steps > self._most:
            raise LimitReached(f"More than {self._most} steps a second; send them more slowly.")
        self._count += steps
