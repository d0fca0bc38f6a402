"""Timers, as long as this process runs: the servers that they end do not outlive it."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable, Iterator
from datetime import datetime

from hippodrome.control.ports import Message


class LocalTimers:
    """Implements `hippodrome.control.ports.Timers`. `publish` gets a timer's message when it is due.

    On a machine that sleeps it comes late; the sweep ends servers after their deadline, too.
    """

    def __init__(self, publish: Callable[[Message], None]) -> None:
        self._publish = publish
        self._lock = threading.Lock()
        self._timers: dict[str, tuple[threading.Timer, Message]] = {}

    def set(self, name: str, at: datetime, message: Message) -> None:
        """Publish `message` at `at`. Replaces a timer of the same name. Raises OSError if there are no more threads."""
        timer = threading.Timer(max(0.0, at.timestamp() - time.time()), self._due, [name])
        timer.daemon = True
        with self._lock:
            try:
                timer.start()
            except RuntimeError as error:
                raise OSError(errno.EAGAIN, str(error)) from error
            before = self._timers.get(name)
            self._timers[name] = timer, message
        if before is not None:
            before[0].cancel()

    def cancel(self, name: str) -> None:
        with self._lock:
            timer, _ = self._timers.pop(name, (None, None))
        if timer is not None:
            timer.cancel()

    def list(self) -> Iterator[str]:
        with self._lock:
            names = [*self._timers]
        yield from names

    def fire(self, name: str) -> None:
        """Publish the timer's message now."""
        with self._lock:
            timer, message = self._timers.pop(name, (None, {}))
        if timer is not None:
            timer.cancel()
            self._publish(message)

    def close(self) -> None:
        """Fire no more timers."""
        for name in list(self._timers):
            self.cancel(name)

    def _due(self, name: str) -> None:
        with self._lock:
            timer, _ = self._timers.get(name, (None, None))
        if timer is threading.current_thread():  # it was not replaced or cancelled just now
            self.fire(name)
