"""Begins, plays and ends episodes, by calls of the agent: one at a time. Pure: it emits effects.

An episode begins with a seed, an open recording, and a reset of the environment, or with the steps of an earlier
server. It ends with the last feedback; the trial ends with the last lines of the recording, then the answer.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hippodrome.trial.core import records
from hippodrome.trial.core.clients import Clients
from hippodrome.trial.core.effects import (
    Begun,
    Call,
    Effect,
    FeedbackCall,
    RecordLine,
    ReplayCall,
    Replayed,
    ResetCall,
    ResetPolicy,
    StepCall,
    StepTaken,
    WriteLine,
    WriteLog,
)
from hippodrome.trial.core.history import Break, Episode, MessageLog, UnfinishedEpisode
from hippodrome.trial.core.participants import Participants
from hippodrome.trial.core.players import View, policy_seed
from hippodrome.trial.core.policies import Observed
from hippodrome.trial.core.progress import TrialProgress
from hippodrome.trial.core.records import Recordings
from hippodrome.trial.core.timing import Timing
from hippodrome.trial.settings import TrialSettings

LAST_CALL_SECONDS = 2.0
"""The time in which a call of the agent must return once the server must end."""


class AgentCall:
    """Gives the agent one call at a time.

    A call that does not return in time may still run on the agent's thread. The agent gets no further call then.
    """

    def __init__(self, emit: Callable[[Effect], None]) -> None:
        self._emit = emit
        self.call: Call | None = None
        """The call that has not ended yet; None if there is none."""
        self.give_up_at: float | None = None
        """The time at which the trial gives up the present call; None: only the call's own limit counts."""
        self.hangs = False
        """Whether a call has not returned in time."""

    def make(self, call: Call) -> None:
        """Give the agent this call."""
        self.call = call
        self._emit(call)

    def has_ended(self, call: Call, *, hangs: bool = False) -> bool:
        """Note that a call has ended, and return whether its result counts: a call that was given up does not.

        `hangs`: the call has not returned within its limit.
        """
        if call is not self.call:
            return False
        self.call, self.give_up_at = None, None
        self.hangs |= hangs
        return True

    def give_up(self, now: float) -> None:
        """Give up the present call if `give_up_at` has come. A result that comes later changes nothing."""
        if self.give_up_at is not None and now >= self.give_up_at:
            self.call, self.give_up_at, self.hangs = None, None, True


