"""Faults at one call of a port, on the simulated platforms: the call is refused, loses its reply, or is the last one."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple, TypeVar

T = TypeVar("T")


class Crash(BaseException):
    """The function has crashed between two of its lines. A BaseException, so that no handler catches it."""


class Unreachable(ConnectionError):
    """The call was not made, or its reply was lost, so that the function cannot know whether it was made."""


class PortFault(StrEnum):
    """The kinds of faults at a call. Each value completes the sentence "The call …"."""

    ERROR = "is refused"
    REPLY = "is made and its reply lost"
    CRASH_BEFORE = "is never made: crash"
    CRASH_AFTER = "is the last: crash"
    WAIT = "is not made yet"


class FaultAt(NamedTuple):
    """A fault, and the number of the call at which it happens, counted from 1."""

    call: int
    fault: PortFault

    def __repr__(self) -> str:
        return f"<call {self.call} {self.fault}>"


def call_with_fault(action: str, effect: Callable[[], T], fault: PortFault | None) -> T:
    """Make a call with this fault; return what `effect` returns.

    Raises Crash or Unreachable, as the fault says. An exception of `effect` is a reply of the port, too, so it may be
    lost.
    """
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
