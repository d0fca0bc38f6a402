"""Gives a data folder of this machine the interface `Storage`: each file is a document with one version."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from hippodrome.deployment.aws.object_version import Version
from hippodrome.deployment.operate.storage import Note
from hippodrome.export.fetch import remove_empty
from hippodrome.protocol import disk

SCRATCH = ".erase"
"""The folder for files that are being written."""


class DataFolder:
    """The files of a data folder, which only one process may change."""

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()

    def versions(self, prefix: str) -> Iterator[Version]:
        """Yield every file whose key has this prefix."""
        for top, _, names in os.walk(self.root / prefix.rpartition("/")[0]):
            for name in sorted(names):
                key = Path(top, name).relative_to(self.root).as_posix()
                if key.startswith(prefix):
                    yield self._version(key)

    def versions_of(self, key: str) -> Iterator[Version]:
        """Yield the file with this key, if there is one."""
        if (self.root / key).is_file():
            yield self._version(key)

    def uploads(self, prefix: str) -> Iterator[Version]:
        """Yield nothing: on one machine a file appears whole, so there are no unfinished uploads."""
        return iter(())

    def read(self, version: Version) -> bytes:
        """Read the file's content; empty if the file is gone."""
        with contextlib.suppress(FileNotFoundError):
            return (self.root / version.key).read_bytes()
        return b""

    def fetch(self, version: Version, to: Path) -> None:
        """Copy the file."""
        shutil.copyfile(self.root / version.key, to)

    def store(self, key: str, file: Path) -> None:
        """Replace a file's content by that of `file`. The new content is on the disk before the name leads to it."""
        self._put(key, file)

    def replace(self, key: str, before: bytes, after: bytes) -> bool:
        """Write a small document if it is still `before`. Return whether it was written."""
        if (self.root / key).read_bytes() != before:
            return False
        self._put(key, after)
        return True

    def delete(self, versions: Iterable[Version], note: Note = lambda _: None) -> int:
        """Delete these files, and folders that become empty."""
        deleted = list(versions)
        for file in deleted:
            path = self.root / file.key
            path.unlink(missing_ok=True)
            remove_empty(path.parent, self.root)
        note(deleted)
        return len(deleted)

    def remove_unfinished(self) -> None:
        """Remove the files that a process was writing when it was killed."""
        shutil.rmtree(self.root / SCRATCH, ignore_errors=True)

    def _version(self, key: str) -> Version:
        return Version(key, "", (self.root / key).stat().st_size, latest=True)

    def _put(self, key: str, data: bytes | Path) -> None:
        scratch = self.root / SCRATCH
        scratch.mkdir(exist_ok=True)
        disk.replace(self.root / key, data, scratch)
