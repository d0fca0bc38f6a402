"""Takes steps of the environment: builds the agent's call, and applies its result. Pure: it emits effects."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hippodrome.trial.core.clients import Clients
from hippodrome.trial.core.effects import Begun, Effect, Replayed, StepCall, StepTaken, WriteLine
from hippodrome.trial.core.message_log import MessageLog
from hippodrome.trial.core.players import View
from hippodrome.trial.core.progress import TrialProgress
from hippodrome.trial.core.timing import Timing
from hippodrome.trial.settings import TrialSettings


class Stepper:
    """Takes steps, one after the other. `take` returns a call, which the caller gives to the agent."""

    def __init__(
        self,
        settings: TrialSettings,
        *,
        timing: Timing,
        message_log: MessageLog,
        clients: Clients,
        emit: Callable[[Effect], None],
    ) -> None:
        self._settings = settings
        self._timing = timing
        self._message_log = message_log
        self._clients = clients
        self._emit = emit

    def take(self, progress: TrialProgress, now: float) -> StepCall:
        """Return the call that takes the step that is due, with the messages and the feedback since the last step."""
        received, dropped = self._message_log.messages, self._message_log.take_dropped()
        fields: dict[str, Any] = {
            "episode": progress.episode,
            "step": progress.steps + 1,
            "frame": self._clients.frame_id + 1,
        }
        if received:
            fields["messages"] = received
        if dropped:
            fields["messagesDropped"] = dropped
        return StepCall(
            limit=self._settings.step_seconds,
            actions=progress.next_actions(),
            feedback=self._message_log.feedback,
            messages=len(received),
            fields=fields,
            truncated_by=self._timing.limit_of_step(progress, now),
        )

    def taken(self, call: StepCall, step: StepTaken, progress: TrialProgress, now: float) -> None:
        """Record and count a step that was taken, and show its picture."""
        self._emit(WriteLine(step.line))
        self._message_log.recorded(call.messages, len(call.feedback))
        self._timing.stepped(now, progress.frame_rate)
        ended = len(progress.ended)
        progress.stepped(step.rewards, step.terminated, step.truncated, call.truncated_by, success=step.success)
        if len(progress.ended) == ended and (step.view is not None or progress.turns is not None):
            self._see(step.view, progress, now)
        self._clients.show(step.pictures)

    def began(self, begun: Begun, progress: TrialProgress, now: float) -> None:
        """Record that the environment was reset, and show the first picture."""
        self._emit(WriteLine(begun.line))
        progress.began()
        self._timing.begin_episode()
        self.show(begun, progress, now)

    def show(self, result: Begun | Replayed, progress: TrialProgress, now: float) -> None:
        """Show the picture with which the episode begins or goes on, and ask the policies."""
        self._see(result.view, progress, now)
        self._clients.show(result.pictures)

    def _see(self, view: View | None, progress: TrialProgress, now: float) -> None:
        """Let the players see `view`, and ask the policies that are due."""
        progress.choices.see(view, now)
        for ask in progress.choices.asks(progress.steps, now):
            self._emit(ask)
