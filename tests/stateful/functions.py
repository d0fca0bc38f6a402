"""Lambda functions that may wait at a call while others run: each invocation is a greenlet.

Containers keep between invocations what `hippodrome.functions.installed` makes, as on AWS, and are lost in a crash.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, TypeVar

import greenlet

from hippodrome.functions import installed
from testing import port_faults
from testing.port_faults import Crash, FaultAt, PortFault

T = TypeVar("T")
TIMEOUTS = {"next_step": 29, "relay": 29, "sweep": 240}  # seconds, as in the template
USUAL = 60


@dataclass(repr=False)
class Invocation:
    """One run of a handler."""

    function: str
    about: str
    act: Callable[[], Any]
    done: Callable[[Invocation], None]
    made: dict[Any, Any] = field(repr=False)
    began: datetime
    fault: FaultAt | None = None
    calls: int = 0
    waits_at: str = ""
    answer: Any = None
    error: BaseException | None = None
    greenlet: Any = field(default=None, repr=False)

    @property
    def well(self) -> bool:
        return self.error is None

    def __repr__(self) -> str:
        return f"<{self.function} ({self.about}) before {self.waits_at}>"

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        """Print the object in hypothesis's output."""
        printer.text(repr(self))


class Functions:
    """All functions of the installation."""

    def __init__(self, now: Callable[[], datetime], tell: Callable[[str], None]) -> None:
        self._now, self._tell = now, tell
        self._containers: dict[str, list[dict[Any, Any]]] = {}
        self.platform: Any = None
        self.watch: Callable[[Invocation, str, list[Any]], None] = lambda invocation, action, given: None
        self.disturbed: Callable[[], None] = lambda: None
        self.waiting: list[Invocation] = []

    def invoke(
        self,
        function: str,
        about: str,
        act: Callable[[], Any],
        done: Callable[[Invocation], None],
        fault: FaultAt | None = None,
    ) -> None:
        """Run a handler until it ends or waits; `done` is called when it has ended."""
        free = self._containers.setdefault(function, [])
        made = free.pop() if free else {}
        invocation = Invocation(function, about, act, done, made, self._now(), fault)
        invocation.greenlet = greenlet.greenlet(lambda: self._run(invocation))
        invocation.greenlet.invocation = invocation
        self._switch(invocation)

    def go_on(self, invocation: Invocation, fault: FaultAt | None = None) -> None:
        """Let a waiting function make its call; `fault` counts the calls after that one."""
        self.waiting.remove(invocation)
        invocation.calls, invocation.fault = 0, fault
        self._switch(invocation)

    def kill(self, invocation: Invocation) -> None:
        """End a waiting function."""
        self.waiting.remove(invocation)
        self._switch(invocation, Crash("timeout"))

    def time_out(self) -> None:
        """End the functions that have run longer than their timeout."""
        for invocation in [*self.waiting]:
            age = (self._now() - invocation.began).total_seconds()
            if age >= TIMEOUTS.get(invocation.function, USUAL):
                self._tell(f"{invocation!r}: timeout")
                self.kill(invocation)

    def cool(self) -> None:
        """Remove all containers, with what functions keep between invocations."""
        self._containers.clear()

    def call(self, action: str, given: Any, effect: Callable[[], T]) -> T:
        """One call to the account, by a function or by the test."""
        invocation: Invocation | None = getattr(greenlet.getcurrent(), "invocation", None)
        if invocation is None:
            return effect()
        invocation.calls += 1
        due = invocation.fault
        fault = due.fault if due and due.call == invocation.calls else None
        if fault:
            self.disturbed()
        if fault is PortFault.WAIT:
            invocation.waits_at = action
            self.waiting.append(invocation)
            self._tell(f"{invocation.function} ({invocation.about}) waits before {action}")
            greenlet.getcurrent().parent.switch()
        elif fault:
            self._tell(f"{invocation.function} ({invocation.about}): {action} {fault}")

        def watched() -> T:
            self.watch(invocation, action, given)
            return effect()

        return port_faults.call_with_fault(action, watched, fault)

    def _run(self, invocation: Invocation) -> None:
        try:
            invocation.answer = invocation.act()
        except Crash as crash:
            invocation.error = crash
        except Exception as error:  # noqa: BLE001 - as Lambda does
            invocation.error = error
        if not isinstance(invocation.error, Crash):
            self._containers.setdefault(invocation.function, []).append(invocation.made)

    def _switch(self, invocation: Invocation, error: BaseException | None = None) -> None:
        before = installed._platform, installed._made
        installed._platform, installed._made = self.platform, invocation.made
        invocation.greenlet.parent = greenlet.getcurrent()
        try:
            invocation.greenlet.throw(error) if error else invocation.greenlet.switch()
        finally:
            installed._platform, installed._made = before
        if invocation.greenlet.dead:
            if isinstance(invocation.error, AssertionError):
                raise invocation.error
            invocation.done(invocation)
