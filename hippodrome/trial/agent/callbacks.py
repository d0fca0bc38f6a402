"""Calls callbacks: methods of the researcher's agent for the events of a session, which may record values.

They run on a thread of their own, one after another. The agent's thread waits at most `callbackSeconds` for each, so
that a quick callback reads the environment between two steps. If a callback takes longer, the game goes on meanwhile,
and further callbacks are skipped until it has returned. An exception of a callback never ends the game.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from hippodrome.trial.agent.replies import NoChat, TalkOfAgent
from hippodrome.trial.agent.signatures import (
    EPISODE_END,
    EPISODE_START,
    FEEDBACK,
    NAMES,
    SESSION_END,
    SESSION_START,
    TICK,
)
from hippodrome.trial.core.players import PLAYER
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.recorded_values import text_of

log = logging.getLogger("trial")

MAX_VALUES = 1_000
"""The most values that one call of a callback may record."""
MAX_NAME = 200
"""The most characters of the name of a recorded value."""
_MAX_ERROR = 2_000  # the most characters of an error in the recording
_MAX_WAITING = 100_000  # the most finished lines that wait to be written

Record = Callable[[str, Any], None]


@dataclass(frozen=True, slots=True)
class Session:
    """The state of the session when a callback is called. Mappings are by player.

    `env` is the environment itself. The game waits at most `callbackSeconds` for the callback, and then takes steps.
    """

    trial: str
    step: str
    """The key of the game step in config.yml."""
    group: int | None
    players: tuple[str, ...]
    humans: tuple[str, ...]
    """The players whom participants play."""
    episode: int
    ticks: int
    """The number of steps taken in the episode."""
    actions: Mapping[str, Any]
    """The numbers of the actions in the last step; empty before the first step."""
    rewards: Mapping[str, float]
    observations: Mapping[str, Any]
    infos: Mapping[str, Any]
    scores: Mapping[str, float]
    """The sums of the episode's rewards."""
    why: str | None
    """The end of the episode: terminated, truncated, reset, stopped, failed or turnSeconds; None while it goes on."""
    replaying: bool
    """Whether steps of an earlier server are taken again. Then `record` does nothing: that recording has the values."""
    condition: Mapping[str, str]
    """The levels of the study's factors between people, by factor."""
    run: Mapping[str, Any]
    """The levels of the factors within people, by factor, and the `position` of this run; empty outside of blocks."""
    answers: Mapping[str, Any]
    """The answers to earlier steps that the game's key `answers` names: by step; after a block by step and level. If
    several participants play, each one's stand under their player."""
    env: Any
    record: Record
    """`record(name, value)` writes the value into the recording, under this name."""
    options: Mapping[str, Any]
    """The section `options` of the trial, with its factors filled in."""
    say: Callable[..., None]
    """`say(text, to=None, by=None)` says a line to all, or to the players `to`; `by` is the name of who says it."""
    ask: Callable[..., str]
    """`ask(text, **parameters)` asks the model of `llm`, and returns its answer."""
    _lines: Callable[[], list[dict[str, Any]]] = field(repr=False)

    @property
    def talk(self) -> list[dict[str, Any]]:
        """The lines so far, in order, each with `by`, `text`, `episode` and `step`; in `reply`, those that the player
        has read, the last of which is the line to answer."""
        return self._lines()


@dataclass(frozen=True, slots=True)
class TrialFacts:
    """The facts about a trial that stay the same."""

    trial: str
    step: str
    group: int | None = None
    players: tuple[str, ...] = (PLAYER,)
    humans: tuple[str, ...] = (PLAYER,)
    condition: Mapping[str, str] = field(default_factory=dict)
    run: Mapping[str, Any] = field(default_factory=dict)
    answers: Mapping[str, Any] = field(default_factory=dict)


@dataclass(slots=True)
class _EpisodeState:
    """The state of the episode after its last step."""

    episode: int = 1
    ticks: int = 0
    why: str | None = None
    actions: Mapping[str, Any] = field(default_factory=dict)
    rewards: Mapping[str, float] = field(default_factory=dict)
    observations: Mapping[str, Any] = field(default_factory=dict)
    infos: Mapping[str, Any] = field(default_factory=dict)
    scores: dict[str, float] = field(default_factory=dict)


