"""Writes files that appear whole or not at all, and that survive a power cut once the call has returned.

On POSIX a file's content is on the disk after an `fsync` of the file; its name is there after an `fsync` of the folder
(https://man7.org/linux/man-pages/man2/fsync.2.html). A new folder's own name is in the folder above it.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
from pathlib import Path

_NO_FSYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF)  # some network file systems have no fsync for folders


def sync_folder(folder: Path) -> None:
    """Bring the names of the folder's files to the disk. Raises OSError."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _NO_FSYNC:
            raise
    finally:
        os.close(handle)


def make_folder(folder: Path) -> None:
    """Make the folder and the missing folders above it, and bring their names to the disk. Raises OSError."""
    missing = []
    while not _exists(folder):
        missing.append(folder)
        folder = folder.parent
    for path in reversed(missing):
        path.mkdir(exist_ok=True)
        sync_folder(path.parent)


def write_new(path: Path, data: bytes | Path) -> None:
    """Write a new file with these bytes, or with the content of another file, and bring it to the disk.

    Raises FileExistsError if the file exists already. After another OSError the file is missing or incomplete.
    """
    with path.open("xb") as out:
        if isinstance(data, Path):
            with data.open("rb") as source:
                shutil.copyfileobj(source, out)
        else:
            out.write(data)
        out.flush()
        os.fsync(out.fileno())


def create(path: Path, data: bytes | Path, scratch: Path | None = None) -> None:
    """Create a whole file with these bytes, or with the content of another file, and bring it to the disk.

    `scratch` is a folder of the same file system for the unfinished file; by default it lies in the file's own folder.
    Raises FileExistsError if the file exists already; then its name is on the disk, too. Raises other OSErrors.
    """
    unfinished = (scratch or path.parent) / f".{secrets.token_hex(8)}.new"
    try:
        write_new(unfinished, data)
        os.link(unfinished, path)  # unlike a rename, this fails if another process was first
    except FileExistsError:
        sync_folder(path.parent)
        raise
    finally:
        remove_if_possible(unfinished)
    sync_folder(path.parent)


def move(file: Path, path: Path) -> None:
    """Move a finished file to `path`, perhaps on another file system, and bring it to the disk there.

    Raises FileExistsError if `path` exists already, and other OSErrors; then `file` is still at its old place.
    """
    with file.open("rb") as content:
        os.fsync(content.fileno())
    try:
        os.link(file, path)
        sync_folder(path.parent)
    except FileExistsError:
        raise
    except OSError:  # the file system differs, or has no links
        create(path, file)
    remove_if_possible(file)


def replace(path: Path, data: bytes | Path, scratch: Path | None = None) -> None:
    """Create or replace the file, with these bytes or with the content of another file, and bring it to the disk.

    `scratch` is as in `create`. Raises OSError.
    """
    unfinished = (scratch or path.parent) / f".{secrets.token_hex(8)}.new"
    try:
        write_new(unfinished, data)
        unfinished.replace(path)
    except OSError:
        remove_if_possible(unfinished)
        raise
    sync_folder(path.parent)


def remove_if_possible(path: Path) -> None:
    """Remove an unfinished file. An OSError is ignored: local mode removes such files at its next start."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def _exists(path: Path) -> bool:
    """Return whether the path exists. Unlike `Path.exists`, raise OSError if the path cannot be accessed."""
    try:
        os.stat(path)
    except FileNotFoundError:
        return False
    return True
