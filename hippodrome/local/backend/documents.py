"""Documents as files: a document's key is its path below the folder.

A file appears whole or not at all: it is written under `scratch` and then linked (create) or renamed (replace) to its
place. Trial servers create their documents in the same folder in the same way, from processes of their own. Files whose
names begin with a dot are unfinished, and no documents.

One thing differs from S3: on a file system that ignores case (the default of macOS), keys that differ only in case are
the same document.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import secrets
import zlib
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

from hippodrome.control.ports import Conflict, Document, Entry
from hippodrome.local.backend import files
from hippodrome.local.backend.retry import Retry
from hippodrome.protocol import disk

STRIPES = 64  # lock files; keys that share one wait for each other
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS)

Written = Callable[[str, bytes], None]


class FolderDocuments:
    """Implements `hippodrome.control.ports.Documents`. ETags are MD5 in quotation marks, as S3's.

    An OSError is reported (`retry.py`) and raised on. `written` is called with the key and the body of each document
    that this process writes, once it is on the disk.
    """

    def __init__(self, folder: Path, state: Path, written: Written | None = None, retry: Retry | None = None) -> None:
        """Raises OSError if documents cannot be stored in `folder`."""
        self.folder = folder.resolve()
        self._retry = retry or Retry()
        self._written = written
        self._locks = state / "locks"
        self._scratch = state / "scratch"
        self.prepare()
        try:
            self._try()
        except OSError as error:
            if error.errno != errno.EXDEV:
                raise
            self._scratch = self.folder / ".scratch"  # `state` is on another file system, and no link crosses it
            disk.make_folder(self._scratch)
            self._try()

    def prepare(self) -> None:
        """Make the folders that do not exist: at the start, and after they were deleted. Raises OSError."""
        for path in (self.folder, self._locks, self._scratch):
            disk.make_folder(path)

    def tidy(self) -> None:
        """Remove files that a process left unfinished when it died. Call it only while no other process writes here."""
        with contextlib.suppress(OSError):
            for name in os.listdir(self._scratch):
                disk.remove_if_possible(self._scratch / name)

    def _try(self) -> None:
        """Write and remove a file as documents are written. Raises OSError if that fails."""
        place = self.folder / f".{secrets.token_hex(8)}.new"
        try:
            disk.create(place, b"Can documents be stored here?", self._scratch)
        except OSError as error:
            if error.errno in _NO_LINKS:
                raise OSError(error.errno, "this file system has no hard links") from error
            raise
        finally:
            disk.remove_if_possible(place)

    def get(self, key: str, known: Document | None = None) -> Document | None:
        path = self._path(key)
        if path is None:
            return None
        with self._retry.reporting():
            try:
                body = path.read_bytes()
            except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
                return None
        etag = _etag(body)
        return known if known and known.etag == etag else Document(body, etag)

    def create(self, key: str, body: bytes) -> str:
        """Create a document; return its ETag. Raises `Conflict` if it exists, and ValueError if the key cannot be a
        file.
        """
        path = self._writable(key)
        with self._retry.reporting():
            disk.make_folder(path.parent)
            try:
                disk.create(path, body, self._scratch)
            except FileExistsError:
                raise Conflict(key) from None
        self._tell(key, body)
        return _etag(body)

    def replace(self, key: str, body: bytes, etag: str) -> str:
        """Replace the version with this ETag; return the new ETag.

        Raises `Conflict` if another version is present, and ValueError if the key cannot be a file.
        """
        path = self._writable(key)
        with self._lock(key):
            present = self.get(key)
            if present is None or present.etag != etag:
                raise Conflict(key)
            disk.replace(path, body, self._scratch)
        self._tell(key, body)
        return _etag(body)

    def put(self, key: str, body: bytes) -> None:
        """Write a document without a condition. Raises ValueError if the key cannot be a file."""
        path = self._writable(key)
        with self._lock(key):
            disk.make_folder(path.parent)
            disk.replace(path, body, self._scratch)
        self._tell(key, body)

    def list(self, prefix: str) -> Iterator[Entry]:
        """Yield an entry for each document whose key begins with `prefix`, in the order of the keys.

        Folders are read one at a time, when the caller comes to them. Documents that come or go meanwhile may be listed
        or not.
        """
        folder, _, start = prefix.rpartition("/")
        path = self._path(folder) if folder else self.folder
        if path is not None:
            with self._retry.reporting():
                yield from _walk(path, f"{folder}/" if folder else "", start)

    def delete(self, key: str) -> None:
        path = self._path(key)
        if path is None:
            return
        with self._lock(key):
            try:
                path.unlink()
            except (FileNotFoundError, NotADirectoryError):
                return
            except (IsADirectoryError, PermissionError):  # macOS raises PermissionError for a folder
                if not path.is_dir():
                    raise

    def _path(self, key: str) -> Path | None:
        """The file of a key; None for a key that no document can have here, so that nothing leaves the folder."""
        parts = key.split("/")
        if any(part.startswith(".") or not part or len(os.fsencode(part)) > 255 for part in parts):
            return None
        if "\0" in key or "\\" in key:
            return None
        return self.folder.joinpath(*parts)

    def _writable(self, key: str) -> Path:
        path = self._path(key)
        if path is None:
            raise ValueError(
                "this key cannot be a file: a part of it is empty, too long or begins with a dot, or it has a \\"
            )
        return path

    @contextlib.contextmanager
    def _lock(self, key: str) -> Iterator[None]:
        with self._retry.reporting(), files.locked(self._locks / str(zlib.crc32(os.fsencode(key)) % STRIPES)):
            yield

    def _tell(self, key: str, body: bytes) -> None:
        if self._written:
            self._written(key, body)


def _walk(folder: Path, prefix: str, start: str) -> Iterator[Entry]:
    """The documents below `folder` whose first name there begins with `start`, in the order of their keys' bytes.

    A folder sorts as if its name ended with a slash.
    """
    try:
        entries = [
            (os.fsencode(entry.name + "/" if entry.is_dir() else entry.name), entry)
            for entry in os.scandir(folder)
            if entry.name.startswith(start) and not entry.name.startswith(".")
        ]
    except (FileNotFoundError, NotADirectoryError):
        return
    for name, entry in sorted(entries, key=lambda pair: pair[0]):
        if name.endswith(b"/"):
            yield from _walk(Path(entry.path), f"{prefix}{entry.name}/", "")
            continue
        try:
            about = entry.stat()
        except FileNotFoundError:
            continue
        yield Entry(f"{prefix}{entry.name}", datetime.fromtimestamp(about.st_mtime, UTC), about.st_size)


def _etag(body: bytes) -> str:
    return f'"{hashlib.md5(body, usedforsecurity=False).hexdigest()}"'