def listening(agent: Any, names: Collection[str] = NAMES) -> dict[str, Callable[..., Any]]:
    """Return the callbacks of these names that an agent (an object or a module) has."""
    found = {name: getattr(agent, name, None) for name in names}
    return {name: method for name, method in found.items() if callable(method)}


class Callbacks:
    """Calls an agent's callbacks. Methods are for the agent's thread, unless their docstring names another one.

    `stamp` returns the first fields of each line. `hide` removes private words from a text for the recording. The
    callbacks' thread calls `failed` with the name and the error of a callback that raised. It calls `late` with the
    number of lines so far, when a callback returns after the agent's thread has given up waiting for it.
    """

    def __init__(
        self,
        found: Mapping[str, Callable[..., Any]],
        facts: TrialFacts,
        env: Callable[[], Any],
        *,
        seconds: float,
        stamp: Callable[[], dict[str, Any]],
        failed: Callable[[str, BaseException], None],
        hide: Callable[[str], str] = str,
        late: Callable[[int], None] = lambda recorded: None,
        talk: TalkOfAgent | None = None,
    ) -> None:
        """`talk`: what the agent needs to talk, and to ask the game's language model."""
        self._found = found
        self._talks = talk is not None and talk.say is not None
        self._talk = talk or TalkOfAgent()
        self.facts = facts
        self._env = env
        self._seconds = seconds
        self._failed = failed
        self._late = late
        self._notes = _Notes(stamp, failed, hide)
        self._now = _EpisodeState()
        self._started = False
        self._thread: _Thread | None = None
        self.replaying = False
        self.first_late: str | None = None
        """The name of the first callback that took longer than `seconds`."""

    def __bool__(self) -> bool:
        return bool(self._found) or self._talks

    @property
    def busy(self) -> bool:
        """Whether a callback has not returned yet. It may never return."""
        return self._thread is not None and self._thread.running is not None

    # ---- events of the session and the game

    def session_begins(self) -> None:
        """Call `on_session_start`, as the session begins or continues on this server. Only the first call does so."""
        if not self._started:
            self._started = True
            self._call(SESSION_START)

    def episode_began(self, episode: int, observations: Mapping[str, Any], infos: Mapping[str, Any]) -> None:
        """Call `on_episode_start`, after the environment has been reset."""
        scores = dict.fromkeys(self.facts.players, 0.0)
        self._now = _EpisodeState(episode, observations=observations, infos=infos, scores=scores)
        self._call(EPISODE_START)

    def stepped(
        self,
        actions: Mapping[str, Any],
        rewards: Mapping[str, float],
        observations: Mapping[str, Any],
        infos: Mapping[str, Any],
    ) -> None:
        """Call `on_tick`, after a step has been taken."""
        now = self._now
        now.ticks += 1
        now.actions, now.rewards, now.observations, now.infos = actions, rewards, observations, infos
        for player, reward in rewards.items():
            now.scores[player] = now.scores.get(player, 0.0) + reward
        self._call(TICK)

    def fed_back(self, player: str, word: str) -> None:
        """Call `on_feedback`, after a participant's word of feedback has been given to the agent's `feedback`."""
        self._call(FEEDBACK, player, word)

    def episode_ended(self, why: str) -> None:
        """Call `on_episode_end`, after the episode."""
        self._now.why = why
        self._call(EPISODE_END)

    def session_ended(self) -> None:
        """Call `on_session_end`, after the trial."""
        self._call(SESSION_END)

    def of_player(self, name: str, player: str, fields: Mapping[str, Any] | None = None) -> None:
        """Call `on_join`, `on_leave`, `on_return`, or `on_form` with the form's `fields`."""
        self._call(name, player, *(() if fields is None else (dict(fields),)))

    # ---- lines

    @property
    def recorded(self) -> int:
        """The number of lines for the recording so far. For any thread."""
        return self._notes.recorded

    def take(self, recorded: int | None = None) -> list[bytes]:
        """Return the lines for the recording that were not returned before. For the event loop's thread.

        With `recorded`, leave out each line after the first `recorded` lines. Lines that were returned before count.
        """
        return self._notes.take(recorded)

    def close(self) -> None:
        """End the thread after its present callback. For any thread."""
        if self._thread is not None:
            self._thread.close()
            running = self._thread.running
            if running is not None:
                log.warning("%s has not returned; %d callbacks were skipped", running, self._notes.skipped)

    # ---- calls

    def _call(self, name: str, *arguments: Any) -> None:
        method = self._found.get(name)
        if method is None:
            return
        if self._thread is None:
            self._thread = _Thread(lambda: self._late(self.recorded))
        running = self._thread.running
        if running is not None:
            self._notes.skipped += 1
            if self._notes.once("late"):
                text = "%s has not returned within callbackSeconds (%g s); callbacks are skipped until it has"
                log.warning(text, running, self._seconds)
            return
        where: dict[str, Any] = {"episode": self._now.episode, "step": self._now.ticks}
        if arguments and len(self.facts.humans) > 1:  # the callback is about one of several participants
            where["player"] = arguments[0]
        call = _Call(self._notes, name, where)
        session = self._session(call, None)
        returned = self._thread.run(name, lambda: call.run(method, session, arguments), self._seconds)
        if not returned and self.first_late is None:
            self.first_late = name

    def session_of(self, name: str, player: str, n: int | None) -> Session:
        """Return the session for a call of `reply` or `moderate` about a player's line; `n` is the number of the line
        to answer. For any thread."""
        now = self._now
        where: dict[str, Any] = {"episode": now.episode, "step": now.ticks}
        if len(self.facts.humans) > 1:
            where["player"] = player
        return self._session(_Call(self._notes, name, where, lambda: self._late(self.recorded)), player, n)

    def talk_failed(self, name: str, error: Exception) -> None:
        """Log the error of `reply` or `moderate`, each type once: its message may quote what a participant has said."""
        if self._notes.once(f"{name} {type(error).__name__}"):
            self._failed(name, error)

    def _session(self, call: _Call, player: str | None, n: int | None = None) -> Session:
        """Return the session for a call. `player`: whose talk it has; None for all. `n`: the line to answer."""
        facts, now, talk = self.facts, self._now, self._talk
        return Session(
            trial=facts.trial,
            step=facts.step,
            group=facts.group,
            players=facts.players,
            humans=facts.humans,
            episode=now.episode,
            ticks=now.ticks,
            actions=dict(now.actions),  # copies: a callback may change them, and the records must not
            rewards=dict(now.rewards),
            observations=dict(now.observations),
            infos=dict(now.infos),
            scores=dict(now.scores),
            why=now.why,
            replaying=self.replaying,
            condition=facts.condition,
            run=facts.run,
            answers=facts.answers,
            env=self._env(),
            record=_discard if self.replaying else call.record,
            options=talk.options,
            say=_discard if self.replaying else talk.say or _nobody,
            ask=talk.ask,
            _lines=lambda: talk.lines(player, n),
        )


