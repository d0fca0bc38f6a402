"""How far a trial is, and the rules of it: playing, pausing, episodes, frame rate, score. Pure; no clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from protocol.trial import Trial
from trial.core.controls import NOOP, Controls

FAILURES_ALLOWED = 3
"""Episodes in a row that may end in an error of the researcher's code before the trial ends as failed."""


class PlayState(Enum):
    """What clients are shown. BREAK: an episode is over, and the next begins when the break is over.

    ENDED: the trial is over, and its recordings are being saved; `done` follows.
    """

    READY = "ready"
    PLAYING = "playing"
    PAUSED = "paused"
    BREAK = "break"
    ENDED = "ended"


class CommandRefused(ValueError):
    """What a client asked for is not possible now; the words go back to it."""


@dataclass(frozen=True, slots=True)
class Action:
    """The action of one step. `human`: a person asked for it; `advised`: a program did; otherwise it is the default."""

    index: int
    name: str
    human: bool
    advised: bool = False


@dataclass(frozen=True, slots=True)
class Episode:
    """An episode that is over. `why`: terminated, truncated, reset, stopped or failed."""

    number: int
    steps: int
    score: float
    why: str


@dataclass(frozen=True, slots=True)
class Break:
    """A break that is over. `after`: the number of the episode before it.

    `why`: over (its time), start, pause or stop (the player's command), left (the player), failed.
    """

    after: int
    why: str


