"""Files that appear whole or not at all, and survive a power cut once the call that wrote them has returned.

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

_CANNOT = (errno.EINVAL, errno.ENOTSUP, errno.EBADF)  # some network file systems have no fsync for folders


def sync_folder(folder: Path) -> None:
    """Bring the names in the folder to the disk. Raises OSError."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _CANNOT:
            raise
    finally:
        os.close(handle)


def make_folder(folder: Path) -> None:
    """Make the folder and those above it that are missing, and bring their names to the disk. Raises OSError."""
    missing = []
    while not _is_folder(folder):
        missing.append(folder)
        folder = folder.parent
    for path in reversed(missing):
        path.mkdir(exist_ok=True)
        sync_folder(path.parent)


def write_new(path: Path, data: bytes | Path) -> None:
    """Write a new file with these bytes, or with the content of another file, and bring it to the disk.

    Raises FileExistsError and other OSErrors; then there is no such file, or half of it.
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
    """Create the file whole, with these bytes or with the content of another file; it is on the disk then.

    `scratch` is a folder of the same file system for the unfinished file, if that should not lie beside it. Raises
    FileExistsError if there is such a file (which is on the disk then, too), and other OSErrors.
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
    """Bring a finished file to another place, perhaps of another file system; it is on the disk then.

    Raises FileExistsError if there is such a file, and other OSErrors; then the file is still at its old place.
    """
    with file.open("rb") as content:
        os.fsync(content.fileno())
    try:
        os.link(file, path)
        sync_folder(path.parent)
    except FileExistsError:
        raise
    except OSError:  # another file system, or one without links
        create(path, file)
    remove_if_possible(file)


def replace(path: Path, data: bytes | Path, scratch: Path | None = None, *, surely: bool = True) -> None:
    """Create the file, or put these bytes or the content of another file in its place; they are on the disk then.

    If not `surely`, a power cut may bring the bytes back that stood there before (or no file), but never half of them.
    Raises OSError.
    """
    unfinished = (scratch or path.parent) / f".{secrets.token_hex(8)}.new"
    try:
        write_new(unfinished, data)
        unfinished.replace(path)
    except OSError:
        remove_if_possible(unfinished)
        raise
    if surely:
        sync_folder(path.parent)


def remove_if_possible(path: Path) -> None:
    """Remove an unfinished file. If it cannot be removed now, it does no harm: the next start removes it."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def _is_folder(path: Path) -> bool:
    """Unlike `Path.is_dir`, this does not take a path that cannot be accessed for a missing one."""
    try:
        os.stat(path)
    except FileNotFoundError:
        return False
    return True
