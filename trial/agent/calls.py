"""Carries out the core's calls (`trial/core/effects.py`) on the agent, on the agent's thread."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

from trial.agent.agent import AgentAdapter
from trial.core.effects import Call, FeedbackCall, ReplayCall, ResetCall, StepCall, StepTaken
from trial.core.progress import Action
from trial.core.unfinished import UnfinishedEpisode
from trial.pictures.frames import Frame
from trial.recordings import recording

log = logging.getLogger("trial")


class Diverged(Exception):
    """A replayed episode differs from its recording."""


class AgentCalls:
    """Runs calls, on the agent's thread. `stamp` returns the first fields of each line of the recording."""

    def __init__(self, agent: AgentAdapter, stamp: Callable[[], dict[str, Any]], *, record_observations: bool) -> None:
        self._agent = agent
        self._stamp = stamp
        self._record_observations = record_observations
        self._said_too_large: set[str] = set()

    def run(self, call: Call) -> Any:
        """Run the call; return its result (see each kind). Raises what the researcher's code raises, and Diverged."""
        if isinstance(call, StepCall):
            return self._step(call)
        if isinstance(call, FeedbackCall):
            return self._give_feedback(call)
        if isinstance(call, ResetCall):
            return self._reset(call.episode, call.seed)
        assert isinstance(call, ReplayCall)
        return self._replay(call.unfinished, call.default_action)

    def _reset(self, episode: int, seed: int) -> tuple[bytes, Frame]:
        first, info, seeded = self._agent.reset(seed)
        frame = self._agent.render()
        fields: dict[str, Any] = {"episode": episode, "seed": seed if seeded else None, "info": recording.plain(info)}
        if self._record_observations:
            fields["observation"] = recording.observation(first)
        return recording.line("reset", **self._stamp(), **fields), frame

    def _replay(self, unfinished: UnfinishedEpisode, default_action: int) -> Frame:
        _, _, seeded = self._agent.reset(unfinished.seed or 0)
        if not seeded or unfinished.seed is None:
            raise Diverged("the environment takes no seed")
        for step in unfinished.steps:
            for word in step.feedback:
                self._agent.feedback(word)
            asked = next((one for one in (step.human, step.advice) if one is not None), default_action)
            result = self._agent.step(asked)
            action = asked if result.action is None else result.action
            if result.terminated or result.truncated or (action, result.reward) != (step.action, step.reward):
                raise Diverged("it plays differently now")
        return self._agent.render()

    def _give_feedback(self, call: FeedbackCall) -> None:
        for word in call.feedback:
            call.heard += 1
            self._agent.feedback(word)

    def _step(self, call: StepCall) -> StepTaken:
        stamp, asked = self._stamp(), call.action
        self._give_feedback(call)
        result = self._agent.step(asked.index)
        frame = self._agent.render()
        index, name, by = asked.index, asked.name, _origin(asked)
        if result.action is not None:
            names = self._agent.action_space
            index, by = result.action, "agent"
            name = names[index] if 0 <= index < len(names) else str(index)
        line = recording.line(
            "step",
            **stamp,
            **call.fields,
            human=asked.index if asked.human else None,
            action=index,
            actionName=name,
            by=by,
            **({"advice": asked.index} if asked.advised else {}),
            reward=result.reward,
            terminated=result.terminated,
            truncated=result.truncated,
            info=result.info,
            **({"observation": recording.observation(result.observation)} if self._record_observations else {}),
            **(self._extra(result.extra) if result.extra else {}),
        )
        return StepTaken(result.reward, result.terminated, result.truncated, frame, line)

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


def _origin(asked: Action) -> str:
    return "human" if asked.human else "advice" if asked.advised else "none"
