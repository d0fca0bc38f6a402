"""A data folder of this machine as a `Store`: each file is a document with one version."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from hippodrome.deployment.aws.object_version import Version
from hippodrome.protocol import disk

SCRATCH = ".erase"
"""The folder for files that are being written."""
_UNFINISHED = re.compile(r"\.[0-9a-f]{16}\.new")  # as `protocol/disk.py` names a file that is being written


class DataFolder:
    """The files of a data folder, which only one process may change. Implements `Store`."""

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()

    def versions(self, prefix: str) -> Iterator[Version]:
        return (file for file in self._files(prefix) if not _UNFINISHED.fullmatch(Path(file.key).name))

    def uploads(self, prefix: str) -> Iterator[Version]:
        """Yield the files that a process was writing when it was killed."""
        return (file for file in self._files(prefix) if _UNFINISHED.fullmatch(Path(file.key).name))

    def _files(self, prefix: str) -> Iterator[Version]:
        for top, _, names in os.walk(self.root / prefix.rpartition("/")[0]):
            for name in sorted(names):
                path = Path(top, name)
                key = path.relative_to(self.root).as_posix()
                if key.startswith(prefix):
                    yield Version(key, "", path.stat().st_size, latest=True)

    def read(self, version: Version) -> bytes:
        return (self.root / version.key).read_bytes()

    def fetch(self, version: Version, to: Path) -> None:
        shutil.copyfile(self.root / version.key, to)

    def store(self, key: str, file: Path) -> None:
        self._put(key, file)

    def replace(self, key: str, before: bytes, after: bytes) -> bool:
        if (self.root / key).read_bytes() != before:
            return False
        self._put(key, after)
        return True

    def delete(self, versions: Iterable[Version], note: Callable[[Sequence[Version]], None]) -> None:
        """Delete these files, and folders that become empty."""
        deleted = list(versions)
        for file in deleted:
            path = self.root / file.key
            path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # the first folder that is not empty
                for folder in path.parents:
                    if folder == self.root:
                        break
                    folder.rmdir()
        note(deleted)

    def remove_unfinished(self) -> None:
        """Remove the files that a process was writing when it was killed."""
        shutil.rmtree(self.root / SCRATCH, ignore_errors=True)

    def _put(self, key: str, data: bytes | Path) -> None:
        scratch = self.root / SCRATCH
        scratch.mkdir(exist_ok=True)
        disk.replace(self.root / key, data, scratch)
