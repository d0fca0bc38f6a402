"""Files that are whole or not there at all, whenever the process dies."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def write_new(path: Path, data: bytes) -> None:
    """Write a file and bring it to the disk."""
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def replace(path: Path, data: bytes, within: Path | None = None) -> None:
    """Write the file, or put this content in its place. `within` is a folder for the unfinished file."""
    unfinished = (within or path.parent) / f".{secrets.token_hex(8)}.new"
    try:
        write_new(unfinished, data)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def write_json(path: Path, data: Any) -> None:
    """The same for a record of ours."""
    replace(path, json.dumps(data, indent=1).encode())


def read_json(path: Path) -> Any:
    """What a JSON file holds; None if it is missing or not readable."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold an exclusive lock against every other thread and process. Released by the system if the process dies."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


class InUse(Exception):
    """Somebody else holds the lock; the text is what they wrote there."""


class Hold:
    """A lock kept for as long as the process lives, with a note for whoever finds it taken."""

    def __init__(self, path: Path) -> None:
        """Take the lock. Raises `InUse`."""
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            note = os.read(self._handle, 1000).decode("utf-8", "replace")
            os.close(self._handle)
            raise InUse(note) from None
        self.write("")

    def write(self, note: str) -> None:
        """Leave a note."""
        os.ftruncate(self._handle, 0)
        os.pwrite(self._handle, note.encode(), 0)

    def release(self) -> None:
        """Let it go."""
        os.close(self._handle)
