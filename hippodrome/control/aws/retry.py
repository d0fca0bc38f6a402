"""Repeats calls that AWS refuses while it is busy with another change, or whose response is cut off.

Route 53 refuses concurrent changes of a hosted zone with PriorRequestNotComplete; its API Reference asks to retry "in
intervals of increasing duration". The queue would deliver the message again as well, but only after its visibility
timeout, and a participant waits for that DNS record. The retries end well before the function's timeout of 60 seconds,
so that the function can still report the messages that it has not handled.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import TypeVar

from hippodrome.control.ports import ServiceBusy

T = TypeVar("T")
MAX_TRIES = 20
FIRST, LONGEST = 0.5, 4.0  # seconds: the first interval, and the longest; each wait is a random part of one
MAX_SECONDS = 30.0  # the most that all tries and waits take together


def retry_while_busy(
    call: Callable[[], T],
    busy: Callable[[Exception], bool],
    sleep: Callable[[float], None] = time.sleep,
    chance: Callable[[], float] = random.random,
    clock: Callable[[], float] = time.monotonic,
) -> T:
    """Return the result of `call`; repeat it as long as it raises an exception for which `busy` returns True.

    Raises `ServiceBusy` after `MAX_TRIES` or `MAX_SECONDS`, and any other exception at once.
    """
    ends = clock() + MAX_SECONDS
    for attempt in range(MAX_TRIES):
        try:
            return call()
        except Exception as error:
            if not busy(error):
                raise
            wait = min(LONGEST, FIRST * 2**attempt) * chance()
            if attempt + 1 == MAX_TRIES or clock() + wait > ends:
                raise ServiceBusy from error
            sleep(wait)
    raise AssertionError
