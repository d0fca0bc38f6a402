"""What each player does at the next step: by keys and buttons, by a policy, or as a program says. Pure.

A human's keys are in `controls.py`, what policies were asked and answered in `policies.py`, the choices of a turn in
`turns.py`. This decides which of them counts, and what is taken if nothing was chosen or the choice is forbidden.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from protocol.trial import TrialSection
from trial.core.actions import Action
from trial.core.controls import Controls
from trial.core.messages import CommandRefused
from trial.core.players import NOOP, Mask, Player, View, is_legal, legal_or_idle, random_action
from trial.core.policies import AskPolicy, Policies
from trial.core.seeds import policy_seed
from trial.core.turns import Turns

_NO_ACTION = "that action is not in this game's actionSpace"
NOT_POSSIBLE = "that move is not possible now"
"""What a participant is told who, turn by turn, chooses an action that the environment's mask forbids."""


class Choices:
    """The choices of all players, by player. The caller says whether the game is on, and how many steps were taken."""

    def __init__(self, config: TrialSection, players: Mapping[str, Player], humans: Sequence[str]) -> None:
        """`players` are those of the environment, in its order; `humans` are those of them that humans play."""
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
        """The keys of each human."""
        turns = config.pace == "turns"
        self.turns = Turns(config.turn_seconds) if turns else None
        self.policies = Policies(
            (player for player in players.values() if not player.human),
            frame_skip=config.frame_skip,
            seconds=config.policy_seconds if turns else None,
            goes_on=config.input != "single",  # an action that is taken once is not taken again between two choices
        )
        self._advice: dict[str, int] = {}
        self._usual = {  # made once: a step of a single human takes one of these
            name: tuple(
                (Action(index, action), Action(index, action, "human"))
                for index, action in enumerate(players[name].action_space)
            )
            for name in humans
        }
        self._view: View | None = None  # None: all act, and may do all
        self.seed = 0
        """Of the episode."""
        self.timed_keys = False
        """Actions say when the participant chose them."""

    # ---- an episode

    def begins(self, seed: int) -> None:
        """The environment is being reset with this seed."""
        self.seed = seed
        self.policies.begin()

    def began(self) -> None:
        """The environment has been reset."""
        self._advice.clear()

    def see(self, view: View | None, now: float) -> None:
        """The players see this now. None: all of them act, and all actions are possible."""
        self._view = view
        if self.turns is not None:
            to_act = frozenset(self._players) if view is None else view.to_act & self._players.keys()
            self.turns.begin(to_act)
            self.policies.turn(to_act, now)

    def _mask(self, player: str) -> Mask | None:
        return None if self._view is None else self._view.masks.get(player)

    # ---- keys and buttons of humans

    def act(self, player: str, name: str, held: bool | None, *, lasts: bool, on: bool) -> None:
        """As `TrialProgress.act`, which says whether the game is `on`: played, and past its first picture."""
        controls = self.controls[player]
        if self.turns is not None:
            if controls.knows(name) or not lasts:  # a client of HIPPO's says by another name that nothing is pressed
                self._choose(player, name, held, on)
            return
        if lasts:
            controls.keep(name)
        if not controls.knows(name) and not (lasts and name == NOOP):
            raise CommandRefused(_NO_ACTION)
        if lasts:
            return
        if held is None:
            if on:  # a press while the game is held would act later than it was meant
                controls.press(name)
        elif held:
            controls.hold(name)
            if self._config.input == "single" and not on:
                controls.forget_taps()
        else:
            controls.release(name)

    def _choose(self, player: str, name: str, held: bool | None, on: bool) -> None:
        """A press, or a key going down or up, turn by turn. Raises CommandRefused."""
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

    def said_at(self, player: str, ns: int) -> None:
        """Note when the present message came. With `timed_keys`, an action that it chooses has this time."""
        self.controls[player].time = ns

    def let_go(self, player: str | None = None) -> None:
        """Let go of all keys of this human, or of all humans."""
        for name in self._humans if player is None else (player,):
            self.controls[name].clear()

    def forget_taps(self) -> None:
        """Forget presses that no step has acted on. Keys that are held stay."""
        for controls in self.controls.values():
            controls.forget_taps()

    # ---- a step

    def next_actions(self, steps: int) -> Mapping[str, Action]:
        """Each player's action of the step that begins now. `advice` is for this step; it counts if no key acts."""
        view, turns = self._view, self.turns
        actions: dict[str, Action] = {}
        for name, player in self._players.items():
            if view is not None and name not in view.to_act:
                actions[name] = Action(player.idle, player.action_space[player.idle], acts=False)
            elif turns is not None:
                actions[name] = turns.chosen[name]
            elif name in self.policies:
                actions[name] = self.policies.take(name, self._mask(name), steps)
            else:
                actions[name] = self._asked_for(player)
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
        if human and self.timed_keys:
            return Action(index, player.action_space[index], "human", pressed_at=self.controls[name].pressed_at)
        return self._usual[name][index][human]

    # ---- policies

    def asks(self, steps: int, now: float) -> Sequence[AskPolicy]:
        """What to ask the policies, now that the players see something."""
        return self.policies.asks(self._view, steps, now) if self._view is not None and self.policies else ()

    def take_place(self, player: str, plays: str) -> None:
        """From now on a policy plays in the place of a human."""
        self.let_go(player)
        self.policies.take_place(replace(self._players[player], plays=plays))

    def ask(self, player: str, steps: int, now: float) -> AskPolicy | None:
        """What to ask the policy that has taken a place; None if it is not to act now."""
        view = self._view
        return self.policies.ask(player, view, steps, now) if view is not None and player in view.to_act else None

    # ---- turn by turn

    def policies_choose(self, now: float) -> None:
        """Take the choices of all policies that have answered, or whose time is over."""
        turns = self.turns
        for name in self._waiting():
            if turns is not None and name in self.policies:
                action = self.policies.choice(name, self._mask(name), now)
                if action is not None:
                    turns.choose(name, action)

    def turn_over(self, steps: int) -> bool:
        """The time of the turn is over: choose for the humans who did not, and return whether the episode ends.

        What a program has advised is taken first; else `turnEnds` decides.
        """
        turns = self.turns
        for name in self._waiting():
            player, mask = self._players[name], self._mask(name)
            if turns is None or name in self.policies:
                continue
            advice = self._advice.get(name)
            if advice is not None and is_legal(advice, mask):
                turns.choose(name, Action(advice, player.action_space[advice], "advice"))
            elif self._config.turn_ends == "episode":
                return True
            elif self._config.turn_ends == "random":
                index = random_action(player, mask, policy_seed(self.seed, f"{name}/{steps}"))
                turns.choose(name, Action(index, player.action_space[index], "random"))
            else:
                index = legal_or_idle(player.idle, player, mask)
                turns.choose(name, Action(index, player.action_space[index]))
        return False

    def _waiting(self) -> tuple[str, ...]:
        turns = self.turns
        return () if turns is None else tuple(name for name in self._players if turns.waits_for(name))

    @property
    def waits_for(self) -> tuple[str, ...]:
        """The humans for whom the game waits; none in real time."""
        turns, policies = self.turns, self.policies
        if turns is None:
            return ()
        return tuple(name for name in self._players if turns.waits_for(name) and name not in policies)

    def policies_until(self) -> float | None:
        """When the time of a policy for which the game waits is over; None if it waits for none."""
        return self.policies.until(self._waiting())

    # ---- programs

    def advise(self, action: int, player: str | None = None) -> None:
        """A program advises this action for the next step, or chooses it for a player that it plays.

        Without `player` it is the first player that a program plays, or else the first human. Raises CommandRefused if
        there is no such action or player.
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
            by_program = (each.name for each in self._players.values() if each.by_program)
            player = next(by_program, self._humans[0])
        known = self._players.get(player)
        if known is None:
            raise CommandRefused(f"there is no such player; there are {', '.join(self._players)}")
        return known
