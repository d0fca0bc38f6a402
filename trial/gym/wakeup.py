"""A socket that is readable once a signal has come, so that a wait for sockets ends with it."""

from __future__ import annotations

import contextlib
import signal
import socket


class Wakeup:
    """Lets a signal end a wait also if it comes just before, or reaches another thread. For the main thread.

    Python runs a signal's handler between two steps of the main thread, and a system call that waits is none. So wait
    for this object too, as for a socket, and `clear` it once it is readable.
    """

    def __init__(self) -> None:
        self._awake, self._wake = socket.socketpair()
        self._awake.setblocking(False)
        self._wake.setblocking(False)
        self._before = signal.set_wakeup_fd(self._wake.fileno(), warn_on_full_buffer=False)

    def fileno(self) -> int:
        """The descriptor to wait for."""
        return self._awake.fileno()

    def clear(self) -> None:
        """Forget the signals that have come."""
        with contextlib.suppress(BlockingIOError):
            self._awake.recv(4096)

    def close(self) -> None:
        """Let signals wake what they woke before."""
        signal.set_wakeup_fd(self._before)
        self._awake.close()
        self._wake.close()
