"""The store of documents: a bucket, by presigned requests, or a folder. The keys are the same in both."""

from __future__ import annotations

import filecmp
from pathlib import Path
from typing import Protocol

from hippodrome.protocol import disk
from hippodrome.trial.recordings.presigned import PresignedStore


class Store(Protocol):
    """Reads and creates documents. The methods block: do not call them on the event loop. They raise OSError."""

    def get(self, key: str) -> bytes | None:
        """Return the document; None if there is none."""
        ...

    def look(self, key: str) -> bytes | None:
        """Return the document as `get` does, without retries: for documents that are read every few seconds."""
        ...

    def create(self, key: str, data: bytes | Path) -> bool:
        """Create a document of bytes or of a file's content. If the key exists, return False and change nothing.

        A call that raised may have created the document. Then the next call for it returns True.
        """
        ...


def open_store(place: str, server: str = "", credential: str = "") -> Store:
    """Open the store that the variable STORE names: a bucket, by the address that signs requests, or a folder.

    `server` and `credential` are shown to that address.
    """
    if place.startswith(("https://", "http://")):
        return PresignedStore(place, server, credential)
    return FolderStore(Path(place).resolve())


def short_error(error: BaseException) -> str:
    """Describe a store's error for the log, without names of files and keys: these contain participants' ids."""
    kind = type(error).__name__
    return f"{kind}: {error.strerror}" if isinstance(error, OSError) else kind


class FolderStore:
    """A store of files in a folder. A file is created whole or not at all, and survives a power cut afterwards."""

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
        except FileExistsError:  # the file may be of an earlier call, which then could not sync the folder
            return filecmp.cmp(path, data, shallow=False) if isinstance(data, Path) else path.read_bytes() == data
        return True
