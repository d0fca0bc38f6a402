"""Lets Ctrl-C end a block only where the block can be ended."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType


@contextlib.contextmanager
def interruption() -> Iterator[Callable[[], None]]:
    """Let Ctrl-C raise KeyboardInterrupt, within the block, only in the function that this yields, and at its end.

    Elsewhere it would be raised at any line, and in the middle of a lock of the standard library it breaks the lock
    for other threads, which then print a traceback or wait for ever. A second Ctrl-C raises it at once. Nothing changes
    in a thread other than the main thread, or if the program has a handler of its own.
    """
    asked = False

    def check() -> None:
        if asked:
            raise KeyboardInterrupt

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        check()
        asked = True

    default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not default or threading.current_thread() is not threading.main_thread():
        yield check
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    check()
