"""A policy's thread: it asks the policy for actions, so that a slow policy never blocks the event loop."""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hippodrome.trial.core.players import Mask
from hippodrome.trial.core.policies import Observed
from hippodrome.trial.policies.policy import Policy

Done = Callable[[int, int | None, Exception | None], None]
"""A function that gets the id of a question, and the action, or None and the policy's exception."""


class PolicyThread:
    """Asks one policy, one question after another, on a thread of its own. Its methods are for the event loop.

    The event loop calls `done` once for each question, in their order. The thread is a daemon: a policy that never
    returns delays only its own answers, and cannot keep the process alive.
    """

    def __init__(self, policy: Policy, done: Done, *, name: str = "policy") -> None:
        self.policy = policy
        self._done = done
        self._loop = asyncio.get_running_loop()
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._closed = False
        self._running = False
        self._reset_error: Exception | None = None  # what the latest reset raised; only the thread uses it
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether a method of the policy has not returned yet. It may never return."""
        return self._running

    def ask(self, ask_id: int, observation: Any, info: Mapping[str, Any], mask: Mask | None) -> None:
        """Ask for an action. `done(ask_id, action, error)` is called later, unless `close` is called before."""

        def answer() -> None:
            try:
                if self._reset_error is not None:
                    raise self._reset_error
                action, error = self.policy.act(observation, info, mask), None
            except BaseException as problem:  # noqa: BLE001 - the researcher's code may raise anything
                action, error = None, _plain(problem)
            self._tell(ask_id, action, error)

        self._jobs.put(answer)

    def reset(self, seed: int, observed: Sequence[Observed] = ()) -> None:
        """Begin an episode, or resume it after the choices `observed`, for the questions from now on.

        If the policy's `reset` or `resume` raises, they are answered by its error.
        """

        def begin() -> None:
            try:
                self.policy.reset(seed)
                if observed:
                    self.policy.resume(observed)
                self._reset_error = None
            except BaseException as problem:  # noqa: BLE001 - as above
                self._reset_error = _plain(problem)

        self._jobs.put(begin)

    def close(self) -> None:
        """End the thread after its present question. `done` is not called any more."""
        if not self._closed:
            self._closed = True
            self._jobs.put(None)

    def _tell(self, ask_id: int, action: int | None, error: Exception | None) -> None:
        def tell() -> None:
            if not self._closed:
                self._done(ask_id, action, error)

        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(tell)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            if not self._closed:
                self._running = True
                job()
                self._running = False
        self._running = True
        with contextlib.suppress(BaseException):  # the game is over; nothing depends on how a policy ends
            self.policy.close()
        self._running = False


def _plain(problem: BaseException) -> Exception:
    """Return the exception; a RuntimeError in the place of SystemExit and others that would end the thread."""
    if isinstance(problem, Exception):
        return problem
    return RuntimeError(repr(problem)).with_traceback(problem.__traceback__)
