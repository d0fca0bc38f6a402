"""Names in folders, and locks. `protocol/disk.py` writes files so that they survive a power cut."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

PRIVATE = 0o600


def names(folder: Path, suffix: str = "") -> list[str]:
    """Return the sorted names in a folder that end with `suffix`, without unfinished files. Raises OSError.

    `Path.glob` would take a folder that cannot be read for an empty one.
    """
    return sorted(name for name in os.listdir(folder) if name.endswith(suffix) and not name.startswith("."))


def exists(path: Path) -> bool:
    """Return whether there is such a file or folder. Raises OSError if that cannot be found out."""
    try:
        os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold an exclusive lock against every other thread and process. The system releases it if the process dies."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT, PRIVATE)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


class InUse(Exception):
    """Another process holds the lock; the text is the note that it left."""


class Hold:
    """A lock that this process keeps until it ends, with a note for the next process that wants the lock."""

    def __init__(self, path: Path) -> None:
        """Take the lock. Raises `InUse`, and OSError if it cannot be taken for another reason."""
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT, PRIVATE)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            note = os.read(self._handle, 1000).decode("utf-8", "replace")
            os.close(self._handle)
            raise InUse(note) from None
        self.write("")

    def write(self, note: str) -> None:
        """Leave a note for the next process. On a full disk there is no note."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._handle, 0)
            os.pwrite(self._handle, note.encode(), 0)
