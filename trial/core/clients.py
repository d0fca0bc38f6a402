"""The connections of all humans, and what they have been sent. Pure: it emits effects."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from protocol.trial import Trial
from trial.core import messages
from trial.core.effects import Close, Effect, Pictures, SendDone, SendMessage, SendPicture, SendState
from trial.core.flow_control import Window
from trial.core.progress import Progress

REPLACED = "the game was opened in another tab or device, and goes on there"


class StateTimes(NamedTuple):
    """Seconds that are left: of a break, of a turn, of the first picture, of the episode. None: there is none."""

    next_in: float | None = None
    turn_ends_in: float | None = None
    starts_in: float | None = None
    time_left: float | None = None


@dataclass(slots=True)
class Client:
    """A human's connection, and the player of the environment that they play."""

    connection: Hashable
    window: Window
    player: str
    sent: tuple[object, ...] = ()
    """The state that was sent last."""


class Clients:
    """Every human has one connection at most. Each is shown their player's picture, score and turn."""

    def __init__(self, emit: Callable[[Effect], None]) -> None:
        self._emit = emit
        self._by_human: dict[str, Client] = {}
        self._places: dict[str, str] = {}  # the player of each human, as long as the trial goes on
        self.pictures: Pictures | None = None
        """What is shown."""
        self.frame_id = 0

    def add(self, human: str, connection: Hashable, window: Window, places: Sequence[str]) -> Client:
        """Add a connection. One that the human has already must have been removed.

        A human who comes first gets the first of the `places` that no other human has, or else the first.
        """
        if human not in self._places:
            taken = self._places.values()
            self._places[human] = next((place for place in places if place not in taken), places[0])
        client = self._by_human[human] = Client(connection, window, self._places[human])
        return client

    def replace(self, human: str) -> Client | None:
        """Close the connection of a human who opens another one; the one that was closed."""
        client = self._by_human.pop(human, None)
        if client is not None:
            self._emit(Close(client.connection, 4409, messages.error(REPLACED)))
        return client

    def remove(self, connection: Hashable) -> Client | None:
        """Forget a connection that is closed; None if it was replaced before."""
        human = next((human for human, each in self._by_human.items() if each.connection == connection), None)
        return None if human is None else self._by_human.pop(human)

    def of(self, connection: Hashable) -> Client | None:
        """The client with this connection; None if it was replaced."""
        return next((each for each in self._by_human.values() if each.connection == connection), None)

    def stalled(self, now: float) -> list[Client]:
        """Those that have stopped acknowledging frames."""
        return [client for client in self._by_human.values() if client.window.stalled(now)]

    def send(self, client: Client, text: str) -> None:
        """Send a message to one client."""
        self._emit(SendMessage(client.connection, text))

    def send_all(self, text: str) -> None:
        """Send a message to all clients."""
        for client in self._by_human.values():
            self.send(client, text)

    def send_state(self, progress: Progress, times: Callable[[], StateTimes] | None) -> None:
        """Send the state to those clients that were sent another one, with the times as they are then, if there are."""
        for client in self._by_human.values():
            player = client.player
            state = state_of(progress, player)
            if client.sent == state:
                continue
            client.sent = state
            text = messages.state(
                progress.state.value,
                progress.episode,
                progress.scores[player],
                progress.frame_rate,
                episode_score=progress.episode_scores[player],
                **(of_state(progress, player, times()) if times is not None else {}),
            )
            self._emit(SendState(client.connection, text, progress.frame_rate))

    def show(self, pictures: Pictures) -> None:
        """Show each client its new picture."""
        self.pictures = pictures
        self.frame_id = (self.frame_id + 1) & 0xFFFFFFFF
        for client in self._by_human.values():
            self.show_again(client)

    def show_again(self, client: Client) -> None:
        """Show a client its present picture, if there is one."""
        picture = self.pictures.get(client.player) if isinstance(self.pictures, dict) else self.pictures
        if picture is not None:
            self._emit(SendPicture(client.connection, picture, self.frame_id))

    def send_done(self, episodes: int, scores: Mapping[str, float], score: float) -> None:
        """Tell all clients that the trial is over and stored. `score` is that of a player who is not in `scores`."""
        for client in self._by_human.values():
            self._emit(SendDone(client.connection, episodes, scores.get(client.player, score)))


def state_of(progress: Progress, player: str) -> tuple[object, ...]:
    """What is sent to clients whenever one of these changes."""
    state: tuple[object, ...] = (progress.state, progress.episode, progress.scores[player], progress.frame_rate)
    if progress.stands:
        state = (*state, "stands")
    return state if progress.turns is None else (*state, progress.to_act(player))


def of_state(progress: Progress, player: str, times: StateTimes) -> dict[str, Any]:
    """What a client is told of the times and of its turn."""
    turn = turn_of(progress, player, times.turn_ends_in)
    return {"next_in": times.next_in, "starts_in": times.starts_in, "time_left": times.time_left, **turn}


def turn_of(progress: Progress, player: str, ends_in: float | None) -> dict[str, Any]:
    """What a client is told of the turn: nothing in real time."""
    if progress.turns is None:
        return {}
    mine = progress.to_act(player)
    return {"to_act": mine, "turn_ends_in": ends_in if mine else None}


def controls_of(progress: Progress, player: str, times: StateTimes, scene: Mapping[str, Any] | None) -> str:
    """The message that tells a client all of the game and of its controls. `scene` as `scene_of` has it."""
    config, action_space = progress.config, progress.players[player].action_space
    return messages.controls(
        ui=config.ui.shown(),
        words=[word for word in messages.words_of(config) if word.lower() not in action_space],
        frame_rate=progress.frame_rate,
        min_frame_rate=config.min_frame_rate,
        max_frame_rate=config.max_frame_rate,
        frame_rate_step_size=config.frame_rate_step_size,
        allow_frame_rate_change=config.allow_frame_rate_change,
        action_space=action_space,
        state=progress.state.value,
        episode=progress.episode,
        max_episodes=config.max_episodes,
        score=progress.scores[player],
        episode_score=progress.episode_scores[player],
        player=player,
        players=tuple(progress.players),
        scene=scene,
        input_of_project=_input(config, player),
        **of_state(progress, player, times),
    )


def scene_of(config: Trial, assets: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """What a client is told of a game that is drawn by objects; None if it is not."""
    if config.scene is None:
        return None
    told = {key: value for key, value in config.document()["scene"].items() if key != "assets"}
    return {"scene": told, "assets": list(assets)}


def _input(config: Trial, player: str) -> dict[str, Any]:
    """What a client is told of the project's keys and buttons; nothing where the actions' names decide."""
    keys, labels = config.keys_of(player), config.labels
    said = {"keys": dict(keys), "labels": dict(labels), "input": "single" if config.input == "single" else ""}
    return {name: value for name, value in said.items() if value}
