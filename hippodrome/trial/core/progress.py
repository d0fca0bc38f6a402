"""The progress of a trial: playing, pausing, episodes, breaks, frame rate, scores. Pure; no clock.

`hippodrome/trial/core/choices.py` decides what each player does at the next step.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from enum import Enum

from hippodrome.protocol.trial import TrialSection
from hippodrome.trial.core.choices import Choices
from hippodrome.trial.core.history import PARTNER_LEFT, Break, Episode
from hippodrome.trial.core.players import Action, Player

FAILURES_ALLOWED = 3
"""The trial ends as failed after so many failures of the researcher's code without an episode that ended by itself."""


class PlayState(Enum):
    """The state of a trial, as clients see it. READY: not begun yet. PAUSED: the game is held.

    BREAK: an episode is over, and the next begins when the break is over. ENDED: the trial is over, and recordings and
    answers are being stored; the message `done` follows.
    """

    READY = "ready"
    PLAYING = "playing"
    PAUSED = "paused"
    BREAK = "break"
    ENDED = "ended"


class TrialProgress:
    """Keeps the progress of one trial. The caller steps and resets the environment, and reports the results.

    After each call that can end an episode (`stepped`, `failed`, `reset`, `stop`) the caller looks at `needs_reset` and
    `state`. Between two episodes there is a break of `betweenEpisodes`, unless the game is held. The caller measures
    the break's time, takes no step during the break, and then calls `go_on`.
    """

    def __init__(self, config: TrialSection, players: Iterable[Player]) -> None:
        """`players` are the environment's, in its order. A human plays at least one of them."""
        self.config = config
        self.players = {player.name: player for player in players}
        self.humans = tuple(name for name, player in self.players.items() if player.human)
        self.first = self.humans[0]
        """The first player that a human plays. Records name its action and its score first."""
        self.choices = Choices(config, self.players, self.humans)
        """Decides what each player does at the next step."""
        self.turns = self.choices.turns
        """The present turn; None in real time."""
        self.state = PlayState.READY
        self.outcome: str | None = None
        """How the trial has ended: finished, stopped, failed or partnerLeft; None while it goes on."""
        self.frame_rate = config.starting_frame_rate
        self.episode = 1
        """The number of the present episode; in a break, the number of the episode that is over."""
        self.steps = 0
        """The number of steps in this episode."""
        self.total_steps = 0
        self.episodes_played = 0
        """The number of episodes that are over and had at least one step."""
        self.successes = 0
        """The number of episodes that ended with `success`."""
        self.scores = dict.fromkeys(self.players, 0.0)
        """By player, the sum of rewards in the trial."""
        self.episode_scores = dict.fromkeys(self.players, 0.0)
        """By player, the sum of rewards in the episode."""
        self.needs_reset = True
        """Whether the environment must be reset before the next step."""
        self.frozen = config.reset_freeze > 0
        """Whether the time of the first picture (`resetFreeze`) runs or is still to come: keys do nothing meanwhile."""
        self.ended: list[Episode | Break] = []
        """The episodes and breaks that are over and not recorded yet, in order. The caller removes them."""
        self._failures = 0
        self._has_good_episode = False  # whether an episode has ended without a failure

    @property
    def several(self) -> bool:
        """Whether the environment has more than one player."""
        return len(self.players) > 1

    @property
    def score(self) -> float:
        """The first human's score in the trial."""
        return self.scores[self.first]

    @property
    def episode_score(self) -> float:
        """The first human's score in this episode."""
        return self.episode_scores[self.first]

    @property
    def reached(self) -> bool:
        """Whether as many episodes have succeeded as `until` says; False without `until`."""
        return self.config.until is not None and self.successes >= self.config.until["success"]

    def resume(self, ended: Sequence[Episode]) -> None:
        """Go on after these episodes, which were played on an earlier server. Call it before anything is played."""
        for episode in ended:
            self.episodes_played += episode.steps > 0
            self.total_steps += episode.steps
            self._add(self.scores, episode.scores or {self.first: episode.score})
            self.successes += episode.success
            self._has_good_episode |= episode.why != "failed"
            self.episode = episode.number + 1
        if ended and ended[-1].why in ("stopped", PARTNER_LEFT):
            self._end(ended[-1].why)
        elif self.episode > self.config.max_episodes or self.reached:
            self.episode = min(self.episode - 1, self.config.max_episodes)
            self._end("finished" if self._has_good_episode else "failed")

    def _add(self, scores: dict[str, float], more: Mapping[str, float]) -> None:
        for player, score in more.items():
            if player in scores:
                scores[player] += score

    def replayed(self, steps: int, scores: Mapping[str, float]) -> None:
        """Continue an earlier server's episode, whose `steps` steps were taken again, with these scores by player."""
        self.needs_reset = self.frozen = False
        self.steps = steps
        self.total_steps += steps
        self.episode_scores |= {player: score for player, score in scores.items() if player in self.players}
        self._add(self.scores, scores)

    @property
    def playing(self) -> bool:
        """Whether the game is on, and not held."""
        return self.state is PlayState.PLAYING

    @property
    def shows_first_picture(self) -> bool:
        """Whether the episode's first picture is shown and its time (`resetFreeze`) is not over."""
        return self.frozen and self.playing and not self.needs_reset

    @property
    def over(self) -> bool:
        """Whether the trial is over."""
        return self.state is PlayState.ENDED

    @property
    def on_break(self) -> bool:
        """Whether there is a break between two episodes."""
        return self.state is PlayState.BREAK

    def start(self) -> None:
        """Begin, or go on. In a break: end it, and begin the next episode."""
        if self.on_break:
            self._end_break("start", PlayState.PLAYING)
        elif not self.over:
            self.state = PlayState.PLAYING

    def go_on(self) -> None:
        """Begin the next episode because the break's time is over."""
        if self.on_break:
            self._end_break("over", PlayState.PLAYING)

    def pause(self) -> None:
        """Hold the game. In a break: end it, and hold the next episode at its first picture until `start`."""
        self._hold("pause")

    def leave(self, player: str | None = None) -> None:
        """Hold the game as `pause` does, and release a human's keys, because their connection is closed or replaced.

        If `player` is None, the keys of all humans are released.
        """
        self._hold("left")
        self.choices.let_go(player)

    def hold(self) -> None:
        """Hold the game of a session, because a member is missing. A break goes on."""
        if self.playing:
            self.state = PlayState.PAUSED

    def partner_left(self) -> None:
        """End the trial for all members of the session, because a member stays away."""
        self._end_all(PARTNER_LEFT, PARTNER_LEFT)

    def _hold(self, why: str) -> None:
        if self.on_break:
            self._end_break(why, PlayState.PAUSED)
        elif self.playing:
            self.state = PlayState.PAUSED

    def reset(self) -> None:
        """End this episode and begin the next. It changes nothing in a break, or before the episode's first step."""
        if not self.over and not self.on_break and self.steps > 0:
            self._has_good_episode = True
            self._end_episode("reset")

    def stop(self) -> None:
        """End the trial now."""
        self._end_all("stop", "stopped")

    def change_frame_rate(self, wish: str | float) -> None:
        """Change the frame rate to `faster`, `slower` or a number of frames per second, within the project's limits."""
        config = self.config
        if wish == "faster":
            rate = float(self.frame_rate + config.frame_rate_step_size)
        elif wish == "slower":
            rate = float(self.frame_rate - config.frame_rate_step_size)
        else:
            rate = float(wish)
        self.frame_rate = round(min(max(rate, config.min_frame_rate), config.max_frame_rate))

    def act(self, name: str, held: bool | None, *, lasts: bool = False, player: str | None = None) -> None:
        """Take a button that a human presses (`held` is None), or a key that goes down (True) or up (False).

        Raises CommandRefused. `name` is the name of an action or a key. With `lasts`, the action acts until the next
        one, also over pauses and episodes; an unknown name ends it. `player`: None is the first player that a human
        plays.

        While the game is held, a button has no effect. A key that goes down then acts on the first step after the hold,
        even if it was released; with `input: single` it never acts.

        Turn by turn, each press and each key that goes down is a choice. It has no effect while the game is held, or if
        it is not the player's turn.
        """
        on = self.playing and not self.frozen
        self.choices.act(player or self.first, name, held, lasts=lasts, on=on)

    def next_actions(self) -> Mapping[str, Action]:
        """Return, by player, the actions of the step that begins now."""
        return self.choices.next_actions()

    # ---- turn by turn

    def turn_over(self) -> None:
        """Choose for the humans who have not chosen in the turn's time, or end the episode, as `turnEnds` says."""
        if self.choices.turn_over(self.steps):
            self._has_good_episode = True
            self._end_episode("turnSeconds")

    def to_act(self, player: str) -> bool:
        """Turn by turn: whether the game waits for this player's choice now."""
        return self.playing and self.turns is not None and self.turns.waits_for(player)

    def choice_of(self, player: str) -> tuple[str | None, str | None]:
        """Turn by turn: return the action that is chosen for this player in the present turn, and `Turns.timed_out`.

        None for each that there is not.
        """
        if self.turns is None:
            return None, None
        chosen = self.turns.chosen.get(player)
        return None if chosen is None else chosen.name, self.turns.timed_out.get(player)

    # ---- steps

    def began(self) -> None:
        """Begin the episode, whose environment has been reset."""
        self.choices.began()
        self.needs_reset = False

    def thaw(self) -> None:
        """End the time of the first picture: from now on keys act, also those that are held down already."""
        self.frozen = False
        self.choices.forget_taps()

    def time_over(self) -> None:
        """End the episode because `episodeSeconds` are over, and no step is due that could be its last one."""
        self._has_good_episode = True
        self._end_episode("truncated", "episodeSeconds")

    def stepped(
        self,
        rewards: Mapping[str, float],
        terminated: bool,
        truncated: bool,
        limit: str | None = None,
        *,
        success: bool = False,
    ) -> None:
        """Count a step. `limit`: the key of `trial` whose limit ends the episode with this step; None if none does.

        `success`: whether the episode has succeeded if it ends with this step.
        """
        if self.over:
            return
        self.steps += 1
        self.total_steps += 1
        scores, episode_scores = self.scores, self.episode_scores
        for player, reward in rewards.items():
            scores[player] += reward
            episode_scores[player] += reward
        if terminated or truncated or limit is not None:
            self._failures = 0
            self._has_good_episode = True
            own = terminated or truncated
            self._end_episode("terminated" if terminated else "truncated", None if own else limit, success=success)

    def failed(self, *, fatal: bool = False) -> None:
        """End the episode after an error of the researcher's code. `fatal`: end the trial, since it cannot go on."""
        if self.over:
            return
        self._failures += 1
        if fatal or self._failures >= FAILURES_ALLOWED:
            self._end_all("failed", "failed")
        elif self.on_break or (self.steps == 0 and self.needs_reset):
            pass  # no episode runs; a reset that failed is tried again
        else:
            self._end_episode("failed")

    def _close_episode(self, why: str, limit: str | None = None, *, success: bool = False) -> None:
        scores = dict(self.episode_scores) if self.several else {}
        self.ended.append(Episode(self.episode, self.steps, self.episode_score, why, scores, limit, success))
        self.successes += success
        if self.steps > 0:
            self.episodes_played += 1

    def _end_episode(self, why: str, limit: str | None = None, *, success: bool = False) -> None:
        self._close_episode(why, limit, success=success)
        if self.episode >= self.config.max_episodes or self.reached:
            self._end("finished" if self._has_good_episode else "failed")
            return
        if self.playing and self.config.between_seconds > 0:
            self.state = PlayState.BREAK
            self.choices.let_go()  # keys that are held now are meant for the episode that is over
        else:
            self._next_episode()

    def _end_break(self, why: str, state: PlayState) -> None:
        self.ended.append(Break(self.episode, why))
        self.choices.forget_taps()  # keys that go down in the break act in the next episode if they are held then
        self.state = state
        self._next_episode()

    def _next_episode(self) -> None:
        self.episode += 1
        self.steps = 0
        self.episode_scores = dict.fromkeys(self.players, 0.0)
        self.needs_reset = True
        self.frozen = self.config.reset_freeze > 0

    def _end_all(self, break_why: str, outcome: str) -> None:
        """End the trial, and the present episode or break."""
        if self.on_break:
            self.ended.append(Break(self.episode, break_why))
        elif not self.over:
            self._close_episode(outcome)
        if not self.over:
            self._end(outcome)

    def _end(self, outcome: str) -> None:
        self.state = PlayState.ENDED
        self.outcome = outcome
        self.choices.let_go()
