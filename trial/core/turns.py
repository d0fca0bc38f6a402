"""Turn by turn: who is to act, what they chose, and the time they have. Pure; the clock is passed in.

The game waits until all who are to act have chosen. A choice is final: it cannot be taken back.
"""

from __future__ import annotations

from trial.core.actions import Action


class Turns:
    """The turns of a game, one after the other. `seconds`: the time of the humans for each; 0: no limit."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._left = seconds
        self._since: float | None = None  # the clock runs since then
        self.to_act: frozenset[str] = frozenset()
        self.chosen: dict[str, Action] = {}

    def begin(self, to_act: frozenset[str]) -> None:
        """A turn begins. Its time does not run before `run`."""
        self.to_act = to_act
        self.chosen = {}
        self._left, self._since = self._seconds, None

    def waits_for(self, player: str) -> bool:
        """Whether it is the player's turn, and they have not chosen."""
        return player in self.to_act and player not in self.chosen

    @property
    def waiting(self) -> bool:
        """Whether the game waits for any player."""
        return len(self.chosen) < len(self.to_act)

    def choose(self, player: str, action: Action) -> None:
        """The player chooses. A choice that they made before in this turn stays."""
        if self.waits_for(player):
            self.chosen[player] = action

    def run(self, now: float) -> None:
        """The game is on: the time of the turn runs."""
        if self._since is None:
            self._since = now

    def hold(self, now: float) -> None:
        """The game is held: the time of the turn does not run."""
        self._left, self._since = self.left(now), None

    def left(self, now: float) -> float:
        """Seconds that are left in this turn. Without a limit the number means nothing."""
        return self._left if self._since is None else self._left - (now - self._since)

    def ends_in(self, now: float) -> float | None:
        """Seconds that are left in this turn, from 0; None if there is no limit."""
        return max(0.0, self.left(now)) if self._seconds else None
