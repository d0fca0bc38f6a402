"""A version of an object: of a versioned bucket, or the one that a data folder has."""

from __future__ import annotations

from typing import NamedTuple


class Version(NamedTuple):
    """A version or delete marker of an object, or an unfinished upload (`upload` is its id).

    `latest`: whether it is the version that GetObject returns.
    """

    key: str
    id: str
    size: int = 0
    marker: bool = False
    upload: str = ""
    latest: bool = False
