"""The interface of a storage from which documents are erased: a versioned bucket, or a data folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

from hippodrome.deployment.aws.object_version import Version

AT_ONCE = 10  # documents that are read at the same time
Note = Callable[[Sequence[Version]], None]
"""A function that gets the versions that were deleted."""


class Storage(Protocol):
    """A storage: `VersionedBucket` or `DataFolder`. Several threads may call its methods."""

    def versions(self, prefix: str) -> Iterator[Version]:
        """Return every version and delete marker whose key has this prefix."""

    def versions_of(self, key: str) -> Iterator[Version]:
        """Return every version and delete marker of one document."""

    def uploads(self, prefix: str) -> Iterator[Version]:
        """Return every unfinished upload whose key has this prefix."""

    def read(self, version: Version) -> bytes:
        """Return the content of a version; empty if it is gone or is a delete marker."""

    def fetch(self, version: Version, to: Path) -> None:
        """Write the content of a version into a file."""

    def store(self, key: str, file: Path) -> None:
        """Store a file's content as the newest version, whole or not at all."""

    def replace(self, key: str, before: bytes, after: bytes) -> bool:
        """Store a small document if its newest version is still `before`. Return whether it was stored."""

    def delete(self, versions: Iterable[Version], note: Note) -> object:
        """Delete these versions for good."""


def read_all(storage: Storage, versions: Sequence[Version]) -> list[bytes]:
    """Read the contents of these versions, several at the same time, and return them in their order."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return list(pool.map(storage.read, versions))


def newest(storage: Storage, key: str) -> Version | None:
    """Return the newest version of a document; None if the document does not exist or was deleted."""
    return next((version for version in storage.versions_of(key) if version.latest and not version.marker), None)


def older(storage: Storage, key: str) -> list[Version]:
    """Return all versions of a document except the newest; all of them if the newest is a delete marker."""
    versions = [*storage.versions_of(key)]
    deleted = any(version.latest and version.marker for version in versions)
    return [version for version in versions if deleted or not version.latest]
