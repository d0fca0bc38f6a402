"""The limits of a server of environments. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from trial.gym.errors import LimitReached

_SILENT_SECONDS = 60.0


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of a server of environments. Each is the highest value that is allowed."""

    connections: int = 1000
    """The connections at a time."""
    workers: int = 64
    """The connections at a time that have a process (a worker), since they have sent a request."""
    environments: int = 256
    """The environments of a connection. Each environment of a vector counts."""
    seconds: float = 60.0
    """The seconds for one request."""
    idle_seconds: float = 3600.0
    """The seconds without a request after which a connection with a worker is closed; 0: no limit."""
    megabytes: int = 2048
    """The memory of each process of a connection beyond what it begins with, and of all of them together."""
    processes: int = 64
    """The processes that the environments of a connection start."""
    steps_per_second: int = 0
    """The steps of a connection in a second; 0: no limit."""
    message_bytes: int = 4 * 2**20
    """The bytes of a client's message."""
    reply_bytes: int = 256 * 2**20
    """The bytes of the observations in one reply."""

    @property
    def silent_seconds(self) -> float:
        """The seconds that a client has for its first request, after the handshake."""
        return min(_SILENT_SECONDS, self.idle_seconds or _SILENT_SECONDS)


class Rate:
    """Limits the steps of a connection to `most` in a second."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._since = 0.0
        self._count = 0

    def take(self, steps: int, now: float) -> None:
        """Count `steps` at the time `now`, in seconds. Raises LimitReached if they are too many."""
        if now - self._since >= 1.0:
            self._since, self._count = now, 0
        if self._count + steps > self._most:
            raise LimitReached(f"More than {self._most} steps a second; send them more slowly.")
        self._count += steps
