"""The source of data: an installation's bucket, or a folder that `run` has filled. Both have the same keys."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from hippodrome.console.problem import Problem
from hippodrome.export.keys import Listed

PARALLEL = 10  # requests at once: the number of connections in botocore's pool for a client
_PIECE = 256 * 1024  # bytes


class FileGone(Exception):
    """The file was deleted or changed after it was listed."""


class TooLarge(Exception):
    """A document is larger than the caller allows."""


class Source(Protocol):
    """A bucket or a folder. Several threads may call its methods at once, except `list`."""

    @property
    def where(self) -> str:
        """The kind of the source, and the name of a bucket, for the manifest: `bucket …` or `folder`."""

    @property
    def place(self) -> str:
        """A text that differs between all sources: for a folder, it has the path."""

    def list(self, prefix: str) -> Iterator[Listed]:
        """Yield all files whose keys begin with `prefix`; the files of one participant stand together."""

    def read(self, key: str, most: int) -> bytes:
        """Return a document. Raises FileGone, and TooLarge if it has more than `most` bytes."""

    def fetch(self, listed: Listed, to: Path) -> None:
        """Write the listed version of a file into the file `to`. Raises FileGone if it is not there any more."""


class Folder:
    """A folder on this machine. A file's version is its modification time and its size. Symbolic links are not
    followed. Raises `Problem` if there is no such folder."""

    where = "folder"

    def __init__(self, root: Path) -> None:
        if not root.is_dir():
            raise Problem(
                f"There is no folder {root}.", "Name the folder that `hippodrome run` keeps its data in, such as data/."
            )
        self._root = root
        self.place = f"folder {root.resolve()}"

    def list(self, prefix: str) -> Iterator[Listed]:
        top = self._root / prefix
        if top.is_dir():
            yield from self._walk(top, prefix)

    def read(self, key: str, most: int) -> bytes:
        try:
            with (self._root / key).open("rb") as file:
                body = file.read(most + 1)
        except (FileNotFoundError, NotADirectoryError):
            raise FileGone(key) from None
        if len(body) > most:
            raise TooLarge(key)
        return body

    def fetch(self, listed: Listed, to: Path) -> None:
        try:
            with (self._root / listed.key).open("rb") as source, to.open("wb") as file:
                if _version(os.fstat(source.fileno())) != listed.version:
                    raise FileGone(listed.key)
                while piece := source.read(_PIECE):
                    file.write(piece)
        except FileNotFoundError:
            raise FileGone(listed.key) from None

    def _walk(self, folder: Path, key: str) -> Iterator[Listed]:
        with os.scandir(folder) as found:
            entries = sorted(found, key=lambda entry: entry.name)
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                yield from self._walk(Path(entry.path), f"{key}{entry.name}/")
                continue
            try:
                facts = entry.stat(follow_symlinks=False)
            except FileNotFoundError:  # the file was deleted after the scan
                continue
            regular = stat.S_ISREG(facts.st_mode)
            name = entry.name if regular else f"{entry.name} (no regular file)"
            yield Listed(f"{key}{name}", _version(facts), facts.st_size)


def _version(facts: os.stat_result) -> str:
    return f"{facts.st_mtime_ns}-{facts.st_size}"
