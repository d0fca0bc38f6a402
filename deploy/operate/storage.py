"""Where documents lie that are erased: a bucket with versions (`deploy/aws/versions.py`), or a data folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

from deploy.aws.versions import Version

AT_ONCE = 10  # documents that are read at once
Note = Callable[[Sequence[Version]], None]
"""Is told what was deleted."""


class Storage(Protocol):
    """All methods may be called from several threads."""

    def versions(self, prefix: str) -> Iterator[Version]:
        """Every version and delete marker below a prefix."""

    def versions_of(self, key: str) -> Iterator[Version]:
        """Every version and delete marker of one document."""

    def uploads(self, prefix: str) -> Iterator[Version]:
        """Every unfinished upload below a prefix."""

    def read(self, version: Version) -> bytes:
        """The content of a version; empty if it is gone or is a delete marker."""

    def fetch(self, version: Version, to: Path) -> None:
        """Write the content of a version into a file."""

    def store(self, key: str, file: Path) -> None:
        """Store a file's content as the newest version, whole or not at all."""

    def replace(self, key: str, before: bytes, after: bytes) -> bool:
        """Store a small document if its newest version still is `before`; return whether it was."""

    def delete(self, versions: Iterable[Version], note: Note) -> object:
        """Delete these versions for good."""


def read_all(storage: Storage, versions: Sequence[Version]) -> list[bytes]:
    """The contents of these versions, several read at once."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return list(pool.map(storage.read, versions))


def newest(storage: Storage, key: str) -> Version | None:
    """The newest version of a document; None if there is none, or it was deleted."""
    return next((each for each in storage.versions_of(key) if each.latest and not each.marker), None)


def older(storage: Storage, key: str) -> list[Version]:
    """All versions but the newest; all of them if that one is a delete marker."""
    there = [*storage.versions_of(key)]
    deleted = any(each.latest and each.marker for each in there)
    return [each for each in there if deleted or not each.latest]
