"""The connections of all humans, and what they have been sent. Pure: it emits effects."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from protocol.trial import TrialSection
from trial.core import messages
from trial.core.effects import Close, Effect, Pictures, SendDone, SendMessage, SendPicture, SendState
from trial.core.flow_control import Window
from trial.core.participants import Participants
from trial.core.progress import TrialProgress
from trial.core.timing import StateTimes, Timing

REPLACED = "the game was opened in another tab or device, and goes on there"


@dataclass(slots=True)
class Client:
    """A human's connection, and the player of the environment that they play."""

    connection: Hashable
    window: Window
    player: str
    sent: tuple[object, ...] = ()
    """The state that was sent last."""


class Clients:
    """The connections of all humans, one at most for each. Each shows the picture, score and turn of their player."""

    def __init__(
        self,
        config: TrialSection,
        timing: Timing,
        emit: Callable[[Effect], None],
        assets: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        """`assets` are the images of a game that is drawn by objects."""
        self._timing = timing
        self._emit = emit
        self._scene = _scene_of(config, assets)
        self._timed = config.pace == "turns" or bool(config.reset_freeze or config.episode_seconds)
        """Clients are told of times also while the game goes on."""
        self._by_human: dict[str, Client] = {}
        self.pictures: Pictures | None = None
        """What is shown."""
        self.frame_id = 0

    def add(self, human: str, connection: Hashable, window: Window, player: str) -> Client:
        """Add a connection of the human who plays this player. An earlier connection must have been removed before."""
        client = self._by_human[human] = Client(connection, window, player)
        return client

    def replace(self, human: str) -> Client | None:
        """Close the connection of a human who opens another one, and return it; None if they have none."""
        client = self._by_human.pop(human, None)
        if client is not None:
            self._emit(Close(client.connection, 4409, messages.error(REPLACED)))
        return client

    def remove(self, connection: Hashable) -> Client | None:
        """Remove a connection that is closed, and return its client; None if another has replaced it."""
        human = next((human for human, each in self._by_human.items() if each.connection == connection), None)
        return None if human is None else self._by_human.pop(human)

    def of(self, connection: Hashable) -> Client | None:
        """The client with this connection; None if another has replaced it."""
        return next((each for each in self._by_human.values() if each.connection == connection), None)

    def stalled(self, now: float) -> list[Client]:
        """The clients that have stopped acknowledging frames."""
        return [client for client in self._by_human.values() if client.window.stalled(now)]

    def send(self, client: Client, text: str) -> None:
        """Send a message to one client."""
        self._emit(SendMessage(client.connection, text))

    def send_all(self, text: str) -> None:
        """Send a message to all clients."""
        for client in self._by_human.values():
            self.send(client, text)

    def say_each(self, words_for: Callable[[str], str | None]) -> None:
        """Send each client, by its player, these words as an error; None: send nothing."""
        for client in self._by_human.values():
            words = words_for(client.player)
            if words is not None:
                self.send(client, messages.error(words))

    def send_controls(self, client: Client, progress: TrialProgress, participants: Participants, now: float) -> None:
        """Send a client everything about the game and its controls."""
        times = self._timing.told(progress, now, participants.told(now))
        self.send(client, _controls_of(progress, client.player, times, self._scene))

    def send_state(self, progress: TrialProgress, participants: Participants, now: float) -> None:
        """Send the state, with all seconds that are left, to each client whose last state was another one."""
        progress.told = participants.state()
        for client in self._by_human.values():
            player = client.player
            state = state_of(progress, player)
            if client.sent == state:
                continue
            client.sent = state
            times = None
            if self._timed or progress.on_break or progress.told is not None:
                times = self._timing.told(progress, now, participants.told(now))
            text = messages.state(
                progress.state.value,
                progress.episode,
                progress.scores[player],
                progress.frame_rate,
                episode_score=progress.episode_scores[player],
                **(_of_state(progress, player, times) if times is not None else {}),
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

    def by_human(self) -> list[tuple[str, Client]]:
        """All connected clients, each with the human whose it is."""
        return list(self._by_human.items())

    def send_done(self, client: Client, episodes: int, score: float, outcome: str | None = None) -> None:
        """Tell a client that the trial is over and stored. `outcome` says how a session has ended for its member."""
        self._emit(SendDone(client.connection, episodes, score, outcome))


def state_of(progress: TrialProgress, player: str) -> tuple[object, ...]:
    """What the clients' state shows. When one of these values changes, the state is sent again."""
    score, to_act = progress.scores[player], progress.turns is not None and progress.to_act(player)
    return progress.state, progress.episode, score, progress.frame_rate, progress.stands, progress.told, to_act


def _of_state(progress: TrialProgress, player: str, times: StateTimes) -> dict[str, Any]:
    """What a client is told of the times and of its turn."""
    turn = _turn_of(progress, player, times.turn_ends_in)
    said = {"next_in": times.next_in, "starts_in": times.starts_in, "time_left": times.time_left, **turn}
    return said if times.session is None else {**said, "session": {**times.session, "you": player}}


def _turn_of(progress: TrialProgress, player: str, ends_in: float | None) -> dict[str, Any]:
    """What a client is told of the turn: nothing in real time."""
    if progress.turns is None:
        return {}
    mine = progress.to_act(player)
    return {"to_act": mine, "turn_ends_in": ends_in if mine else None}


def _controls_of(progress: TrialProgress, player: str, times: StateTimes, scene: Mapping[str, Any] | None) -> str:
    """The message that tells a client all of the game and of its controls. `scene` as `_scene_of` has it."""
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
        **_of_state(progress, player, times),
    )


def _scene_of(config: TrialSection, assets: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """What a client is told of a game that is drawn by objects; None if it is not."""
    if config.scene is None:
        return None
    told = {key: value for key, value in config.document()["scene"].items() if key != "assets"}
    return {"scene": told, "assets": list(assets)}


def _input(config: TrialSection, player: str) -> dict[str, Any]:
    """What a client is told of the project's keys and buttons; nothing where the actions' names decide."""
    keys, labels = config.keys_of(player), config.labels_of(player)
    said = {"keys": dict(keys), "labels": dict(labels), "input": "single" if config.input == "single" else ""}
    return {name: value for name, value in said.items() if value}
