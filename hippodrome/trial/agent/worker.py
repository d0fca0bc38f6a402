"""The agent's thread: it runs the researcher's code, so that slow code never blocks the event loop."""

from __future__ import annotations

import asyncio
import contextlib
import queue
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, TypeVar

from hippodrome.trial.core.effects import AgentTimeout

T = TypeVar("T")

Done = Callable[[Any, Exception | None], None]
"""A function that gets another function's result, or None and the exception that it raised."""


@dataclass(eq=False, slots=True)
class _Job:
    """A function that was given to the thread. `done` gets its result. It is late at `until`, by the loop's clock."""

    done: Done
    until: float
    limit: float


class Worker:
    """Calls functions one after another on one thread of its own, since many simulators must stay on one thread.

    The thread is a daemon: code that never returns cannot keep the process alive.
    """

    def __init__(self, name: str = "agent") -> None:
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()
        self._unfinished = 0  # functions that have not returned
        self._waiting: dict[_Job, None] = {}  # unfinished functions that are not late; a dict keeps the order
        self._timer: asyncio.TimerHandle | None = None  # one for all functions, since most return before their limit

    @property
    def busy(self) -> bool:
        """Whether a function has not returned yet. It may never return."""
        return self._unfinished > 0

    def submit(self, function: Callable[[], Any], limit: float, done: Done) -> None:
        """Call the function on the thread, then `done` on the event loop with its result or exception.

        If the function has not returned after `limit` seconds, `done` gets an AgentTimeout instead, whose traceback
        ends in the line in which the thread was then. `done` is called exactly once. `submit` must be called from the
        event loop.
        """
        loop = asyncio.get_running_loop()
        job = _Job(done, loop.time() + limit, limit)

        def run() -> None:
            result, error = _call(function)
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self._returned, job, result, error)

        self._unfinished += 1
        self._waiting[job] = None
        if self._timer is None or job.until < self._timer.when():
            self._wake_at(loop, job.until)
        self._jobs.put(run)

    def _returned(self, job: _Job, result: Any, error: Exception | None) -> None:
        self._unfinished -= 1
        if job in self._waiting:
            del self._waiting[job]
            job.done(result, error)

    def _wake_at(self, loop: asyncio.AbstractEventLoop, when: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = loop.call_at(when, self._give_up_late, loop)

    def _give_up_late(self, loop: asyncio.AbstractEventLoop) -> None:
        """Call `done` of each function that is late, and set the timer for the next limit."""
        self._timer = None
        now = loop.time()
        late = [job for job in self._waiting if job.until <= now]
        for job in late:
            del self._waiting[job]
        if self._waiting:
            self._wake_at(loop, min(job.until for job in self._waiting))
        for job in late:
            error = AgentTimeout(f"no answer within {job.limit:g} s")
            job.done(None, error.with_traceback(self._where()))

    def _where(self) -> TracebackType | None:
        """Return the present stack of the function that the thread runs, as the traceback of an error raised there."""
        frame = sys._current_frames().get(self._thread.ident or 0)
        found: TracebackType | None = None
        while frame is not None and frame.f_code is not _call.__code__:
            found = TracebackType(found, frame, frame.f_lasti, frame.f_lineno or 0)
            frame = frame.f_back
        return None if frame is None else found

    async def call(self, function: Callable[[], T], *, limit: float) -> T:
        """Call the function on the thread. Return its result, or raise its exception.

        Raises AgentTimeout after `limit` seconds.
        """
        future: asyncio.Future[T] = asyncio.get_running_loop().create_future()

        def done(result: T, error: Exception | None) -> None:
            if future.done():
                return
            if error is not None:
                future.set_exception(error)
            else:
                future.set_result(result)

        self.submit(function, limit, done)
        return await future

    def close(self) -> None:
        """End the thread after its present call."""
        self._jobs.put(None)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()


def _call(function: Callable[[], Any]) -> tuple[Any, Exception | None]:
    """Call the function. Return its result and None, or None and its exception; for SystemExit, a RuntimeError."""
    try:
        return function(), None
    except StopIteration as error:  # a coroutine cannot raise it
        failure = RuntimeError("StopIteration")
        failure.__cause__ = error
        return None, failure
    except Exception as error:  # noqa: BLE001 - the researcher's code may raise anything
        return None, error
    except BaseException as error:  # noqa: BLE001 - as above
        ended = RuntimeError(repr(error)).with_traceback(error.__traceback__)
        ended.__cause__ = error.__cause__
        return None, ended
