"""How far a trial is, and the rules of it: playing, pausing, episodes, breaks, frame rate, scores. Pure; no clock.

What each player does at the next step is in `trial/core/choices.py`. Choices and scores are kept by player
(`trial/core/players.py`).
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from enum import Enum

from protocol.trial import TrialSection
from trial.core.actions import Action
from trial.core.choices import Choices
from trial.core.ended import PARTNER_LEFT, Break, Episode
from trial.core.players import Player

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


class TrialProgress:
    """One trial's progress. The caller steps and resets the environment and reports the results.

    After each call that can end an episode (`stepped`, `failed`, `reset`, `stop`) look at `needs_reset` and `state`.
    Between two episodes is a break of `betweenEpisodes`, unless the game is held: the caller measures the time,
    takes no step meanwhile, and calls `go_on`.
    """

    def __init__(self, config: TrialSection, players: Iterable[Player]) -> None:
        """`players` are those of the environment, in its order; one of them at least is a human."""
        self.config = config
        self.players = {player.name: player for player in players}
        self.humans = tuple(name for name, player in self.players.items() if player.human)
        self.first = self.humans[0]
        """The human whose action and score stand first in the records."""
        self.action_space = self.players[self.first].action_space
        """Of the first human."""
        self.choices = Choices(config, self.players, self.humans)
        """What each player does at the next step."""
        self.controls = self.choices.controls
        """The keys of each human."""
        self.turns = self.choices.turns
        """Turn by turn: who is to act, and the time they have; None in real time."""
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
        self.scores = dict.fromkeys(self.players, 0.0)
        """Each player's rewards of the whole trial."""
        self.episode_scores = dict.fromkeys(self.players, 0.0)
        self.needs_reset = True
        """The environment must be reset before the next step."""
        self.frozen = config.reset_freeze > 0
        """The episode's first picture stands, or is to: no step is taken, and keys do nothing."""
        self.ended: list[Episode | Break] = []
        """Episodes and breaks that are over, in order; for the caller to take out."""
        self._failures = 0
        self._good_episodes = 0
        self.told: Hashable = None
        """In a session: changes whenever members are to be told of each other again."""

    @property
    def several(self) -> bool:
        """Whether the environment has more than one player."""
        return len(self.players) > 1

    @property
    def score(self) -> float:
        """The first human's rewards of the whole trial."""
        return self.scores[self.first]

    @property
    def episode_score(self) -> float:
        """The first human's rewards of this episode."""
        return self.episode_scores[self.first]

    def resume(self, ended: Sequence[Episode]) -> None:
        """Begin after these episodes, which an earlier server has seen. Called before anything is played."""
        for episode in ended:
            self.episodes_played += episode.steps > 0
            self.total_steps += episode.steps
            self._add(self.scores, episode.scores or {self.first: episode.score})
            self._good_episodes += episode.why != "failed"
            self.episode = episode.number + 1
        if ended and ended[-1].why in ("stopped", PARTNER_LEFT):
            self._end(ended[-1].why)
        elif self.episode > self.config.max_episodes:
            self.episode = self.config.max_episodes
            self._end("finished" if self._good_episodes else "failed")

    def _add(self, scores: dict[str, float], more: Mapping[str, float]) -> None:
        for player, score in more.items():
            if player in scores:
                scores[player] += score

    def replayed(self, steps: int, scores: Mapping[str, float]) -> None:
        """The episode has reached the step at which the earlier server left it."""
        self.needs_reset = self.frozen = False
        self.steps = steps
        self.total_steps += steps
        self.episode_scores |= {player: score for player, score in scores.items() if player in self.players}
        self._add(self.scores, scores)

    @property
    def playing(self) -> bool:
        return self.state is PlayState.PLAYING

    @property
    def stands(self) -> bool:
        """Whether the episode's first picture is shown and still stands."""
        return self.frozen and self.playing and not self.needs_reset

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

    def leave(self, player: str | None = None) -> None:
        """The human has gone, or another page of theirs plays now: hold the game, let go of their keys.

        Without `player`, all humans.
        """
        self._hold("left")
        self.choices.let_go(player)

    def hold(self) -> None:
        """A member of the session is missing: take no step. A break goes on."""
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

    def act(self, name: str, held: bool | None, *, lasts: bool = False, player: str | None = None) -> None:
        """A press (`held` is None), a key going down (True) or up (False). Raises CommandRefused for unknown names.

        With `lasts` it is an action that acts until the next one, also over pauses and episodes; one of an unknown
        name ends the one before. Turn by turn, each press and each key that goes down is a choice; it does nothing if
        it is not the player's turn. `player` is the first human if it is not given.
        """
        on = self.playing and not self.frozen
        self.choices.act(player or self.first, name, held, lasts=lasts, on=on)

    def next_actions(self) -> Mapping[str, Action]:
        """Each player's action of the step that begins now."""
        return self.choices.next_actions(self.steps)

    # ---- turn by turn

    def turn_over(self) -> None:
        """The time of the turn is over: choose for the humans who did not, or end the episode (`turnEnds`)."""
        if self.choices.turn_over(self.steps):
            self._good_episodes += 1
            self._end_episode("turnSeconds")

    def to_act(self, player: str) -> bool:
        """Turn by turn: whether it is this player's turn, and they have not chosen."""
        return self.playing and self.turns is not None and self.turns.waits_for(player)

    # ---- steps

    def began(self) -> None:
        """The environment has been reset: the episode stands at its first picture."""
        self.choices.began()
        self.needs_reset = False

    def thaw(self) -> None:
        """The first picture has stood long enough: from now on keys act, also those that are held already."""
        self.frozen = False
        self.choices.forget_taps()

    def time_over(self) -> None:
        """`episodeSeconds` are over, and no step is due that could be the episode's last one."""
        self._good_episodes += 1
        self._end_episode("truncated", "episodeSeconds")

    def stepped(
        self, rewards: Mapping[str, float], terminated: bool, truncated: bool, limit: str | None = None
    ) -> None:
        """A step was taken. `limit`: the key of `trial` that ends the episode with this step, if there is one."""
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
            self._good_episodes += 1
            own = terminated or truncated
            self._end_episode("terminated" if terminated else "truncated", None if own else limit)

    def failed(self, *, fatal: bool = False) -> None:
        """The researcher's code raised an error. `fatal`: it will never answer."""
        if self.over:
            return
        self._failures += 1
        if fatal or self._failures >= FAILURES_ALLOWED:
            self._end_all("failed", "failed")
        elif self.on_break or (self.steps == 0 and self.needs_reset):
            pass  # no episode is on; after a reset that failed, the same one is tried again
        else:
            self._end_episode("failed")

    def _close_episode(self, why: str, limit: str | None = None) -> None:
        scores = dict(self.episode_scores) if self.several else {}
        self.ended.append(Episode(self.episode, self.steps, self.episode_score, why, scores, limit))
        if self.steps > 0:
            self.episodes_played += 1

    def _end_episode(self, why: str, limit: str | None = None) -> None:
        self._close_episode(why, limit)
        if self.episode >= self.config.max_episodes:
            self._end("finished" if self._good_episodes else "failed")
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
        self.choices.let_go()
