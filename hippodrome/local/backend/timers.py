"""Timers as files, and a thread that fires each when it is due."""

from __future__ import annotations

import heapq
import math
import re
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hippodrome.control.ports import Message
from hippodrome.local.backend import files
from hippodrome.local.backend.retry import Retry, reports_errors, start
from hippodrome.protocol import disk

NAME = re.compile(r"[0-9a-zA-Z_.-]{1,64}")  # the names that EventBridge Scheduler accepts
AGAIN = 5.0  # seconds until a timer that could not fire is tried again
Say = Callable[[str], None]


@reports_errors
class FolderTimers:
    """Implements `hippodrome.control.ports.Timers`. `fire` publishes a timer's message; then the timer is removed."""

    def __init__(
        self, state: Path, fire: Callable[[Message], None], say: Say = print, retry: Retry | None = None
    ) -> None:
        self.retry = retry or Retry(say)
        self._folder = state / "timers"
        disk.make_folder(self._folder)
        self._fire = fire
        self._say = say
        self._changed = threading.Condition()
        self._queue: list[tuple[float, str]] = []
        self._open = False
        self._thread = threading.Thread(target=self._work, name="timers", daemon=True)

    def set(self, name: str, at: datetime, message: Message) -> None:
        """Publish `message` to the stop topic at `at`. Replaces a timer of the same name.

        Raises ValueError for a name that EventBridge Scheduler would refuse.
        """
        path = self._path(name)
        when = float(int(at.timestamp()))
        with self._changed:
            heapq.heappush(self._queue, (when, name))  # before the file: it may be there even if writing it fails
            self._changed.notify()
            files.write_json(path, {"at": datetime.fromtimestamp(when, UTC).isoformat(), "message": dict(message)})

    def cancel(self, name: str) -> None:
        with self._changed:
            self._path(name).unlink(missing_ok=True)

    def list(self) -> Iterator[str]:
        yield from (name.removesuffix(".json") for name in files.names(self._folder, ".json"))

    def fire(self, name: str, now: float = math.inf) -> None:
        """Fire the timer if it is due at `now` (Unix time). Raises OSError."""
        with self._changed:  # not while it is being replaced or cancelled
            at, message = self._due(name)
            if 0 < at <= now:
                self._fire(message)
                self._path(name).unlink(missing_ok=True)

    def start(self) -> None:
        """Begin to fire timers. Those that became due while no process ran come first. Raises OSError."""
        with self._changed:
            self._queue = [(at, name) for name in self.list() if (at := self._due(name)[0])]
            heapq.heapify(self._queue)
            self._open = True
        start(self._thread)

    def close(self) -> None:
        """Stop firing timers."""
        with self._changed:
            self._open = False
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(5)

    def _path(self, name: str) -> Path:
        if not NAME.fullmatch(name) or name.startswith("."):
            raise ValueError("a timer's name has 1 to 64 letters, digits and _.-, and does not begin with a dot")
        return self._folder / f"{name}.json"

    def _due(self, name: str) -> tuple[float, Any]:
        """When the timer is due (Unix time; 0 if there is no such timer), and its message. Raises OSError."""
        stored = files.read_json(self._path(name))
        try:
            return datetime.fromisoformat(stored["at"]).timestamp(), stored["message"]
        except (TypeError, KeyError, ValueError):
            return 0.0, None

    def _work(self) -> None:
        while name := self._next():
            try:
                self.fire(name, time.time())
            except Exception as error:  # noqa: BLE001 - the other timers go on
                if not isinstance(error, OSError):  # `Retry` has reported the system's errors
                    self._say(f"a timer failed and is tried again: {type(error).__name__}: {error}")
                with self._changed:
                    heapq.heappush(self._queue, (time.time() + AGAIN, name))

    def _next(self) -> str:
        """Wait until a timer is due, and return its name; empty once this is closed."""
        with self._changed:
            while self._open:
                wait = self._queue[0][0] - time.time() if self._queue else None
                if wait is not None and wait <= 0:
                    return heapq.heappop(self._queue)[1]
                # At most half a minute: the machine may sleep, and its clock may be set.
                self._changed.wait(None if wait is None else min(wait, 30.0))
        return ""
