"""How far a trial is, and the rules of it: playing, pausing, episodes, frame rate, scores, actions. Pure; no clock.

Controls, actions and scores are kept by player (`trial/core/players.py`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

from protocol.trial import Trial
from trial.core.actions import Action
from trial.core.controls import Controls
from trial.core.players import NOOP, Mask, Player, View, is_legal, legal_or_idle, random_action
from trial.core.policies import Policies
from trial.core.seeds import policy_seed
from trial.core.turns import Turns

_NO_ACTION = "that action is not in this game's actionSpace"
NOT_POSSIBLE = "that move is not possible now"
"""What a participant is told who, turn by turn, chooses an action that the environment's mask forbids."""

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
class Episode:
    """An episode that is over. `why`: terminated, truncated, reset, stopped, failed, or turnSeconds (a turn's).

    `score` is that of the first human; `scores` are those of all players, if there are several.
    """

    number: int
    steps: int
    score: float
    why: str
    scores: Mapping[str, float] = field(default_factory=dict)
    limit: str | None = None
    """The key of `trial` whose limit truncated it: maxSteps or episodeSeconds."""


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

    def __init__(self, config: Trial, players: Iterable[Player]) -> None:
        """`players` are those of the environment, in its order; one of them at least is a human."""
        self.config = config
        self.players = {player.name: player for player in players}
        self.humans = tuple(name for name, player in self.players.items() if player.human)
        self.first = self.humans[0]
        """The human whose action and score stand first in the records."""
        self.action_space = self.players[self.first].action_space
        """Of the first human."""
        self.controls = {
            name: Controls(
                self.players[name].action_space,
                config.action_buffer_lifespan,
                self.players[name].idle,
                keys=config.keys_of(name),
                single=config.input == "single",
            )
            for name in self.humans
        }
        turns = config.pace == "turns"
        self.turns = Turns(config.turn_seconds) if turns else None
        self.policies = Policies(
            (player for player in self.players.values() if not player.human),
            frame_skip=config.frame_skip,
            seconds=config.policy_seconds if turns else None,
            goes_on=config.input != "single",  # an action that is taken once is not taken again between two choices
        )
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
        self._advice: dict[str, int] = {}
        self._usual = {  # made once: a step of a single human takes one of these
            name: tuple(
                (Action(index, action), Action(index, action, "human"))
                for index, action in enumerate(self.players[name].action_space)
            )
            for name in self.humans
        }
        self._view: View | None = None  # None: all act, and may do all
        self._seed = 0  # of the episode

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
        """Begin after these episodes, which an earlier server saw. Before anything is played."""
        for episode in ended:
            self.episodes_played += episode.steps > 0
            self.total_steps += episode.steps
            self._add(self.scores, episode.scores or {self.first: episode.score})
            self._good_episodes += episode.why != "failed"
            self.episode = episode.number + 1
        if ended and ended[-1].why == "stopped":
            self._end("stopped")
        elif self.episode > self.config.max_episodes:
            self.episode = self.config.max_episodes
            self._end("finished" if self._good_episodes else "failed")

    def _add(self, scores: dict[str, float], more: Mapping[str, float]) -> None:
        for player, score in more.items():
            if player in scores:
                scores[player] += score

    def replayed(self, steps: int, scores: Mapping[str, float]) -> None:
        """The episode stands where an earlier server left it."""
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
        """The episode's first picture is shown and stands."""
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
        for name in self.humans if player is None else (player,):
            self.controls[name].clear()

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
        """A press (`held` is None), a key going down (True) or up (False). Raises CommandRefused for other names.

        With `lasts` it is an action that acts until the next one, also over pauses and episodes; one of an unknown
        name ends the one before. Turn by turn, each press and each key that goes down is a choice; it does nothing if
        it is not the player's turn. `player` is the first human if it is not given.
        """
        controls = self.controls[player or self.first]
        if self.turns is not None:
            if controls.knows(name) or not lasts:  # a client of HIPPO's says by another name that nothing is pressed
                self._choose(player or self.first, name, held)
            return
        if lasts:
            controls.keep(name)
        if not controls.knows(name) and not (lasts and name == NOOP):
            raise CommandRefused(_NO_ACTION)
        if lasts:
            return
        if held is None:
            if self.playing and not self.frozen:  # a press while the game is held would act later than it was meant
                controls.press(name)
        elif held:
            controls.hold(name)
            if self.config.input == "single" and (self.frozen or not self.playing):
                controls.forget_taps()
        else:
            controls.release(name)

    def _choose(self, player: str, name: str, held: bool | None) -> None:
        """A press, or a key going down or up, turn by turn. Raises CommandRefused."""
        assert self.turns is not None
        controls = self.controls[player]
        if not controls.knows(name):
            raise CommandRefused(_NO_ACTION)
        index = controls.choice(name, held)
        if index is None or not self.playing or self.frozen or not self.turns.waits_for(player):
            return
        if not is_legal(index, self._mask(player)):
            raise CommandRefused(NOT_POSSIBLE)
        self.turns.choose(player, Action(index, controls.names[index], "human"))

    def _mask(self, player: str) -> Mask | None:
        return None if self._view is None else self._view.masks.get(player)

    def next_actions(self) -> Mapping[str, Action]:
        """Each player's action of the step that begins now. Advice is for this step, and counts if no key acts."""
        view, turns = self._view, self.turns
        actions: dict[str, Action] = {}
        for name, player in self.players.items():
            if view is not None and name not in view.to_act:
                actions[name] = Action(player.idle, player.action_space[player.idle], acts=False)
            elif turns is not None:
                actions[name] = turns.chosen[name]
            elif player.human:
                actions[name] = self._asked_for(player)
            else:
                actions[name] = self.policies.take(name, self._mask(name), self.steps)
        if self._advice:
            self._advice.clear()
        return actions

    def _asked_for(self, player: Player) -> Action:
        """The action of a human in real time. One that is not possible now is not taken."""
        name = player.name
        index, human = self.controls[name].take()
        advice = self._advice.get(name) if self._advice and not human else None
        mask = None if self._view is None else self._view.masks.get(name)
        if advice is not None and is_legal(advice, mask):
            return Action(advice, player.action_space[advice], "advice")
        if mask is not None and not is_legal(index, mask):
            index, human = legal_or_idle(index, player, mask), False
        return self._usual[name][index][human]

    # ---- turn by turn

    def policies_choose(self, now: float) -> None:
        """Turn by turn: take the choices of those policies that have answered, or whose time is over."""
        turns = self.turns
        for name in self._waiting():
            if turns is not None and name in self.policies:
                action = self.policies.choice(name, self._mask(name), now)
                if action is not None:
                    turns.choose(name, action)

    def turn_over(self) -> None:
        """The time of the turn is over: choose for the humans who did not, or end the episode (`turnEnds`).

        What a program advises counts before that.
        """
        turns = self.turns
        for name in self._waiting():
            player, mask = self.players[name], self._mask(name)
            if turns is None or not player.human:
                continue
            advice = self._advice.get(name)
            if advice is not None and is_legal(advice, mask):
                turns.choose(name, Action(advice, player.action_space[advice], "advice"))
            elif self.config.turn_ends == "episode":
                self._good_episodes += 1
                self._end_episode("turnSeconds")
                return
            elif self.config.turn_ends == "random":
                index = random_action(player, mask, policy_seed(self._seed, f"{name}/{self.steps}"))
                turns.choose(name, Action(index, player.action_space[index], "random"))
            else:
                index = legal_or_idle(player.idle, player, mask)
                turns.choose(name, Action(index, player.action_space[index]))

    def _waiting(self) -> tuple[str, ...]:
        turns = self.turns
        return () if turns is None else tuple(name for name in self.players if turns.waits_for(name))

    @property
    def humans_waited_for(self) -> bool:
        """Turn by turn: the game waits for a human."""
        return any(self.players[name].human for name in self._waiting())

    def policies_until(self) -> float | None:
        """Turn by turn: when the time of a policy that the game waits for is over."""
        return self.policies.until(self._waiting())

    def to_act(self, player: str) -> bool:
        """Turn by turn: whether it is the player's turn, and they have not chosen."""
        return self.playing and self.turns is not None and self.turns.waits_for(player)

    # ---- programs

    def advise(self, action: int, player: str | None = None) -> None:
        """A program advises this action for the next step, or chooses it for a player that it plays.

        `player` is the one that a program plays, or the first human, if it is not given. Raises CommandRefused if there
        is no such action or player.
        """
        known = self._player_of_program(player)
        player = known.name
        if not known.human and not known.by_program:
            raise CommandRefused(f"the project has another policy for {player}")
        if not 0 <= action < len(known.action_space):
            raise CommandRefused(f"there is no action {action}; there are 0 to {len(known.action_space) - 1}")
        if known.human:
            self._advice[player] = action
        else:
            self.policies.advise(player, action)

    def action_space_of(self, player: str | None) -> tuple[str, ...]:
        """The names of the actions that `advise` takes. Raises CommandRefused if there is no such player."""
        return self._player_of_program(player).action_space

    def _player_of_program(self, player: str | None) -> Player:
        """The player that a program names, or the one that it means if it names none. Raises CommandRefused."""
        if player is None:
            player = next((each.name for each in self.players.values() if each.by_program), self.first)
        known = self.players.get(player)
        if known is None:
            raise CommandRefused(f"there is no such player; there are {', '.join(self.players)}")
        return known

    # ---- steps

    def begins(self, seed: int) -> None:
        """The environment is being reset with this seed."""
        self._seed = seed
        self.policies.begin()

    def began(self) -> None:
        """The environment has been reset: the episode stands at its first picture."""
        self._advice.clear()
        self.needs_reset = False

    def see(self, view: View | None, now: float) -> None:
        """This is what the players see now. None: all of them act, and all actions are possible."""
        self._view = view
        if self.turns is not None:
            to_act = frozenset(self.players) if view is None else view.to_act & self.players.keys()
            self.turns.begin(to_act)
            self.policies.turn(to_act, now)

    def thaw(self) -> None:
        """The first picture has stood long enough: keys act, those that are held now too."""
        self.frozen = False
        for controls in self.controls.values():
            controls.forget_taps()

    def time_over(self) -> None:
        """The episode has been played for `episodeSeconds`, and no step is due that could be its last."""
        self._good_episodes += 1
        self._end_episode("truncated", "episodeSeconds")

    def stepped(
        self, rewards: Mapping[str, float], terminated: bool, truncated: bool, limit: str | None = None
    ) -> None:
        """A step was taken. `limit` is the key of `trial` that makes it the episode's last one, if there is one."""
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
            self._clear()  # keys that are held now are meant for the episode that is over
        else:
            self._next_episode()

    def _end_break(self, why: str, state: PlayState) -> None:
        self.ended.append(Break(self.episode, why))
        for controls in self.controls.values():
            controls.forget_taps()  # keys that go down in the break act in the next episode if they are held then
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
        self._clear()

    def _clear(self) -> None:
        """Let go of all keys."""
        for controls in self.controls.values():
            controls.clear()
