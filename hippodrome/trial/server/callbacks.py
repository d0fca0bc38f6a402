"""Calls the agent's callbacks when participants come, leave and return, and orders the lines that callbacks record.

The methods of `TrialCallbacks` are called on the event loop. The work that they submit runs on the agent's thread.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable
from typing import Any

from hippodrome.trial.agent.callbacks import Callbacks
from hippodrome.trial.agent.worker import Worker
from hippodrome.trial.core.effects import TellAgent

_EVENTS = 4  # if so many events wait, a return removes the leave that still waits before it


class TrialCallbacks:
    """Tells the agent's callbacks what participants do (come, go, return, fill in a form), and writes their lines."""

    def __init__(
        self,
        worker: Worker,
        limit: float,
        write: Callable[[bytes], None],
        *,
        is_open: Callable[[], bool],
        is_over: Callable[[], bool],
    ) -> None:
        """`limit`: seconds for the callback of one move. `write` writes a line to the recording, if one `is_open`.

        `is_over` returns whether the trial is over.
        """
        self._worker = worker
        self._limit = limit
        self._is_over = is_over
        self._write = write
        self._is_open = is_open
        self._loop = asyncio.get_running_loop()
        self._callbacks: Callbacks | None = None
        self._recorded = 0  # the number of lines that callbacks had recorded at the end of the last work that is done
        self._events: deque[TellAgent] = deque()  # that are not told yet; a callback is being told of the first

    @property
    def busy(self) -> bool:
        """Whether a callback has not returned, and may never."""
        return self._callbacks is not None and self._callbacks.busy

    def begin(self, callbacks: Callbacks) -> None:
        """Use the callbacks of the agent, which has started."""
        self._callbacks = callbacks

    def close(self) -> None:
        """End the callbacks' thread, because the trial is over."""
        if self._callbacks:
            self._callbacks.close()

    def on_agent(self, work: Callable[[], Any], limit: float, done: Callable[[Any, Exception | None], None]) -> None:
        """Do `work` on the agent's thread, and call `done` with its result, or with None and its error.

        The error is AgentTimeout if the work has not returned after `limit` seconds.

        The thread may do the next work already when `done` is called. So the lines that callbacks have recorded by the
        end of this work are counted, and `write_lines` writes only these.
        """

        def finished(outcome: tuple[Any, int] | None, error: Exception | None) -> None:
            result, self._recorded = outcome or (None, self._recorded_now())
            done(result, error)

        self._worker.submit(lambda: (work(), self._recorded_now()), limit, finished)

    def write_lines(self) -> None:
        """Write the lines that callbacks had recorded by the end of the last finished work, if a recording is open."""
        if self._callbacks and self._is_open():
            for line in self._callbacks.take(self._recorded):
                self._write(line)

    def late(self, recorded: int) -> None:
        """Write the lines of a callback for which the game did not wait. Called on the callbacks' thread.

        `recorded`: the number of lines that callbacks had recorded when it returned.
        """
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._write_late, recorded)

    def tell_agent(self, effect: TellAgent) -> None:
        """Tell a callback of an event, on the agent's thread, between two calls of the agent.

        The events are told one by one. If `_EVENTS` wait, a participant who has left and returned counts as not having
        moved.
        """
        events = self._events
        if not self._callbacks:
            return
        if effect.callback == "on_return" and len(events) >= _EVENTS:
            before = max((index for index, event in enumerate(events) if event.player == effect.player), default=0)
            if before > 0 and events[before].callback == "on_leave":
                del events[before]
                return
        events.append(effect)
        if len(events) == 1:
            self._tell_next()

    def _tell_next(self) -> None:
        callbacks, event = self._callbacks, self._events[0]
        assert callbacks is not None
        self.on_agent(lambda: callbacks.of_player(event.callback, event.player, event.fields), self._limit, self._told)

    def _told(self, _result: object, _error: Exception | None) -> None:
        self.write_lines()
        self._events.popleft()
        if self._events and not self._is_over():
            self._tell_next()

    def _write_late(self, recorded: int) -> None:
        self._recorded = max(self._recorded, recorded)
        self.write_lines()

    def _recorded_now(self) -> int:
        return self._callbacks.recorded if self._callbacks else 0
