"""Where documents are stored, always under the same keys: a bucket, by presigned requests, or a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from protocol import disk
from trial.recordings.presigned import PresignedStore


class Store(Protocol):
    """Blocking calls; use them off the event loop. They raise OSError."""

    def get(self, key: str) -> bytes | None:
        """The document, or None if there is none."""
        ...

    def look(self, key: str) -> bytes | None:
        """The same, of a document that is read every few seconds; tries once."""
        ...

    def create(self, key: str, data: bytes | Path) -> bool:
        """Store bytes or a file's content; False, and nothing changed, if the key exists."""
        ...


def open_store(place: str, server: str = "", credential: str = "") -> Store:
    """The store behind the address that signs requests, or in a folder."""
    if place.startswith(("https://", "http://")):
        return PresignedStore(place, server, credential)
    return FolderStore(Path(place).resolve())


def short_error(error: BaseException) -> str:
    """A store's error for the log, without the names of files and keys, which hold participants' ids."""
    kind = type(error).__name__
    return f"{kind}: {error.strerror}" if isinstance(error, OSError) else kind


class FolderStore:
    """Files under one folder. A file appears whole or not at all; once created, it outlives a power cut."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, key: str) -> bytes | None:
        try:
            return (self.folder / key).read_bytes()
        except FileNotFoundError:
            return None

    def look(self, key: str) -> bytes | None:
        return self.get(key)

    def create(self, key: str, data: bytes | Path) -> bool:
        path = self.folder / key
        disk.make_folder(path.parent)
        try:
            disk.create(path, data)
        except FileExistsError:
            return False
        return True
