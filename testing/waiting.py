"""Waiting for a condition, and never for a time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def until(look: Callable[[], T], seconds: float = 20) -> T:
    """What `look` returns once that is true. AssertionError with what it returned last, after so many seconds."""
    end = time.monotonic() + seconds
    while not (found := look()):
        assert time.monotonic() < end, f"waited in vain; the last look: {found!r}"
        time.sleep(0.02)
    return found
