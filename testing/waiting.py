"""Waits for a condition instead of a fixed time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
PATIENCE = 60.0  # seconds: a machine may have much else to do


def until(look: Callable[[], T], seconds: float = PATIENCE) -> T:
    """Return the first true result of `look`. Raises AssertionError with the last result after so many seconds."""
    end = time.monotonic() + seconds
    while not (found := look()):
        assert time.monotonic() < end, f"waited in vain; the last look: {found!r}"
        time.sleep(0.02)
    return found


async def until_async(look: Callable[[], T], seconds: float = PATIENCE) -> T:
    """Do as `until` does, while the event loop goes on."""
    end = time.monotonic() + seconds
    while not (found := look()):
        assert time.monotonic() < end, f"waited in vain; the last look: {found!r}"
        await asyncio.sleep(0.01)
    return found