class Episodes:
    """The episodes of one trial, one after the other. Methods that return a call leave it to the caller to make it."""

    def __init__(
        self,
        settings: TrialSettings,
        *,
        timing: Timing,
        recording: Recordings,
        message_log: MessageLog,
        clients: Clients,
        new_seed: Callable[[], int],
        emit: Callable[[Effect], None],
    ) -> None:
        self._settings = settings
        self._timing = timing
        self._recording = recording
        self._message_log = message_log
        self._clients = clients
        self._new_seed = new_seed
        self._emit = emit
        self._seed = 0  # the seed of the present episode
        self.unfinished: UnfinishedEpisode | None = None
        """The next episode if an earlier server has begun it; else None."""
        self.begun_again: int | None = None
        """The number of the episode that began anew because it could not be replayed."""
        self._break_shut_down = False
        self.closing = False
        """Whether the server must end."""
        self.all_written = False
        """Whether the last lines are written, and the shell was asked to store the answer."""

    # ---- the beginning

    def begin(self, progress: TrialProgress, participants: Participants) -> Call | None:
        """Return the call that begins the next episode; None if a recording is opened first: `opened` returns it."""
        self._timing.begin_episode()  # now, so that states before the reset have the new episode's times
        unfinished = self.unfinished
        self._seed = self._next_seed(progress) if unfinished is None or unfinished.seed is None else unfinished.seed
        if self._recording.is_open:
            return self._reset(progress, participants)
        self._recording.ask(progress, self._seed)
        return None

    def _next_seed(self, progress: TrialProgress) -> int:
        first = self._settings.trial.seed
        return self._new_seed() if first is None else first + progress.episode - 1

    def opened(self, progress: TrialProgress, participants: Participants, ns: int) -> Call:
        """Return the call that begins the episode, whose recording is open. `ns`: the present time in nanoseconds."""
        unfinished, self.unfinished = self.unfinished, None
        if unfinished is not None and unfinished.steps:
            progress.choices.begins(self._seed)
            default = {name: player.idle for name, player in progress.players.items()}
            return ReplayCall(limit=self._settings.start_seconds, unfinished=unfinished, default_actions=default)
        if unfinished is not None:
            self._message_log.repeat(unfinished.unheard, ns)
        return self._reset(progress, participants)

    def begin_again(self, progress: TrialProgress, participants: Participants) -> Call:
        """Return the call that begins an episode anew because it could not be replayed."""
        self.begun_again = progress.episode
        return self._reset(progress, participants)

    def _reset(self, progress: TrialProgress, participants: Participants) -> Call:
        progress.choices.begins(self._seed)
        self._reset_policies(progress, {})
        return ResetCall(
            limit=self._settings.step_seconds,
            episode=progress.episode,
            seed=self._seed,
            asked=frozenset(player.name for player in progress.choices.policies.asked),
            fields=participants.reset_fields(),
        )

    def _reset_policies(self, progress: TrialProgress, observed: Mapping[str, Sequence[Observed]]) -> None:
        for player in progress.choices.policies.asked:
            seed = policy_seed(self._seed, player.name)
            self._emit(ResetPolicy(player.name, seed, observed.get(player.name, ())))

    # ---- steps

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
        """Record that the environment was reset, show the first picture, and ask the policies."""
        self._emit(WriteLine(begun.line))
        progress.began()
        self._timing.begin_episode()
        self._see(begun.view, progress, now)
        self._clients.show(begun.pictures)

    def replayed(self, unfinished: UnfinishedEpisode, result: Replayed, progress: TrialProgress, now: float) -> None:
        """Continue the episode where the earlier server left it, after its steps have been taken again."""
        steps = len(unfinished.steps)
        self._emit(RecordLine("resume", {"episode": unfinished.number, "steps": steps}))
        self._reset_policies(progress, result.observed)
        self._timing.resume_episode(steps / progress.frame_rate)
        progress.replayed(steps, unfinished.scores or {progress.first: unfinished.score})
        progress.choices.policies.resume(unfinished.last_actions, unfinished.failures)
        self._see(result.view, progress, now)
        self._clients.show(result.pictures)
        self._emit(WriteLog(logging.INFO, f"the game goes on after {steps} steps of an earlier server"))
        self._message_log.repeat(unfinished.unheard, int(now * 1e9))

    def _see(self, view: View | None, progress: TrialProgress, now: float) -> None:
        """Let the players see `view`, and ask the policies that are due."""
        progress.choices.see(view, now)
        for ask in progress.choices.asks(progress.steps, now):
            self._emit(ask)

    # ---- the end

    def last_feedback(self, progress: TrialProgress) -> FeedbackCall:
        """Return the last call of the agent before the first end in `TrialProgress.ended` is recorded.

        The call gives the agent the feedback that is left, and tells its callbacks that the episode or break is over.
        """
        return FeedbackCall(
            limit=LAST_CALL_SECONDS if self.closing else self._settings.step_seconds,
            feedback=self._message_log.feedback,
            messages=len(self._message_log.messages),
            over=progress.ended[0],
            last=progress.over and len(progress.ended) == 1,
        )

    def record(self, call: FeedbackCall, progress: TrialProgress, participants: Participants) -> None:
        """Remove the first end from `TrialProgress.ended`, and record it, with the messages before `call`."""
        over = progress.ended.pop(0)
        if isinstance(over, Episode):
            for player, late in progress.choices.policies.late().items():
                self._emit(WriteLog(logging.INFO, f"the policy of {player} was late at {late} of {over.steps} steps"))
        outcomes = participants.outcomes() if progress.over and not progress.ended else None
        self._emit(records.end(over, self._message_log.messages[: call.messages], outcomes))
        self._message_log.recorded(call.messages, len(call.feedback))
        # The break after an episode is recorded in the episode's file.
        break_follows = isinstance(progress.ended[0], Break) if progress.ended else progress.on_break
        if self._settings.trial.data_file == "episode" and not break_follows:
            self._close_recording(participants)

    def shut_down_break(self, progress: TrialProgress) -> None:
        """If the server must end during a break, add the break to `TrialProgress.ended`."""
        if self.closing and progress.on_break and not self._break_shut_down:
            self._break_shut_down = True
            progress.ended.append(Break(progress.episode, "shutdown"))

    def write_last(self, progress: TrialProgress, participants: Participants, *, broken: bool) -> None:
        """Write the last lines, and ask the shell to store the answer. A `broken` or unfinished game has no answer."""
        self.all_written = True
        if self.closing and not progress.over and not progress.on_break:
            self._emit(records.shutdown(progress, self._message_log.messages))
        self._close_recording(participants)
        self._emit(participants.answer(self._timing.seconds, played=progress.over and not broken))

    def _close_recording(self, participants: Participants) -> None:
        participants.write_lines()
        self._recording.close()
