"""Tries again what this machine refuses (a full disk, no more open files), and says so in one sentence.

Nothing that local mode does for a participant ends with an error of the operating system: the code that gets one tries
again, with growing pauses, until it succeeds.
"""

from __future__ import annotations

import contextlib
import errno
import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

FIRST, LONGEST = 0.05, 10.0  # seconds between two attempts
SILENCE = 60.0  # seconds for which the same sentence is not said again

_FULL = "The disk is full: please make room"
_FILES = "This machine cannot open more files: please close programs, or raise the limit (`ulimit -n`)"
_BUSY = "This machine cannot run more processes or threads, or its memory is full: please close programs"
_FORBIDDEN = "A file or folder of this study may not be read or written: please check its owner and permissions"
_WORDS = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EMFILE: _FILES,
    errno.ENFILE: _FILES,
    errno.EAGAIN: _BUSY,
    errno.ENOMEM: _BUSY,
    errno.EACCES: _FORBIDDEN,
    errno.EPERM: _FORBIDDEN,
    errno.EROFS: "The disk can only be read: please make it writable",
}

Say = Callable[[str], None]
T = TypeVar("T")


class Retry:
    """Tries again what this machine refuses, and says what it is. Each sentence is said once a minute at most.

    The sentences name no files, since file names contain participants' ids.
    """

    def __init__(self, say: Say = print) -> None:
        self._say = say
        self._lock = threading.Lock()
        self._said_at: dict[str, float] = {}
        self._last = -math.inf

    def report(self, error: BaseException) -> None:
        """Say what this machine refused, and remember the time (`reported_within`)."""
        text = message_for(error)
        with self._lock:
            now = self._last = time.monotonic()
            if now < self._said_at.get(text, -SILENCE) + SILENCE:
                return
            self._said_at[text] = now
        self._say(text)

    def reported_within(self, seconds: float) -> bool:
        """Return whether `report` was called within the last `seconds`."""
        return time.monotonic() < self._last + seconds

    @contextlib.contextmanager
    def reporting(self) -> Iterator[None]:
        """Within the block, an OSError is reported and raised on: the caller's queue, or participant, tries again."""
        try:
            yield
        except OSError as error:
            self.report(error)
            raise

    def run(
        self, act: Callable[[], T], wait: Callable[[float], object] = time.sleep, seconds: float | None = None
    ) -> T | None:
        """Call `act` until it succeeds, and return its result.

        Between two calls, `wait` pauses for the seconds that it gets; if it returns True, this gives up and returns
        None. After `seconds`, if given, the last error is raised.
        """
        until = None if seconds is None else time.monotonic() + seconds
        pause = FIRST
        while True:
            try:
                return act()
            except Exception as error:  # any error: a server must be followed to its end
                self.report(error)
                if until is not None and time.monotonic() + pause > until:
                    raise
            if wait(pause):
                return None
            pause = min(2 * pause, LONGEST)


def message_for(error: BaseException) -> str:
    """Return the sentence for the researcher: what this machine refuses, and what to do about it."""
    number = getattr(error, "errno", None)
    words = _WORDS.get(number or 0)
    if words is None:
        reason = (isinstance(error, OSError) and error.strerror) or type(error).__name__
        words = f"This machine refused something ({reason})"
    return f"{words}. Nothing is lost: it is tried again until it works."


def start_thread(target: Callable[..., object], *args: object, name: str) -> threading.Thread:
    """Start a daemon thread, and return it. Raises OSError (EAGAIN) if this machine gives no more threads."""
    thread = threading.Thread(target=target, args=args, name=name, daemon=True)
    try:
        thread.start()
    except RuntimeError as error:
        raise OSError(errno.EAGAIN, str(error)) from error
    return thread