class _Notes:
    """Collects the lines that callbacks record, and remembers which warnings about callbacks were given."""

    def __init__(
        self,
        stamp: Callable[[], dict[str, Any]],
        failed: Callable[[str, BaseException], None],
        hide: Callable[[str], str],
    ) -> None:
        self._stamp = stamp
        self._hide = hide
        self._failed = failed
        self._lines: deque[bytes] = deque()
        self._taken = 0
        self._warnings: set[str] = set()
        self._adding = threading.Lock()  # several threads record
        self.recorded = 0
        self.skipped = 0

    def take(self, recorded: int | None) -> list[bytes]:
        count = max(0, (self.recorded if recorded is None else recorded) - self._taken)
        self._taken += count
        return [self._lines.popleft() for _ in range(count)]

    def add(self, **fields: Any) -> None:
        line = recording.line("callback", **self._stamp(), **fields)
        with self._adding:
            if len(self._lines) < _MAX_WAITING:
                self._lines.append(line)
                self.recorded += 1

    def once(self, text: str) -> bool:
        """Return whether this text is new. After MAX_VALUES different texts, no text counts as new."""
        first = text not in self._warnings and len(self._warnings) < MAX_VALUES
        if first:
            self._warnings.add(text)
        return first

    def failed(self, name: str, error: BaseException, **where: Any) -> None:
        """Record and log the error that a callback raised; each different error once."""
        words = " ".join(f"{type(error).__name__}: {_message_of(error)}".split())[:_MAX_ERROR]
        if self.once(f"{name} {words}"):
            self.add(**where, name=name, callback=name, error=self._hide(words))
            self._failed(name, error)


