"""Waiting a little where AWS says that it is busy with something else of ours, or where an answer breaks off.

Changes of a hosted zone that meet are refused with PriorRequestNotComplete; Route 53's API Reference asks to wait "in
intervals of increasing duration" then. The queue would bring the message again too, but only after its visibility
timeout, and a participant waits for that name.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
TRIES = 7
FIRST, LONGEST = 0.5, 4.0  # seconds; a random part of each interval is waited: 9 s in the middle, 17 s at most


def patiently(
    act: Callable[[], T],
    busy: Callable[[Exception], bool],
    sleep: Callable[[float], None] = time.sleep,
    chance: Callable[[], float] = random.random,
) -> T:
    """The result of `act`, tried again while it fails in a way that is `busy`. Raises the last failure."""
    for attempt in range(TRIES - 1):
        try:
            return act()
        except Exception as error:
            if not busy(error):
                raise
        sleep(min(LONGEST, FIRST * 2**attempt) * chance())
    return act()
