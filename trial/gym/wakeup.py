"""A socket that becomes readable at a signal, so that a signal ends a wait for sockets."""

from __future__ import annotations

import contextlib
import signal
import socket


class Wakeup:
    """Ends a wait in the main thread at a signal, also if the signal comes just before, or reaches another thread.

    Python runs a signal's handler between two bytecode instructions of the main thread, so not while a system call
    waits. So wait for this object, too, as for a socket, and `clear` it once it is readable.
    """

    def __init__(self) -> None:
        self._awake, self._wake = socket.socketpair()
        self._awake.setblocking(False)
        self._wake.setblocking(False)
        self._before = signal.set_wakeup_fd(self._wake.fileno(), warn_on_full_buffer=False)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable at a signal."""
        return self._awake.fileno()

    def clear(self) -> None:
        """Forget the signals that have come."""
        with contextlib.suppress(BlockingIOError):
            self._awake.recv(4096)

    def close(self) -> None:
        """Restore the earlier wakeup descriptor, and close the sockets."""
        signal.set_wakeup_fd(self._before)
        self._awake.close()
        self._wake.close()
