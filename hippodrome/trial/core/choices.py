"""Decides which action each player takes at the next step. Pure; the clock is passed in.

`controls.py` keeps the keys of humans, `policies.py` the answers of policies, `Turns` the choices of a turn. `Choices`
decides which of them counts, and which action is taken if nothing was chosen or the choice is illegal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from hippodrome.protocol.trial import TrialSection
from hippodrome.trial.core.controls import Controls
from hippodrome.trial.core.messages import CommandRefused
from hippodrome.trial.core.players import (
    NOOP,
    Action,
    By,
    Mask,
    Player,
    View,
    is_legal,
    legal_or_idle,
    policy_seed,
    random_action,
)
from hippodrome.trial.core.policies import AskPolicy, Policies


class Turns:
    """Keeps the present turn of a game: which players are to act, what they have chosen, and their time.

    The game waits until all players who are to act have chosen. A choice is final. `seconds`: the time that humans have
    for each turn; 0: no limit.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._left = seconds
        self._since: float | None = None  # since when the time runs; None: it does not run
        self.to_act: frozenset[str] = frozenset()
        """The players who are to act in this turn."""
        self.chosen: dict[str, Action] = {}
        """By player, the choices of this turn."""
        self.timed_out: dict[str, str] = {}
        """By player, what was chosen for a human whose time was up: the action's name, or "" if the episode ended
        instead. It stays until the human chooses again."""

    def begin(self, to_act: frozenset[str]) -> None:
        """Begin a turn. Its time does not run before `run` is called."""
        self.to_act = to_act
        self.chosen = {}
        self._left, self._since = self._seconds, None

    def waits_for(self, player: str) -> bool:
        """Whether the player is to act in this turn and has not chosen."""
        return player in self.to_act and player not in self.chosen

    @property
    def waiting(self) -> bool:
        """Whether the game waits for any player."""
        return len(self.chosen) < len(self.to_act)

    def choose(self, player: str, action: Action) -> None:
        """Choose a player's action. It changes nothing if the player has chosen in this turn, or is not to act."""
        if self.waits_for(player):
            self.chosen[player] = action
            if action.human:
                self.timed_out.pop(player, None)

    def run(self, now: float) -> None:
        """Let the time of the turn run, because the game goes on."""
        if self._since is None:
            self._since = now

    def hold(self, now: float) -> None:
        """Stop the time of the turn, because the game is held."""
        self._left, self._since = self.left(now), None

    def left(self, now: float) -> float:
        """Return the seconds that are left in this turn, negative once it is over. Meaningless without a limit."""
        return self._left if self._since is None else self._left - (now - self._since)

    def ends_in(self, now: float) -> float | None:
        """Return the seconds that are left in this turn, at least 0; None if there is no limit."""
        return max(0.0, self.left(now)) if self._seconds else None


_NO_ACTION = "that action is not in this game's actionSpace"
NOT_POSSIBLE = "that move is not possible now"
"""The sentence for a participant who, turn by turn, chooses an action that the environment's mask forbids."""