class Progress:
    """One trial's progress. The caller steps and resets the environment and reports the results.

    After each call that can end an episode (`stepped`, `failed`, `reset`, `stop`) look at `needs_reset` and `state`.
    Between two episodes is a break of `betweenEpisodes`, unless the game is held: the caller measures the time,
    takes no step meanwhile, and calls `go_on`.
    """

    def __init__(self, config: Trial, action_space: tuple[str, ...]) -> None:
        self.config = config
        self.action_space = action_space
        self.controls = Controls(action_space, config.action_buffer_lifespan)
        self.state = PlayState.READY
        self.outcome: str | None = None
        self.frame_rate = config.starting_frame_rate
        self.episode = 1
        """In a break: the episode that is over."""
        self.steps = 0
        """Steps taken in this episode."""
        self.total_steps = 0
        self.episodes_played = 0
        """Episodes in which at least one step was taken and that are over."""
        self.score = 0.0
        """Rewards of the whole trial."""
        self.episode_score = 0.0
        self.needs_reset = True
        """The environment must be reset before the next step."""
        self.ended: list[Episode | Break] = []
        """Episodes and breaks that are over, in order; for the caller to take out."""
        self._failures = 0
        self._good_episodes = 0
        self._advice: int | None = None

    def resume(self, ended: Sequence[Episode]) -> None:
        """Begin after these episodes, which an earlier server saw. Before anything is played."""
        for episode in ended:
            self.episodes_played += episode.steps > 0
            self.total_steps += episode.steps
            self.score += episode.score
            self._good_episodes += episode.why != "failed"
            self.episode = episode.number + 1
        if ended and ended[-1].why == "stopped":
            self._end("stopped")
        elif self.episode > self.config.max_episodes:
            self.episode = self.config.max_episodes
            self._end("finished" if self._good_episodes else "failed")

    def replayed(self, steps: int, score: float) -> None:
        """The episode stands where an earlier server left it."""
        self.needs_reset = False
        self.steps = steps
        self.total_steps += steps
        self.episode_score = score
        self.score += score

    @property
    def playing(self) -> bool:
        return self.state is PlayState.PLAYING

    @property
    def over(self) -> bool:
        return self.state is PlayState.ENDED

    @property
    def on_break(self) -> bool:
        return self.state is PlayState.BREAK

    def start(self) -> None:
        """Begin, or go on. In a break: begin the next episode without waiting for it."""
        if self.on_break:
            self._end_break("start", PlayState.PLAYING)
        elif not self.over:
            self.state = PlayState.PLAYING

    def go_on(self) -> None:
        """The time of the break is over: begin the next episode."""
        if self.on_break:
            self._end_break("over", PlayState.PLAYING)

    def pause(self) -> None:
        """Hold the game. In a break: the next episode waits for `start` at its first picture."""
        self._hold("pause")

    def leave(self) -> None:
        """The player has gone, or another page of theirs plays now: hold the game, let go of the keys."""
        self._hold("left")
        self.controls.clear()

    def _hold(self, why: str) -> None:
        if self.on_break:
            self._end_break(why, PlayState.PAUSED)
        elif self.playing:
            self.state = PlayState.PAUSED

    def reset(self) -> None:
        """End this episode and begin the next. An episode in which nothing happened stays, and so does a break."""
        if not self.over and not self.on_break and self.steps > 0:
            self._good_episodes += 1
            self._end_episode("reset")

    def stop(self) -> None:
        """End the trial now."""
        self._end_all("stop", "stopped")

    def change_frame_rate(self, wish: str | float) -> None:
        """Go faster, slower or to a number of frames per second, within the project's limits."""
        config = self.config
        if wish == "faster":
            rate = float(self.frame_rate + config.frame_rate_step_size)
        elif wish == "slower":
            rate = float(self.frame_rate - config.frame_rate_step_size)
        else:
            rate = float(wish)
        self.frame_rate = round(min(max(rate, config.min_frame_rate), config.max_frame_rate))

    def act(self, name: str, held: bool | None, *, lasts: bool = False) -> None:
        """A press (`held` is None), a key going down (True) or up (False). Raises CommandRefused for other names.

        With `lasts` it is an action that acts until the next one, also over pauses and episodes; one of an unknown
        name ends the one before.
        """
        if lasts:
            self.controls.keep(name)
        if not self.controls.knows(name) and not (lasts and name == NOOP):
            raise CommandRefused("that action is not in this game's actionSpace")
        if lasts:
            return
        if held is None:
            if self.playing:  # a press while the game is held would act later than it was meant
                self.controls.press(name)
        elif held:
            self.controls.hold(name)
        else:
            self.controls.release(name)

    def next_action(self) -> Action:
        """The action of the step that begins now. Advice is for this step, and counts if no key acts."""
        index, human = self.controls.take()
        advice, self._advice = self._advice, None
        if advice is not None and not human:
            return Action(advice, self.action_space[advice], human=False, advised=True)
        return Action(index, self.action_space[index], human)

    def advise(self, action: int) -> None:
        """A program advises this action for the next step. Raises CommandRefused if there is no such action."""
        if not 0 <= action < len(self.action_space):
            raise CommandRefused(f"there is no action {action}; there are 0 to {len(self.action_space) - 1}")
        self._advice = action

    def began(self) -> None:
        """The environment has been reset: the episode stands at its first picture."""
        self._advice = None
        self.needs_reset = False

    def stepped(self, reward: float, terminated: bool, truncated: bool) -> None:
        """A step was taken."""
        if self.over:
            return
        self.steps += 1
        self.total_steps += 1
        self.score += reward
        self.episode_score += reward
        if terminated or truncated:
            self._failures = 0
            self._good_episodes += 1
            self._end_episode("terminated" if terminated else "truncated")

    def failed(self, *, fatal: bool = False) -> None:
        """The researcher's code raised an error (or, `fatal`, will never answer)."""
        if self.over:
            return
        self._failures += 1
        if fatal or self._failures >= FAILURES_ALLOWED:
            self._end_all("failed", "failed")
        elif self.on_break or (self.steps == 0 and self.needs_reset):
            pass  # no episode is on; after a reset that failed, the same one is tried again
        else:
            self._end_episode("failed")

    def _close_episode(self, why: str) -> None:
        self.ended.append(Episode(self.episode, self.steps, self.episode_score, why))
        if self.steps > 0:
            self.episodes_played += 1

    def _end_episode(self, why: str) -> None:
        self._close_episode(why)
        if self.episode >= self.config.max_episodes:
            self._end("finished" if self._good_episodes else "failed")
            return
        if self.playing and self.config.between_seconds > 0:
            self.state = PlayState.BREAK
            self.controls.clear()  # keys that are held now are meant for the episode that is over
        else:
            self._next_episode()

    def _end_break(self, why: str, state: PlayState) -> None:
        self.ended.append(Break(self.episode, why))
        self.controls.forget_taps()  # keys that go down in the break act in the next episode if they are held then
        self.state = state
        self._next_episode()

    def _next_episode(self) -> None:
        self.episode += 1
        self.steps = 0
        self.episode_score = 0.0
        self.needs_reset = True

    def _end_all(self, break_why: str, outcome: str) -> None:
        """End the trial, and the episode or the break that is on."""
        if self.on_break:
            self.ended.append(Break(self.episode, break_why))
        elif not self.over:
            self._close_episode(outcome)
        if not self.over:
            self._end(outcome)

    def _end(self, outcome: str) -> None:
        self.state = PlayState.ENDED
        self.outcome = outcome
        self.controls.clear()
