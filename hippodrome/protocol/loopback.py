"""Addresses of the same machine."""

from __future__ import annotations

from urllib.parse import urlsplit

LOOPBACK = ("127.0.0.1", "localhost", "::1")


def is_loopback(url: str) -> bool:
    """Return whether this address is on the same machine."""
    return urlsplit(url).hostname in LOOPBACK
