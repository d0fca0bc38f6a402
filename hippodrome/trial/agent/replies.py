"""Calls the agent's `reply` and `moderate`, each on a thread of its own, one line after another.

They may take longer than a frame, so neither the game nor the event loop waits for them. All methods are for the event
loop, unless their docstring says otherwise.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hippodrome.trial.agent.worker import Worker
from hippodrome.trial.core.effects import AgentTimeout, AskReply, Moderate
from hippodrome.trial.core.talk import MAX_SAID, Talk

log = logging.getLogger("trial")

REPLY_SECONDS = 120.0
"""A reply that takes longer is given up."""
MODERATE_SECONDS = 2.0
"""A line is held back if `moderate` takes longer."""
_GROW_SECONDS = 0.1  # the pause between two messages with a growing line
_MAX_STUCK = 5  # threads that have not returned; then nothing is asked until one does
_MAX_UNSAID = 50  # lines of `session.say` that wait for the event loop; then the agent waits

Reply = Callable[[Any, str, str], Any]
"""`reply(session, player, text)`: returns None or a text, or yields texts."""


class NoChat(RuntimeError):
    """The agent speaks in a game in which nobody talks."""


def _no_model(text: str, **parameters: Any) -> str:
    raise NoChat("there is no model to ask: config.yml has no llm")


@dataclass(frozen=True, slots=True)
class TalkOfAgent:
    """What a `Session` gives the agent for its talk. All functions are for any thread."""

    options: Mapping[str, Any] = field(default_factory=dict)
    """The section `options` of the trial, filled in."""
    lines: Callable[[str | None, int | None], list[dict[str, Any]]] = lambda player, n: []
    """Returns the lines that a player may read; with None, all lines. With the number of the line to answer, without
    what came after it, and with that line as the last one."""
    say: Callable[..., None] | None = None
    """None if nobody talks in this game."""
    ask: Callable[..., str] = _no_model


class Mouth:
    """`session.say`: brings what the agent says, on any thread, to the event loop."""

    def __init__(self, talk: Callable[[], Talk | None], say: Callable[[str, Sequence[str] | None, str | None], None]):
        self._talk = talk
        self._say = say
        self._loop = asyncio.get_running_loop()
        self._room = threading.Semaphore(_MAX_UNSAID)

    def lines(self, player: str | None, n: int | None) -> list[dict[str, Any]]:
        """Return the lines so far, as `TalkOfAgent.lines` says. For any thread."""
        talk = self._talk()
        lines = [] if talk is None else talk.lines_of(player, n)
        return [{"by": line.by, "text": line.text, "episode": line.episode, "step": line.step} for line in lines]

    def say(self, text: str, to: str | Sequence[str] | None = None, by: str | None = None) -> None:
        """Say a line to these players, or to all. For any thread. Raises ValueError and TypeError."""
        talk = self._talk()
        if talk is None:
            raise NoChat("nobody talks in this game: write chat: true in the section trial of config.yml")
        if not isinstance(text, str):
            raise TypeError(f"say(text) takes a text, not {type(text).__name__}")
        readers = (to,) if isinstance(to, str) else None if to is None else tuple(to)
        for name in readers or ():
            if name not in talk.people:
                raise ValueError(f"nobody is called {name!r:.80}; there are {', '.join(talk.people)}")
        if by is not None and (not isinstance(by, str) or not 0 < len(by) <= 64 or by in talk.people):
            raise ValueError(f"the agent cannot speak as {by!r:.80}: that is a participant, or no name")
        if self._room.acquire(timeout=1.0):
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._said, text[: 2 * MAX_SAID], readers, by)

    def _said(self, text: str, to: Sequence[str] | None, by: str | None) -> None:
        self._room.release()
        self._say(text, to, by)


class Replies:
    """Asks `reply` and `moderate`.

    `session` makes, on any thread, the session for a call of this name about a player's line. `grows`, `ended` and
    `moderated` are told what they say. `failed` gets the name and the error of a call that raised or was given up.
    """

    def __init__(
        self,
        reply: Reply | None,
        moderate: Reply | None,
        session: Callable[[str, str, int | None], Any],
        *,
        grows: Callable[[int, str], None],
        ended: Callable[[int, str | None], None],
        moderated: Callable[[int, str | bool | None], None],
        failed: Callable[[str, Exception], None],
        fallback: str | None = None,
    ) -> None:
        """`fallback`: what the agent says instead of a reply that raises or takes too long; None: nothing."""
        self.reply = reply
        self.moderate = moderate
        self.fallbacks = 0
        """The number of lines that the fallback has answered."""
        self.answering: int | None = None
        """The number of the line that `reply` answers now; None if it answers none. For any thread."""
        self._session = session
        self._grows = grows
        self._ended = ended
        self._moderated = moderated
        self._failed = failed
        self._fallback = fallback
        self._loop = asyncio.get_running_loop()
        self._replies = _Queue("reply", REPLY_SECONDS)
        self._moderations = _Queue("moderate", MODERATE_SECONDS)

    @property
    def busy(self) -> bool:
        """Whether a call has not returned, and may never."""
        return self._replies.busy or self._moderations.busy

    def ask(self, effect: AskReply) -> None:
        """Ask `reply`, after the lines before."""
        reply = self.reply
        assert reply is not None
        said: list[str] = []

        def ended(text: str | None, error: Exception | None) -> None:
            self.answering = None
            if error is not None:
                self._failed("reply", error)
                text = "".join(said)
                if not text and self._fallback is not None:
                    self.fallbacks += 1
                    text = self._fallback
            self._ended(effect.ask_id, text)

        self._replies.add(lambda: self._reply(reply, effect, said), ended)

    def _reply(self, reply: Reply, effect: AskReply, said: list[str], *, grows: bool = True) -> str | None:
        """Call `reply` on its thread; collect in `said` what it yields."""
        self.answering = effect.n
        result = reply(self._session("reply", effect.player, effect.n), effect.player, effect.text)
        if result is None or isinstance(result, str):
            return None if result is None else result[: 2 * MAX_SAID]
        length, grown = 0, 0.0
        for piece in result:
            if piece is None:
                continue
            if not isinstance(piece, str):
                raise TypeError(f"reply yields texts, not {type(piece).__name__}")
            said.append(piece[:MAX_SAID])
            length += len(said[-1])
            if length >= MAX_SAID:
                break
            if grows and time.monotonic() - grown >= _GROW_SECONDS:
                grown = time.monotonic()
                with contextlib.suppress(RuntimeError):  # the loop has ended
                    self._loop.call_soon_threadsafe(self._grows, effect.ask_id, "".join(said))
        return "".join(said)

    def repeat(self, effect: AskReply) -> None:
        """Call `reply` again for a line that an earlier server's agent has answered, and drop what it says.

        For the agent's thread, while steps are taken again.
        """
        if self.reply is None:
            return
        try:
            self._reply(self.reply, effect, [], grows=False)
        except Exception as error:  # noqa: BLE001 - the researcher's code may raise anything
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._failed, "reply", error)
        finally:
            self.answering = None

    def check(self, effect: Moderate) -> None:
        """Ask `moderate` about a line, after the lines before."""
        moderate = self.moderate
        assert moderate is not None

        def ended(result: str | bool | None, error: Exception | None) -> None:
            if error is not None:
                self._failed("moderate", error)
                result = False  # nobody reads a line that the study has not judged
            self._moderated(effect.ask_id, result)

        def call() -> str | bool | None:
            result = moderate(self._session("moderate", effect.player, None), effect.player, effect.text)
            if result is None or result is False or isinstance(result, str):
                return result
            raise TypeError(f"moderate returns None, a text or False, not {type(result).__name__}")

        self._moderations.add(call, ended)

    def close(self) -> None:
        """End the threads after their present calls."""
        self._replies.close()
        self._moderations.close()


class _Queue:
    """Calls functions one after another on a thread, for `limit` seconds each. It leaves a thread that is stuck."""

    def __init__(self, name: str, limit: float) -> None:
        self._name = name
        self._limit = limit
        self._worker: Worker | None = None
        self._waiting: deque[tuple[Callable[[], Any], Callable[[Any, Exception | None], None]]] = deque()
        self._left: list[Worker] = []

    @property
    def busy(self) -> bool:
        return bool(self._stuck() or (self._worker is not None and self._worker.busy))

    def _stuck(self) -> int:
        """Return how many threads that were left have not returned yet."""
        self._left = [worker for worker in self._left if worker.busy]
        return len(self._left)

    def add(self, function: Callable[[], Any], done: Callable[[Any, Exception | None], None]) -> None:
        if self._stuck() >= _MAX_STUCK:
            done(None, AgentTimeout(f"{self._name} is not called: {_MAX_STUCK} calls have not returned"))
            return
        self._waiting.append((function, done))
        if len(self._waiting) == 1:
            self._next()

    def _next(self) -> None:
        if self._worker is None:
            self._worker = Worker(self._name)
        self._worker.submit(self._waiting[0][0], self._limit, self._returned)

    def _returned(self, result: Any, error: Exception | None) -> None:
        if isinstance(error, AgentTimeout) and self._worker is not None:
            self.close()
            self._left.append(self._worker)
            self._worker = None
        _, done = self._waiting.popleft()
        done(result, error)
        if self._stuck() >= _MAX_STUCK:
            while self._waiting:
                self._waiting.popleft()[1](None, error)
        elif self._waiting:
            self._next()

    def close(self) -> None:
        if self._worker is not None:
            self._worker.close()
