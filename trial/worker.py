"""One thread that runs the researcher's code, so that slow or stuck code never holds up the connection."""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")


class Stuck(Exception):
    """The code has not answered in time; it still runs, and nothing behind it will."""


class Worker:
    """Calls functions one after another on a single thread of its own (simulators often demand one thread).

    The thread is a daemon: code that never returns cannot keep the process alive.
    """

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="agent", daemon=True)
        self._thread.start()
        self.busy = False
        """A call was made that has not returned (it may never)."""

    async def call(self, function: Callable[..., T], *args: Any, limit: float | None = None) -> T:
        """The function's result, or the exception it raised.

        Raises Stuck after `limit` seconds.
        """
        loop = asyncio.get_running_loop()
        future: asyncio.Future[T] = loop.create_future()

        def settle(result: T | None, error: BaseException | None) -> None:
            self.busy = False
            if future.done():
                return
            if error is not None:
                future.set_exception(error)
            else:
                future.set_result(result)  # type: ignore[arg-type]

        def job() -> None:
            result: T | None = None
            error: BaseException | None = None
            try:
                result = function(*args)
            except StopIteration as stop:  # cannot travel in a future
                error = RuntimeError("StopIteration")
                error.__cause__ = stop
            except BaseException as raised:  # noqa: BLE001 - SystemExit in a researcher's code is a failure like another
                if isinstance(raised, Exception):
                    error = raised
                else:
                    error = RuntimeError(repr(raised)).with_traceback(raised.__traceback__)
            if not loop.is_closed():
                loop.call_soon_threadsafe(settle, result, error)

        self.busy = True
        self._jobs.put(job)
        if limit is None:
            return await future
        timer = loop.call_later(limit, _expire, future, limit)
        try:
            return await future
        finally:
            timer.cancel()

    def close(self) -> None:
        """Let the thread end when its present call does."""
        self._jobs.put(None)

    def _run(self) -> None:
        while True:
            job = self._jobs.get()
            if job is None:
                return
            job()


def _expire(future: asyncio.Future[Any], limit: float) -> None:
    if not future.done():
        future.set_exception(Stuck(f"no answer within {limit:g} s"))
