"""Carries out the core's calls (`trial/core/effects.py`) on the agent, on the agent's thread."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from trial.agent.agent import AgentAdapter, StepResult
from trial.agent.callbacks import Callbacks
from trial.core.effects import Begun, Call, FeedbackCall, ReplayCall, Replayed, ResetCall, StepCall, StepTaken
from trial.core.players import ACTION_MASK, PLAYER, View
from trial.core.progress import Episode
from trial.recordings import recording

log = logging.getLogger("trial")


class Diverged(Exception):
    """A replayed episode differs from its recording."""


class Calls:
    """Runs calls, on the agent's thread. `stamp` returns the first fields of each line of the recording."""

    def __init__(self, stamp: Callable[[], dict[str, Any]], *, record_observations: bool) -> None:
        self._stamp = stamp
        self._record_observations = record_observations
        self.callbacks: Callbacks | None = None
        """Of an agent that has some."""
        self._said_too_large: set[str] = set()

    def run(self, call: Call) -> Any:
        """Run the call; return its result (see each kind). Raises what the researcher's code raises, and Diverged."""
        if isinstance(call, StepCall):
            return self._step(call)
        if isinstance(call, FeedbackCall):
            return self._end(call)
        if isinstance(call, ResetCall):
            if self.callbacks:
                self.callbacks.session_begins()
            return self._reset(call.episode, call.seed)
        assert isinstance(call, ReplayCall)
        return self._replay(call)

    def _reset(self, episode: int, seed: int) -> Begun:
        raise NotImplementedError

    def _step(self, call: StepCall) -> StepTaken:
        raise NotImplementedError

    def _take_again(self, call: ReplayCall) -> Replayed:
        raise NotImplementedError

    def _say(self, word: str) -> str:
        """Give the agent a word of feedback; the player whose human said it."""
        raise NotImplementedError

    def _replay(self, call: ReplayCall) -> Replayed:
        if not self.callbacks:
            return self._take_again(call)
        self.callbacks.session_begins()
        self.callbacks.replaying = True
        try:
            return self._take_again(call)
        finally:
            self.callbacks.replaying = False

    def _give_feedback(self, call: FeedbackCall) -> None:
        for word in call.feedback:
            call.heard += 1
            self._feedback(word)

    def _feedback(self, word: str) -> None:
        player = self._say(word)
        if self.callbacks:
            self.callbacks.fed_back(player, word)

    def _end(self, call: FeedbackCall) -> None:
        self._give_feedback(call)
        if self.callbacks:
            if isinstance(call.over, Episode):
                self.callbacks.episode_ended(call.over.why)
            if call.last:
                self.callbacks.session_ended()

    def _extra(self, values: Mapping[str, Any]) -> dict[str, Any]:
        kept, too_large = recording.bounded_extra(values)
        for name, size in too_large.items():
            if name not in self._said_too_large:
                self._said_too_large.add(name)
                text = (
                    "what step() returns as %r is too large for the recording (%d bytes); its size is recorded instead"
                )
                log.warning(text, name[:100], size)
        return {"extra": kept}


class AgentCalls(Calls):
    """Runs calls of an agent with one player. `views` is whether the core is told what the player sees."""

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

    def _reset(self, episode: int, seed: int) -> Begun:
        first, info, seeded = self._agent.reset(seed)
        frame = self._agent.render()
        if self.callbacks:
            self.callbacks.episode_began(episode, {PLAYER: first}, {PLAYER: info})
        fields: dict[str, Any] = {"episode": episode, "seed": seed if seeded else None, "info": recording.plain(info)}
        if self._record_observations:
            fields["observation"] = recording.observation(first)
        return Begun(recording.line("reset", **self._stamp(), **fields), frame, self._view(info))

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
        for step in unfinished.steps:
            for word in step.feedback:
                self._feedback(word)
            asked = next((one for one in (step.human, step.advice) if one is not None), default_action)
            result = self._agent.step(asked)
            action = asked if result.action is None else result.action
            if result.terminated or result.truncated or (action, result.reward) != (step.action, step.reward):
                raise Diverged("it plays differently now")
            if self.callbacks:
                self._tell_step(action, result)
            info = result.info
        return Replayed(self._agent.render(), self._view(info))

    def _say(self, word: str) -> str:
        self._agent.feedback(word)
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
        line = recording.line(
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
        return StepTaken({PLAYER: result.reward}, result.terminated, result.truncated, frame, line, view)


def mask_in(info: Mapping[str, Any]) -> Sequence[Any] | None:
    """The `action_mask` of an info, as Gymnasium's environments give it: one value for each action."""
    mask = info.get(ACTION_MASK)
    try:
        found = None if mask is None else [bool(one) for one in mask]
    except (TypeError, ValueError):
        return None
    return found