class Choices:
    """The choices of all players in one trial.

    The caller says whether the game is `on` (playing, and past the first picture), and how many `steps` of the episode
    were taken.
    """

    def __init__(self, config: TrialSection, players: Mapping[str, Player], humans: Sequence[str]) -> None:
        """`players` are the environment's, in its order; `humans` are the names of the players that humans play."""
        self._config = config
        self._players = players
        self._humans = humans
        self.controls = {
            name: Controls(
                players[name].action_space,
                config.action_buffer_lifespan,
                players[name].idle,
                keys=config.keys_of(name),
                single=config.input == "single",
            )
            for name in humans
        }
        """By player, the keys and buttons of each human."""
        turns = config.pace == "turns"
        self.turns = Turns(config.turn_seconds) if turns else None
        self.policies = Policies(
            (player for player in players.values() if not player.human),
            frame_skip=config.frame_skip,
            seconds=config.policy_seconds if turns else None,
            repeats_last=config.policies_hold,
        )
        self._advice: dict[str, int] = {}
        # By player and action number: the action as nobody's choice, and as the human's. Most steps take one of these,
        # so they are made once.
        self._usual = {
            name: tuple(
                (Action(index, action), Action(index, action, "human"))
                for index, action in enumerate(players[name].action_space)
            )
            for name in humans
        }
        self._view: View | None = None  # None: all players are to act, and all actions are legal
        self.seed = 0
        """The seed of the episode."""
        self.timed_keys = False
        """Whether actions say when the participant chose them (`Action.pressed_at`)."""

    # ---- an episode

    def begins(self, seed: int) -> None:
        """Prepare the policies for an episode with this seed. Call it before the environment is reset."""
        self.seed = seed
        self.policies.begin()

    def began(self) -> None:
        """Drop advice for the episode before. Call it after the environment has been reset."""
        self._advice.clear()

    def see(self, view: View | None, now: float) -> None:
        """Let the players see `view`: a turn begins. None: all players are to act, and all actions are legal."""
        self._view = view
        if self.turns is not None:
            to_act = frozenset(self._players) if view is None else view.to_act & self._players.keys()
            self.turns.begin(to_act)
            self.policies.turn(to_act, now)

    def _mask(self, player: str) -> Mask | None:
        return None if self._view is None else self._view.masks.get(player)

    # ---- keys and buttons of humans

    def act(self, player: str, name: str, held: bool | None, *, lasts: bool, on: bool) -> None:
        """Take the key or button that a human presses: see `TrialProgress.act`."""
        controls = self.controls[player]
        if self.turns is not None:
            if controls.knows(name) or not lasts:  # HIPPO's clients send an unknown name when nothing is pressed
                self._choose(player, name, held, on)
            return
        if lasts:
            controls.keep(name)
        if not controls.knows(name) and not (lasts and name == NOOP):
            raise CommandRefused(_NO_ACTION)
        if lasts:
            return
        if held is None:
            if on:  # a press while the game is held would act only when it goes on
                controls.press(name)
        elif held:
            controls.hold(name)
            if self._config.input == "single" and not on:
                controls.forget_taps()
        else:
            controls.release(name)

    def _choose(self, player: str, name: str, held: bool | None, on: bool) -> None:
        """Turn by turn: take a human's choice. Raises CommandRefused.

        `held` is None for a button that is pressed, True for a key that goes down, and False for a key that goes up.
        """
        assert self.turns is not None
        controls = self.controls[player]
        if not controls.knows(name):
            raise CommandRefused(_NO_ACTION)
        index = controls.choice(name, held)
        if index is None or not on or not self.turns.waits_for(player):
            return
        if not is_legal(index, self._mask(player)):
            raise CommandRefused(NOT_POSSIBLE)
        self.turns.choose(player, Action(index, controls.names[index], "human", pressed_at=controls.time))

    def set_message_time(self, player: str, ns: int) -> None:
        """Set the time of the message that is being read, in nanoseconds. The action that it chooses gets this time."""
        self.controls[player].time = ns

    def let_go(self, player: str | None = None) -> None:
        """Release all keys and forget all presses of this human; of all humans if `player` is None."""
        for name in self._humans if player is None else (player,):
            self.controls[name].clear()

    def forget_taps(self) -> None:
        """Forget presses that no step has taken yet. Keys that are held down stay."""
        for controls in self.controls.values():
            controls.forget_taps()

    # ---- a step

    def next_actions(self) -> Mapping[str, Action]:
        """Return each player's action for the step that begins now, and drop the advice that was given for it.

        Advice for a human counts if no key does.
        """
        view, turns = self._view, self.turns
        actions: dict[str, Action] = {}
        for name, player in self._players.items():
            if view is not None and name not in view.to_act:
                actions[name] = Action(player.idle, player.action_space[player.idle], acts=False)
            elif turns is not None:
                actions[name] = turns.chosen[name]
            elif name in self.policies:
                actions[name] = self.policies.take(name, self._mask(name))
            else:
                actions[name] = self._by_human(player)
        if self._advice:
            self._advice.clear()
        return actions

    def _by_human(self, player: Player) -> Action:
        """Return the action of a human in real time; a legal one instead of an action that is illegal now."""
        name = player.name
        index, human = self.controls[name].take()
        advice = self._advice.get(name) if self._advice and not human else None
        mask = None if self._view is None else self._view.masks.get(name)
        if advice is not None and is_legal(advice, mask):
            return Action(advice, player.action_space[advice], "advice")
        if mask is not None and not is_legal(index, mask):
            index, human = legal_or_idle(index, player, mask), False
        if human and self.timed_keys:
            return Action(index, player.action_space[index], "human", pressed_at=self.controls[name].pressed_at)
        return self._usual[name][index][human]

    # ---- policies

    def asks(self, steps: int, now: float) -> Sequence[AskPolicy]:
        """Return the questions to policies that are due after `see`."""
        return () if self._view is None else self.policies.asks(self._view, steps, now)

    def take_place(self, player: str, plays: str) -> None:
        """Let the policy `plays` choose this player's actions from now on, in the place of its human."""
        self.let_go(player)
        self.policies.take_place(replace(self._players[player], plays=plays))

    def ask(self, player: str, steps: int, now: float) -> AskPolicy | None:
        """Return a question to the policy that has replaced a human; None if its player is not to act now.

        None also if the human has already chosen in this turn: the choice stands, and a recording has no place for an
        observation that no action follows.
        """
        view = self._view
        if view is None or player not in view.to_act or (self.turns is not None and not self.turns.waits_for(player)):
            return None
        return self.policies.ask(player, view, steps, now)

    # ---- turn by turn

    def policies_choose(self, now: float) -> None:
        """Take the choices of all policies that have answered, or whose time is over."""
        turns = self.turns
        assert turns is not None
        for name in self._waiting():
            if name in self.policies:
                action = self.policies.choice(name, self._mask(name), now)
                if action is not None:
                    turns.choose(name, action)

    def turn_over(self, steps: int) -> bool:
        """Choose for the humans who have not chosen in the turn's time; return True if the episode ends instead.

        A program's advice counts first; without advice, `turnEnds` decides.
        """
        turns = self.turns
        assert turns is not None
        for name in self.waits_for:
            player, mask = self._players[name], self._mask(name)
            advice = self._advice.get(name)
            by: By = "none"
            if advice is not None and is_legal(advice, mask):
                index, by = advice, "advice"
            elif self._config.turn_ends == "episode":
                turns.timed_out = dict.fromkeys(self._humans, "")
                return True
            elif self._config.turn_ends == "random":
                index, by = random_action(player, mask, policy_seed(self.seed, f"{name}/{steps}")), "random"
            else:
                index = legal_or_idle(player.idle, player, mask)
            turns.choose(name, Action(index, player.action_space[index], by))
            turns.timed_out[name] = player.action_space[index]
        return False

    def _waiting(self) -> tuple[str, ...]:
        """Return the players for whom the turn waits; none in real time."""
        turns = self.turns
        return () if turns is None else tuple(name for name in self._players if turns.waits_for(name))

    @property
    def waits_for(self) -> tuple[str, ...]:
        """The players of the humans for whom the turn waits; none in real time."""
        return tuple(name for name in self._waiting() if name not in self.policies)

    def policies_until(self) -> float | None:
        """Return when the first policy for which the turn waits runs out of time; None if it waits for none."""
        return self.policies.until(self._waiting())

    # ---- programs

    def advise(self, action: int, player: str | None = None) -> None:
        """Take a program's advice for a human's next action, or its choice for a player that the program plays.

        `action` is the number of an action. If `player` is None, the first player that a program plays is meant, or
        else the first human. Raises CommandRefused if there is no such action or player, or another policy plays it.
        """
        target = self._player_of_program(player)
        if not target.human and not target.by_program:
            raise CommandRefused(f"{target.name} is played by {target.plays}, not by a program")
        if not 0 <= action < len(target.action_space):
            raise CommandRefused(f"there is no action {action}; there are 0 to {len(target.action_space) - 1}")
        if target.human:
            self._advice[target.name] = action
        else:
            self.policies.advise(target.name, action)

    def action_space_of(self, player: str | None) -> tuple[str, ...]:
        """Return the names of the actions of `player`, which is as in `advise`. Raises CommandRefused."""
        return self._player_of_program(player).action_space

    def _player_of_program(self, player: str | None) -> Player:
        """Return the player that a program means; `player` is as in `advise`. Raises CommandRefused."""
        if player is None:
            by_program = (each.name for each in self._players.values() if each.by_program)
            player = next(by_program, self._humans[0])
        target = self._players.get(player)
        if target is None:
            raise CommandRefused(f"there is no such player; there are {', '.join(self._players)}")
        return target
