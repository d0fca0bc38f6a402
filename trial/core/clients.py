"""The connections of all players, and what they have been sent. Pure: it emits effects."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass

from trial.core import messages
from trial.core.effects import Close, Effect, SendDone, SendFrame, SendMessage, SendState
from trial.core.flow_control import Window
from trial.core.progress import Progress
from trial.pictures.frames import Frame

REPLACED = "the game was opened in another tab or device, and goes on there"


@dataclass(slots=True)
class Client:
    """A player's connection."""

    connection: Hashable
    window: Window
    sent: tuple[object, ...] = ()
    """The state that was sent last."""


class Clients:
    """Every player has one connection at most, and all of them are shown the same."""

    def __init__(self, emit: Callable[[Effect], None]) -> None:
        self._emit = emit
        self._by_player: dict[str, Client] = {}
        self.frame: Frame | None = None
        """The frame that is shown."""
        self.frame_id = 0

    def add(self, player: str, connection: Hashable, window: Window) -> Client:
        """Add a connection. One that the player has already must have been removed."""
        client = self._by_player[player] = Client(connection, window)
        return client

    def replace(self, player: str) -> bool:
        """Close the connection of a player who opens another one; whether there was any."""
        client = self._by_player.pop(player, None)
        if client is not None:
            self._emit(Close(client.connection, 4409, messages.error(REPLACED)))
        return client is not None

    def remove(self, connection: Hashable) -> str | None:
        """Forget a connection that is closed, and return its player; None if it was replaced before."""
        player = next((player for player, each in self._by_player.items() if each.connection == connection), None)
        if player is not None:
            del self._by_player[player]
        return player

    def of(self, connection: Hashable) -> Client | None:
        """The client with this connection; None if it was replaced."""
        return next((each for each in self._by_player.values() if each.connection == connection), None)

    def stalled(self, now: float) -> bool:
        """Whether one of them has stopped acknowledging frames."""
        return any(client.window.stalled(now) for client in self._by_player.values())

    def send(self, client: Client, text: str) -> None:
        """Send a message to one client."""
        self._emit(SendMessage(client.connection, text))

    def send_all(self, text: str) -> None:
        """Send a message to all clients."""
        for client in self._by_player.values():
            self.send(client, text)

    def send_state(self, progress: Progress, next_in: float | None) -> None:
        """Send the state to those clients that were sent another one. `next_in`: seconds of a break that are left."""
        state = state_of(progress)
        for client in self._by_player.values():
            if client.sent == state:
                continue
            client.sent = state
            text = messages.state(
                progress.state.value,
                progress.episode,
                progress.score,
                progress.frame_rate,
                episode_score=progress.episode_score,
                next_in=next_in,
            )
            self._emit(SendState(client.connection, text, progress.frame_rate))

    def show(self, frame: Frame) -> None:
        """Show all clients a new frame."""
        self.frame = frame
        self.frame_id = (self.frame_id + 1) & 0xFFFFFFFF
        for client in self._by_player.values():
            self._emit(SendFrame(client.connection, frame, self.frame_id))

    def show_again(self, client: Client) -> None:
        """Show a new client the present frame, if there is one."""
        if self.frame is not None:
            self._emit(SendFrame(client.connection, self.frame, self.frame_id))

    def send_done(self, episodes: int, score: float) -> None:
        """Tell all clients that the trial is over and stored."""
        for client in self._by_player.values():
            self._emit(SendDone(client.connection, episodes, score))


def state_of(progress: Progress) -> tuple[object, ...]:
    """What is sent to clients whenever one of these changes."""
    return progress.state, progress.episode, progress.score, progress.frame_rate
