"""Waiting a little where AWS says that it is busy with something else of ours, or where an answer breaks off.

Changes of a hosted zone that meet are refused with PriorRequestNotComplete; Route 53's API Reference asks to wait "in
intervals of increasing duration" then. The queue would bring the message again too, but only after its visibility
timeout, and a participant waits for that name. The waiting ends well before the function's timeout of 60 seconds, so
that the function can still say what it has not done.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import TypeVar

from hippodrome.ports import Busy

T = TypeVar("T")
TRIES = 20
FIRST, LONGEST = 0.5, 4.0  # seconds; a random part of each interval is waited
PATIENCE = 30.0  # seconds, the tries included, after which it is not tried again


def patiently(
    act: Callable[[], T],
    busy: Callable[[Exception], bool],
    sleep: Callable[[float], None] = time.sleep,
    chance: Callable[[], float] = random.random,
    clock: Callable[[], float] = time.monotonic,
) -> T:
    """The result of `act`, tried again while it fails in a way that is `busy`. Raises `Busy` when patience is over."""
    ends = clock() + PATIENCE
    for attempt in range(TRIES):
        try:
            return act()
        except Exception as error:
            if not busy(error):
                raise
            wait = min(LONGEST, FIRST * 2**attempt) * chance()
            if attempt + 1 == TRIES or clock() + wait > ends:
                raise Busy from error
            sleep(wait)
    raise AssertionError
