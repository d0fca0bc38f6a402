"""The interface of a storage from which documents are erased: a versioned bucket, or a data folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

from deploy.aws.versions import Version

AT_ONCE = 10  # documents that are read at the same time
Note = Callable[[Sequence[Version]], None]
"""Gets the versions that were deleted."""


class Storage(Protocol):
    """`VersionedBucket` or `DataFolder`. All methods may be called from several threads."""

    def versions(self, prefix: str) -> Iterator[Version]:
        """Every version and delete marker whose key has this prefix."""

    def versions_of(self, key: str) -> Iterator[Version]:
        """Every version and delete marker of one document."""

    def uploads(self, prefix: str) -> Iterator[Version]:
        """Every unfinished upload whose key has this prefix."""

    def read(self, version: Version) -> bytes:
        """The content of a version; empty if it is gone or is a delete marker."""

    def fetch(self, version: Version, to: Path) -> None:
        """Write the content of a version into a file."""

    def store(self, key: str, file: Path) -> None:
        """Store a file's content as the newest version, whole or not at all."""

    def replace(self, key: str, before: bytes, after: bytes) -> bool:
        """Store a small document if its newest version is still `before`; return whether it was so."""

    def delete(self, versions: Iterable[Version], note: Note) -> object:
        """Delete these versions for good."""


def read_all(storage: Storage, versions: Sequence[Version]) -> list[bytes]:
    """The contents of these versions, in their order. Reads several at the same time."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return list(pool.map(storage.read, versions))


def newest(storage: Storage, key: str) -> Version | None:
    """The newest version of a document; None if the document does not exist or was deleted."""
    return next((each for each in storage.versions_of(key) if each.latest and not each.marker), None)


def older(storage: Storage, key: str) -> list[Version]:
    """All versions of a document but the newest; if the newest is a delete marker, all of them."""
    versions = [*storage.versions_of(key)]
    deleted = any(each.latest and each.marker for each in versions)
    return [each for each in versions if deleted or not each.latest]
