"""Begins episodes: chooses the seed, opens the recording, then resets the environment or replays an episode. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from hippodrome.trial.core.effects import Call, Effect, RecordLine, ReplayCall, Replayed, ResetCall, ResetPolicy
from hippodrome.trial.core.message_log import MessageLog
from hippodrome.trial.core.participants import Participants
from hippodrome.trial.core.policies import Observed
from hippodrome.trial.core.progress import TrialProgress
from hippodrome.trial.core.recording import Recordings
from hippodrome.trial.core.seeds import policy_seed
from hippodrome.trial.core.timing import Timing
from hippodrome.trial.core.unfinished import UnfinishedEpisode
from hippodrome.trial.settings import TrialSettings


class Beginning:
    """Begins one episode after the other. Its methods return calls, which the caller gives to the agent."""

    def __init__(
        self,
        settings: TrialSettings,
        *,
        timing: Timing,
        recording: Recordings,
        message_log: MessageLog,
        new_seed: Callable[[], int],
        emit: Callable[[Effect], None],
    ) -> None:
        self._settings = settings
        self._timing = timing
        self._recording = recording
        self._message_log = message_log
        self._new_seed = new_seed
        self._emit = emit
        self._seed = 0  # the seed of the present episode
        self.unfinished: UnfinishedEpisode | None = None
        """The next episode if an earlier server has begun it; else None."""
        self.begun_again: int | None = None
        """The number of the episode that began anew because it could not be replayed."""

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

    def replayed(self, progress: TrialProgress, unfinished: UnfinishedEpisode, replayed: Replayed) -> None:
        """Continue the episode where the earlier server left it, after its steps have been taken again."""
        steps = len(unfinished.steps)
        self._emit(RecordLine("resume", {"episode": unfinished.number, "steps": steps}))
        self._reset_policies(progress, replayed.observed)
        self._timing.resume_episode(steps / progress.frame_rate)
        progress.replayed(steps, unfinished.scores or {progress.first: unfinished.score})
        progress.choices.policies.resume(unfinished.last_actions, unfinished.failures)
