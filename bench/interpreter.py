"""Which Python runs, and how fast it is.

Builds of one version differ by a fifth: with or without profile-guided optimisation, which the image's Python has
(`--enable-optimizations`; docs.python.org, "Configure Python"). So a figure of processor time says which one it is of.
"""

from __future__ import annotations

import platform
import time

TURNS = 50_000
TIMES = 5


class _Counted:
    def __init__(self, number: int) -> None:
        self.number = number

    def next(self) -> int:
        return self.number + 1


def interpreter() -> dict[str, str | float]:
    """What to print beside processor times: the version, and what one turn of a plain loop costs it here."""
    return {"Python": platform.python_version(), "a turn of a plain loop of it, ns": min(_turn() for _ in range(TIMES))}


def _turn() -> float:
    """Nanoseconds of processor time in which an object is made, called, and noted."""
    noted: dict[int, int] = {}
    begun = time.process_time_ns()
    for number in range(TURNS):
        noted[number % 100] = _Counted(number).next()
    return (time.process_time_ns() - begun) / TURNS