class _Call:
    """One call of a callback, and the values that it records."""

    def __init__(
        self, notes: _Notes, name: str, where: Mapping[str, Any], recorded: Callable[[], None] = lambda: None
    ) -> None:
        """`recorded` is called after each value."""
        self._notes = notes
        self._recorded = recorded
        self._name = name
        self._where = where
        self._bytes_left = recording.MAX_EXTRA_BYTES
        self._values = 0

    def run(self, method: Callable[..., Any], session: Session, arguments: tuple[Any, ...]) -> None:
        notes, name = self._notes, self._name
        try:
            value = method(session, *arguments)
            if value is not None:
                session.record(name, value)
        except BaseException as error:  # noqa: BLE001 - SystemExit in a researcher's code is a failure like another
            notes.failed(name, error, **self._where)
        skipped, notes.skipped = notes.skipped, 0
        if skipped:
            notes.add(**self._where, name=name, callback=name, skipped=skipped)

    def record(self, name: str, value: Any) -> None:
        """Record a value. If it does not fit beside the earlier values of this call, record its size instead."""
        notes = self._notes
        self._values += 1
        if self._values > MAX_VALUES:
            if notes.once(f"most {self._name}"):
                log.warning("one call of %s may record %d values; it records more", self._name, MAX_VALUES)
            return
        name = text_of(name)[:MAX_NAME]
        kept, too_large = recording.bounded_extra({name: value}, self._bytes_left)
        size = too_large.get(name)
        if size is None:
            self._bytes_left -= recording.size_of(kept[name])
        elif notes.once(f"large {name}"):
            text = "what %s records as %r is too large for the recording (%d bytes); its size is recorded instead"
            log.warning(text, self._name, name, size)
        notes.add(**self._where, name=name, callback=self._name, value=kept[name])
        self._recorded()


@dataclass(slots=True, eq=False)
class _Job:
    work: Callable[[], None]
    returned: threading.Event
    awaited: bool = True


class _Thread:
    """Runs one callback at a time. The thread is a daemon: a callback that hangs cannot keep the process alive."""

    def __init__(self, late: Callable[[], None]) -> None:
        self._late = late
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._deciding = threading.Lock()  # held to decide whether a callback is late: both threads must agree
        self.running: str | None = None
        """The name of the callback that has not returned yet; None if there is none."""
        threading.Thread(target=self._run, name="callbacks", daemon=True).start()

    def run(self, name: str, work: Callable[[], None], seconds: float) -> bool:
        """Start the work, wait at most `seconds`, and return whether it is done. No other work may be running."""
        job = _Job(work, threading.Event())
        self.running = name
        self._jobs.put(job)
        job.returned.wait(seconds)
        with self._deciding:
            job.awaited = job.returned.is_set()
        return job.awaited

    def close(self) -> None:
        self._jobs.put(None)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job.work()
            finally:
                self.running = None
                with self._deciding:
                    job.returned.set()
                    late = not job.awaited
            if late:
                self._late()


def _discard(*arguments: Any, **named: Any) -> None:
    """Record and say nothing, while steps of an earlier server are taken again."""


def _nobody(*arguments: Any, **named: Any) -> None:
    raise NoChat("nobody talks in this game: write chat: true in the section trial of config.yml")


def _message_of(error: BaseException) -> str:
    try:
        return str(error)
    except BaseException:  # noqa: BLE001 - the researcher's errors may raise anything
        return ""
