"""The stages that `stop`, `erase` and `destroy` share, and the one executor that runs them, which `apply` uses, too.

look      what exists; changes nothing
plan      what was found → a list of steps: plain data, in the order in which they are to be done; may be empty
execute   each step, in this order; `retry` repeats a step whose failure passes, `wait` waits for a slow one
verify    look again: if something is found, plan and execute again, until a look finds nothing or time is over

Nothing is remembered between two runs. A run that was cut off anywhere is simply repeated: its look finds what is left.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from hippodrome.console import screen

F = TypeVar("F")  # what a look finds; false if there is nothing
R = TypeVar("R")
PAUSE = 3.0  # seconds between two looks


@dataclass(frozen=True)
class PlanStep:
    """One instruction of a plan: an operation and its arguments."""

    operation: Callable[..., object]
    arguments: tuple[Any, ...] = ()


def step(operation: Callable[..., object], *arguments: Any) -> PlanStep:
    """Make the instruction to call `operation` with these arguments."""
    return PlanStep(operation, arguments)


class Executor:
    """Runs steps. `clock` and `sleep` are for tests."""

    def __init__(
        self, sleep: Callable[[float], None] | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._given_sleep = sleep
        self._clock = clock

    def sleep(self, seconds: float) -> None:
        """Wait for so many seconds."""
        (self._given_sleep or time.sleep)(seconds)

    def execute(self, steps: Sequence[PlanStep], note: Callable[[Exception], None] | None = None) -> None:
        """Execute the steps in their order.

        With `note` they are independent: `note` gets the exception of a step that fails, and the next step follows.
        """
        for step in steps:
            try:
                step.operation(*step.arguments)
            except Exception as error:
                if note is None:
                    raise
                note(error)

    def converge(
        self,
        look: Callable[[], F],
        plan: Callable[[F], Sequence[PlanStep]],
        *,
        note: Callable[[Exception], None] | None = None,
        rounds: int | None = None,
        seconds: float | None = None,
        pause: float | None = None,
    ) -> F:
        """Look, execute the plan and look again, until a look finds nothing; return what the last look found.

        Ends after `rounds` plans, or when `seconds` are over; the first plan is executed in any case. With `pause=0`
        the next round begins with what the last look found. If something was found and its plan is empty, this only
        waits until a look finds nothing.
        """
        timer, executed, state = self.timer(), 0, look()
        while state:
            if steps := plan(state):
                self.execute(steps, note)
                executed += 1
                state = look()
            if not state or executed == rounds or timer.over(seconds):
                break
            if pause != 0 or not steps:
                timer.sleep(PAUSE if pause is None else pause)
                state = look()
        return state

    def wait(self, look: Callable[[], F], seconds: float, *, pause: float | None = None, title: str = "") -> F:
        """Look until nothing is found, or `seconds` are over; return what the last look found.

        With `title` a progress bar is shown from the first look that finds something.
        """
        timer, state = self.timer(), look()
        if not state:
            return state
        with contextlib.ExitStack() as stack:
            if title:
                stack.enter_context(screen.ProgressBars()).add_task(title, total=None)
            while state and not timer.over(seconds):
                timer.sleep(PAUSE if pause is None else pause)
                state = look()
        return state

    def retry(self, act: Callable[[], R], recover: Callable[[Exception], bool], tries: int) -> R:
        """Call `act` until it succeeds, `tries` times at most, and return its result.

        `recover` gets the exception of a try that failed. It removes the cause and returns True; if it cannot, it
        returns False, and the exception is raised. The exception of the last try is raised, too.
        """
        for _ in range(tries - 1):
            try:
                return act()
            except Exception as error:
                if not recover(error):
                    raise
        return act()

    def timer(self) -> Timer:
        """Make a timer, which begins now."""
        return Timer(self._clock, self.sleep)


class Timer:
    """Measures seconds: by the clock, or by the sum of all sleeps if that is more, as with a test's `sleep`."""

    def __init__(self, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        self._clock = clock
        self._sleep = sleep
        self._began = clock()
        self._slept = 0.0

    def sleep(self, seconds: float) -> None:
        self._sleep(seconds)
        self._slept += seconds

    @property
    def elapsed(self) -> float:
        """The seconds since it was made."""
        return max(self._clock() - self._began, self._slept)

    def over(self, seconds: float | None) -> bool:
        return seconds is not None and self.elapsed >= seconds
