"""Carries out the core's calls (`hippodrome/trial/core/effects.py`) on the agent, on the agent's thread."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from hippodrome.trial.agent.agent import AgentAdapter, StepResult
from hippodrome.trial.agent.callbacks import Callbacks
from hippodrome.trial.core.effects import (
    Begun,
    Call,
    FeedbackCall,
    ReplayCall,
    Replayed,
    ResetCall,
    StepCall,
    StepTaken,
)
from hippodrome.trial.core.history import Episode, Word
from hippodrome.trial.core.players import ACTION_MASK, PLAYER, View
from hippodrome.trial.llm.ledger import Moment
from hippodrome.trial.recordings import recording

log = logging.getLogger("trial")

_MAX_WARNINGS = 20  # the most warnings about values that are too large for the recording


class Diverged(Exception):
    """A replayed episode differs from its recording."""


class Calls:
    """Runs calls, on the agent's thread. `stamp` returns the first fields of each line of the recording."""

    def __init__(self, stamp: Callable[[], dict[str, Any]], *, record_observations: bool) -> None:
        self._stamp = stamp
        self._record_observations = record_observations
        self.callbacks: Callbacks | None = None
        """The agent's callbacks, if it has any."""
        self.moment = Moment()
        """When in the game the agent is now. Any thread may read it."""
        self.repeat: Callable[[Moment], None] = lambda moment: None
        """Called while steps are taken again, after the reset and after each step: it answers lines again."""
        self._warned_of: set[str] = set()
        self._cut = False  # whether a value of an info was too large in the previous line

    def run(self, call: Call) -> Any:
        """Run the call, and return the result that the docstring of its class names.

        Raises what the researcher's code raises, and Diverged if a replay differs from the recording.
        """
        if isinstance(call, StepCall):
            step = self._step(call)
            self._stepped()
            return step
        if isinstance(call, FeedbackCall):
            return self._end(call)
        if isinstance(call, ResetCall):
            if self.callbacks:
                self.callbacks.session_begins()
            self.moment = Moment(call.episode)
            return self._reset(call)
        assert isinstance(call, ReplayCall)
        return self._replay(call)

    def _reset(self, call: ResetCall) -> Begun:
        raise NotImplementedError

    def _step(self, call: StepCall) -> StepTaken:
        raise NotImplementedError

    def _take_again(self, call: ReplayCall) -> Replayed:
        raise NotImplementedError

    def _say(self, word: Word) -> str:
        """Give the agent a word of feedback. Return the player whose human sent it."""
        raise NotImplementedError

    def _stepped(self) -> None:
        """Note that a step is over, also for whatever the agent has called in it."""
        self.moment = replace(self.moment, step=self.moment.step + 1)
        if self.moment.replaying:
            self.repeat(self.moment)

    def _replay(self, call: ReplayCall) -> Replayed:
        if self.callbacks:
            self.callbacks.session_begins()
            self.callbacks.replaying = True
        self.moment = Moment(call.unfinished.number, replaying=True)
        try:
            return self._take_again(call)
        finally:
            self.moment = replace(self.moment, replaying=False)
            if self.callbacks:
                self.callbacks.replaying = False

    def _give_feedback(self, call: FeedbackCall) -> None:
        for word in call.feedback:
            call.heard += 1
            self._feedback(word)

    def _feedback(self, word: Word) -> None:
        player = self._say(word)
        if self.callbacks:
            self.callbacks.fed_back(player, word.text)

    def _end(self, call: FeedbackCall) -> None:
        self._give_feedback(call)
        if self.callbacks:
            if isinstance(call.over, Episode):
                self.callbacks.episode_ended(call.over.why)
            if call.last:
                self.callbacks.session_ended()

    def _extra(self, values: Mapping[str, Any]) -> dict[str, Any]:
        return {"extra": self._bounded("what step() returns as %r", values)}

    def _line(self, kind: str, /, **fields: Any) -> bytes:
        """Build a line of the recording. The size of a value in an `info` replaces the value if it is too large."""
        line = None if self._cut else recording.line(kind, **fields)
        if line is not None and len(line) <= recording.MAX_EXTRA_BYTES:
            return line
        cut = self._cut_infos(fields)
        self._cut = bool(cut)  # then the next line's infos are cut first: to write 50 MB as JSON takes seconds
        return line if line is not None and not cut else recording.line(kind, **{**fields, **cut})

    def _cut_infos(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields of a line whose infos are too large, with the sizes of their large values instead."""
        cut: dict[str, Any] = {}
        info = self._cut_info(fields.get("info"))
        if info is not None:
            cut["info"] = info
        players = fields.get("players", {})
        for player, part in players.items():
            info = self._cut_info(part.get("info"))
            if info is not None:
                cut.setdefault("players", dict(players))[player] = {**part, "info": info}
        return cut

    def _cut_info(self, info: Any) -> dict[str, Any] | None:
        if not isinstance(info, Mapping) or not recording.is_too_large(info):
            return None
        return self._bounded("%r in info", info)

    def _bounded(self, subject: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values; the size of a value replaces it if it is too large.

        The log's warning about such a value starts with `subject`, in which `%r` stands for its name.
        """
        kept, too_large = recording.bounded_extra(values)
        for name, size in too_large.items():
            value = subject % name[:100]
            if value not in self._warned_of and len(self._warned_of) < _MAX_WARNINGS:
                self._warned_of.add(value)
                log.warning("%s is too large for the recording (%d bytes); its size is recorded instead", value, size)
        return kept


class AgentCalls(Calls):
    """Runs calls of an agent with one player. With `views`, the results say which actions are legal now."""

    def __init__(
        self,
        agent: AgentAdapter,
        stamp: Callable[[], dict[str, Any]],
        *,
        record_observations: bool,
        views: bool = False,
    ) -> None:
        super().__init__(stamp, record_observations=record_observations)
        self._agent = agent
        self._views = views

    def _reset(self, call: ResetCall) -> Begun:
        episode, seed = call.episode, call.seed
        first, info, seeded = self._agent.reset(seed)
        frame = self._agent.render()
        if self.callbacks:
            self.callbacks.episode_began(episode, {PLAYER: first}, {PLAYER: info})
        fields: dict[str, Any] = {"episode": episode, "seed": seed if seeded else None, "info": recording.plain(info)}
        if self._record_observations:
            fields["observation"] = recording.observation(first)
        return Begun(self._line("reset", **self._stamp(), **fields), frame, self._view(info))

    def _view(self, info: Mapping[str, Any]) -> View | None:
        if not self._views:
            return None
        mask = mask_in(info)
        return View(frozenset({PLAYER}), masks={} if mask is None else {PLAYER: mask})

    def _take_again(self, call: ReplayCall) -> Replayed:
        unfinished, default_action = call.unfinished, call.default_actions[PLAYER]
        first, info, seeded = self._agent.reset(unfinished.seed or 0)
        if not seeded or unfinished.seed is None:
            raise Diverged("the environment takes no seed")
        if self.callbacks:
            self.callbacks.episode_began(unfinished.number, {PLAYER: first}, {PLAYER: info})
        self.repeat(self.moment)
        for step in unfinished.steps:
            for word in step.feedback:
                self._feedback(word)
            asked = next((one for one in (step.human, step.advice) if one is not None), default_action)
            result = self._agent.step(asked)
            action = asked if result.action is None else result.action
            if result.terminated or result.truncated or (action, result.reward) != (step.action, step.reward):
                raise Diverged("the environment plays differently now")
            if self.callbacks:
                self._tell_step(action, result)
            self._stepped()
            info = result.info
        return Replayed(self._agent.render(), self._view(info))

    def _say(self, word: Word) -> str:
        self._agent.feedback(word.text)
        return PLAYER

    def _tell_step(self, action: int, result: StepResult) -> None:
        assert self.callbacks is not None
        rewards = {PLAYER: result.reward}
        self.callbacks.stepped({PLAYER: action}, rewards, {PLAYER: result.observation}, {PLAYER: result.info})

    def _step(self, call: StepCall) -> StepTaken:
        stamp, asked = self._stamp(), call.actions[PLAYER]
        self._give_feedback(call)
        result = self._agent.step(asked.index)
        frame = self._agent.render()
        index, name, by = asked.index, asked.name, str(asked.by)
        if result.action is not None:
            names = self._agent.action_space
            index, by = result.action, "agent"
            name = names[index] if 0 <= index < len(names) else str(index)
        if self.callbacks:
            self._tell_step(index, result)
        line = self._line(
            "step",
            **stamp,
            **call.fields,
            human=asked.index if asked.human else None,
            action=index,
            actionName=name,
            by=by,
            **({"advice": asked.index} if asked.by == "advice" else {}),
            reward=result.reward,
            terminated=result.terminated,
            truncated=result.truncated or call.truncated_by is not None,
            info=result.info,
            **({"observation": recording.observation(result.observation)} if self._record_observations else {}),
            **(self._extra(result.extra) if result.extra else {}),
        )
        view = self._view(result.info) if self._views else None
        success = recording.succeeded(result.info)
        return StepTaken({PLAYER: result.reward}, result.terminated, result.truncated, frame, line, view, success)


def mask_in(info: Mapping[str, Any]) -> Sequence[Any] | None:
    """Return the `action_mask` of an info, a bool for each action; None if there is none or it cannot be read."""
    mask = info.get(ACTION_MASK)
    try:
        return None if mask is None else [bool(one) for one in mask]
    except (TypeError, ValueError):
        return None
