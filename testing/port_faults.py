"""What can go wrong at one call of a port, on the simulated platforms: the call is refused, is the last, or loses its reply.

`testing/aws_faults.py` injects below botocore, in HTTP; `testing/os_faults.py` injects at the system's calls.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple, TypeVar

T = TypeVar("T")


class Crash(BaseException):
    """The function is gone, between two of its lines. Nothing catches it."""


class Unreachable(ConnectionError):
    """The call was not made, or the function cannot know whether it was."""


class PortFault(StrEnum):
    """What happens at a call."""

    ERROR = "is refused"
    REPLY = "is made and its reply lost"
    CRASH_BEFORE = "is never made: crash"
    CRASH_AFTER = "is the last: crash"
    WAIT = "is not made yet"


class FaultAt(NamedTuple):
    """What happens to a function at the n-th call that it makes, from 1."""

    call: int
    fault: PortFault

    def __repr__(self) -> str:
        return f"<call {self.call} {self.fault}>"


def call_with_fault(action: str, effect: Callable[[], T], fault: PortFault | None) -> T:
    """Make a call with this fault. Raises Crash or Unreachable as it says. A refusal is an answer too, and may be lost."""
    if fault is PortFault.CRASH_BEFORE:
        raise Crash(action)
    if fault is PortFault.ERROR:
        raise Unreachable(action)
    try:
        return effect()
    finally:
        if fault is PortFault.CRASH_AFTER:
            raise Crash(action)
        if fault is PortFault.REPLY:
            raise Unreachable(action)
