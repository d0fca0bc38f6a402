"""What this machine refuses (a full disk, no more open files) is tried again, and told in one sentence.

Nothing that local mode does for a participant ends with an error of the operating system: the code that meets one tries
again, with growing pauses, until it works.
"""

from __future__ import annotations

import errno
import functools
import inspect
import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

FIRST, LONGEST = 0.05, 10.0  # seconds between two attempts
SILENCE = 60.0  # seconds until the same is told again

_FULL = "The disk is full: please make room"
_FILES = "This machine cannot open more files: please close programs, or raise the limit (`ulimit -n`)"
_BUSY = "This machine cannot run more processes or threads, or its memory is full: please close programs"
_FORBIDDEN = "A file or folder of this study may not be read or written: please see to its owner and mode"
_WORDS = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EMFILE: _FILES,
    errno.ENFILE: _FILES,
    errno.EAGAIN: _BUSY,
    errno.ENOMEM: _BUSY,
    errno.EACCES: _FORBIDDEN,
    errno.EPERM: _FORBIDDEN,
    errno.EROFS: "The disk can only be read: please see to it",
}

Say = Callable[[str], None]
T = TypeVar("T")
P = TypeVar("P")


class Retry:
    """Tries again, and tells what this machine refuses: one sentence a minute, without names of files.

    Names of files hold participants' ids.
    """

    def __init__(self, say: Say = print) -> None:
        self._say = say
        self._lock = threading.Lock()
        self._told: dict[str, float] = {}
        self._last = -math.inf

    def report(self, error: BaseException) -> None:
        """Tell of it, and remember when it was."""
        text = message_for(error)
        with self._lock:
            now = self._last = time.monotonic()
            if now < self._told.get(text, -SILENCE) + SILENCE:
                return
            self._told[text] = now
        self._say(text)

    def reported_within(self, seconds: float) -> bool:
        """Whether this machine has refused something within so many seconds."""
        return time.monotonic() < self._last + seconds

    def run(
        self, act: Callable[[], T], wait: Callable[[float], object] = time.sleep, seconds: float | None = None
    ) -> T | None:
        """The result of `act`, tried again until it works.

        Gives up, with None, when `wait` (a pause of so many seconds) returns True; or, if `seconds` are given, raises
        the last error when they are over.
        """
        until = None if seconds is None else time.monotonic() + seconds
        pause = FIRST
        while True:
            try:
                return act()
            except Exception as error:  # whatever it is, the server must not be lost sight of
                self.report(error)
                if until is not None and time.monotonic() + pause > until:
                    raise
            if wait(pause):
                return None
            pause = min(2 * pause, LONGEST)


def message_for(error: BaseException) -> str:
    """What the machine refuses, and what to do about it."""
    number = getattr(error, "errno", None)
    words = _WORDS.get(number or 0)
    if words is None:
        what = (isinstance(error, OSError) and error.strerror) or type(error).__name__
        words = f"This machine refused something ({what})"
    return f"{words}. Nothing is lost: it is tried again until it works."


def reports_errors(port: type[P]) -> type[P]:
    """Decorate the class of a port: an OSError of a public method is reported to `retry`, and raised again."""
    for name, method in list(vars(port).items()):
        if not name.startswith("_") and inspect.isfunction(method):
            setattr(port, name, _listing(method) if inspect.isgeneratorfunction(method) else _telling(method))
    return port


def _telling(method: Callable[..., T]) -> Callable[..., T]:
    @functools.wraps(method)
    def told(self: Any, *args: Any, **options: Any) -> T:
        try:
            return method(self, *args, **options)
        except OSError as error:
            self.retry.report(error)
            raise

    return told


def _listing(method: Callable[..., Iterator[T]]) -> Callable[..., Iterator[T]]:
    @functools.wraps(method)
    def told(self: Any, *args: Any, **options: Any) -> Iterator[T]:
        try:
            yield from method(self, *args, **options)
        except OSError as error:
            self.retry.report(error)
            raise

    return told


def start_thread(target: Callable[..., object], *args: object, name: str) -> threading.Thread:
    """A daemon thread that runs. Raises OSError (EAGAIN) if this machine gives no more threads."""
    thread = threading.Thread(target=target, args=args, name=name, daemon=True)
    start(thread)
    return thread


def start(thread: threading.Thread) -> None:
    """Start this thread. Raises OSError (EAGAIN) if this machine gives no more threads; may then be called again."""
    try:
        thread.start()
    except RuntimeError as error:
        raise OSError(errno.EAGAIN, str(error)) from error
