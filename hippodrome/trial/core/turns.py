"""The turns of a game: which players are to act, what they have chosen, and their time. Pure; the clock is passed in.

The game waits until all players who are to act have chosen. A choice is final: it cannot be taken back.
"""

from __future__ import annotations

from hippodrome.trial.core.actions import Action


class Turns:
    """Keeps the present turn of a game. `seconds`: the time that humans have for each turn; 0: no limit."""

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
