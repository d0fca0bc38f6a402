"""The clients of all humans: what is sent to them, and what they may ask for. Pure: it emits effects."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hippodrome.protocol.trial import TrialSection
from hippodrome.trial.core import messages
from hippodrome.trial.core.controls import ARROWS, KEY
from hippodrome.trial.core.effects import Close, Effect, Pictures, SendMessage, SendPicture, SendState, SendTalk
from hippodrome.trial.core.history import MessageLog
from hippodrome.trial.core.messages import CommandRefused, Message
from hippodrome.trial.core.participants import Alone, Participants
from hippodrome.trial.core.progress import TrialProgress
from hippodrome.trial.core.talk import Talk
from hippodrome.trial.core.timing import StateTimes, Timing, Window

REPLACED = "the game was opened in another tab or device, and goes on there"

LOOK_AGAIN = 0.1
"""Seconds from the first look that finds a client stalled to the one that counts."""


@dataclass(slots=True)
class Client:
    """A human's connection, and the player that the human plays."""

    connection: Hashable
    window: Window
    player: str
    sent: tuple[object, ...] = ()
    """The values (`Clients.state_of`) that the client was sent last."""
    found_stalled: tuple[float, int] | None = None
    """When a look found the client stalled first, and how many acknowledgements had come; None if it is not stalled."""

    def stalled(self, now: float) -> bool | None:
        """Return whether the client has stopped acknowledging frames; None if that is to be looked at again.

        One look is not enough: if this process could not run for some seconds, the acknowledgements of that time have
        come, and are read only afterwards.
        """
        if not self.window.stalled(now):
            self.found_stalled = None
            return False
        acknowledgements = self.window.acknowledgements
        if self.found_stalled is None or self.found_stalled[1] != acknowledgements:
            self.found_stalled = now, acknowledgements
        return now - self.found_stalled[0] >= LOOK_AGAIN or None


class Clients:
    """The clients of all humans, at most one for each. A client shows the picture, score and turn of its player."""

    def __init__(
        self,
        config: TrialSection,
        timing: Timing,
        emit: Callable[[Effect], None],
        assets: Sequence[Mapping[str, Any]],
    ) -> None:
        """`assets` describe the images of a game that is drawn by objects."""
        self._timing = timing
        self._emit = emit
        self._scene = _scene_fields(config, assets)
        self._timed = config.pace == "turns" or bool(config.reset_freeze or config.episode_seconds)
        """Whether the message with the state holds times also while the game is on."""
        self.by_human: dict[str, Client] = {}
        """The connected clients, by human."""
        self.pictures: Pictures | None = None
        """The pictures that clients show now; None before the first ones."""
        self.frame_id = 0
        """The id of these pictures."""
        self.talk: Talk | None = None
        """The talk of the trial; None if nobody talks."""
        self._members: Hashable = None
        """The last value of `TrialSession.session_version`; None if one participant plays."""

    def add(self, human: str, connection: Hashable, window: Window, player: str) -> Client:
        """Add a client of the human who plays this player. The human's earlier client must have been removed."""
        client = self.by_human[human] = Client(connection, window, player)
        return client

    def replace(self, human: str) -> Client | None:
        """Close, remove and return the client of a human who opens another one; None if the human has none."""
        client = self.by_human.pop(human, None)
        if client is not None:
            self._emit(Close(client.connection, 4409, messages.error(REPLACED)))
        return client

    def remove(self, connection: Hashable) -> Client | None:
        """Remove a connection that is closed, and return its client; None if another has replaced it."""
        human = next((human for human, each in self.by_human.items() if each.connection == connection), None)
        return None if human is None else self.by_human.pop(human)

    def of(self, connection: Hashable) -> Client | None:
        """Return the client with this connection; None if another has replaced it."""
        return next((each for each in self.by_human.values() if each.connection == connection), None)

    def stalled(self, now: float) -> list[Client] | None:
        """Return the clients that have stopped acknowledging frames; None if that is to be looked at again."""
        found = [(client, client.stalled(now)) for client in self.by_human.values()]
        if any(stalled is None for _, stalled in found):
            return None
        return [client for client, stalled in found if stalled]

    def send(self, client: Client, text: str) -> None:
        """Send a message to one client."""
        self._emit(SendMessage(client.connection, text))

    def send_all(self, text: str) -> None:
        """Send a message to all clients."""
        for client in self.by_human.values():
            self.send(client, text)

    def say_each(self, words_for: Callable[[str], str | None]) -> None:
        """Send each client the sentence that `words_for` returns for its player. None: send nothing."""
        for client in self.by_human.values():
            words = words_for(client.player)
            if words is not None:
                self.send(client, messages.error(words))

    def send_controls(self, client: Client, progress: TrialProgress, participants: Participants, now: float) -> None:
        """Send a client the message with everything about the game and its controls (`messages.controls`)."""
        times = self._timing.state_times(progress, now, participants.session_fields(now))
        chat = {} if self.talk is None else {"chat": self.talk.fields(client.player)}
        self.send(client, _controls_text(progress, client.player, times, self._scene, chat))

    def send_talk(self, player: str, fields: Mapping[str, Any]) -> None:
        """Send the client of this player, if there is one, a message about talk."""
        for client in self.by_human.values():
            if client.player == player:
                self._emit(SendTalk(client.connection, fields))

    def send_state(self, progress: TrialProgress, participants: Participants, now: float) -> None:
        """Send each client the state of its trial, if one of the values in it has changed."""
        self._members = participants.session_version()
        for client in self.by_human.values():
            player = client.player
            state = self.state_of(progress, player)
            if client.sent == state:
                continue
            client.sent = state
            times = None
            if self._timed or progress.on_break or self._members is not None:
                times = self._timing.state_times(progress, now, participants.session_fields(now))
            text = messages.state(
                progress.state.value,
                progress.episode,
                progress.scores[player],
                progress.frame_rate,
                episode_score=progress.episode_scores[player],
                **(_state_arguments(progress, player, times) if times is not None else {}),
            )
            self._emit(SendState(client.connection, text, progress.frame_rate))

    def state_of(self, progress: TrialProgress, player: str) -> tuple[object, ...]:
        """Return the state, the episode, the score and others: if one changes, a client is sent the state again."""
        score, to_act = progress.scores[player], progress.turns is not None and progress.to_act(player)
        frozen, choice = progress.shows_first_picture, progress.choice_of(player)
        return progress.state, progress.episode, score, progress.frame_rate, frozen, self._members, to_act, choice

    def show(self, pictures: Pictures) -> None:
        """Send each client its new picture, under a new frame id."""
        self.pictures = pictures
        self.frame_id = (self.frame_id + 1) & 0xFFFFFFFF
        for client in self.by_human.values():
            self.show_again(client)

    def show_again(self, client: Client) -> None:
        """Send a client its present picture, if there is one."""
        picture = self.pictures.get(client.player) if isinstance(self.pictures, dict) else self.pictures
        if picture is not None:
            self._emit(SendPicture(client.connection, picture, self.frame_id))


def _state_arguments(progress: TrialProgress, player: str, times: StateTimes) -> dict[str, Any]:
    """Return the arguments of `messages.state` that say the times, the player's turn and the session."""
    arguments = times._asdict()
    if progress.turns is not None:
        arguments["to_act"] = progress.to_act(player)
        arguments["chosen"], arguments["time_up"] = progress.choice_of(player)
        if not arguments["to_act"]:
            arguments["turn_ends_in"] = None
    if times.session is not None:
        arguments["session"] = {**times.session, "you": player}
    return arguments


def _controls_text(
    progress: TrialProgress,
    player: str,
    times: StateTimes,
    scene: Mapping[str, Any] | None,
    chat: Mapping[str, Any],
) -> str:
    """Build the message about the game and its controls for this player's client.

    `scene` is from `_scene_fields`. `chat` has the field about talk, if there is talk.
    """
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
        input_of_project={**_input_fields(config, player), **chat},
        **_state_arguments(progress, player, times),
    )


def _scene_fields(config: TrialSection, assets: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """Return the fields of a game that is drawn by objects; None for other games."""
    if config.scene is None:
        return None
    scene = {key: value for key, value in config.document()["scene"].items() if key != "assets"}
    return {"scene": scene, "assets": list(assets)}


def _input_fields(config: TrialSection, player: str) -> dict[str, Any]:
    """Return the fields about the project's `keys`, `labels` and `input`, as far as the project has them."""
    keys, labels = config.keys_of(player), config.labels_of(player)
    fields = {"keys": dict(keys), "labels": dict(labels), "input": "single" if config.input == "single" else ""}
    return {name: value for name, value in fields.items() if value}


ALWAYS_ALLOWED = frozenset({"start", "requestUI"})
"""The commands that a client may send whatever the project's `ui` says: without `start`, no game could be played."""
_COMBINED = re.compile(r"(?:up|down|left|right|fire)+")


class Commands:
    """Carries out the clients' commands, actions and keys. `reset` and `stop` wait for the end of a step."""

    def __init__(self, config: TrialSection, clients: Clients, message_log: MessageLog) -> None:
        shown = config.ui.shown()
        self._config = config
        self._offered = (*shown, *ARROWS) if config.keys else shown
        self._clients = clients
        self._message_log = message_log
        self.waiting: list[str] = []
        """The commands that wait for the end of a step."""
        self.closed = False
        """Whether the server must end: then commands have no effect any more."""

    def receive(
        self, client: Client, message: Message, progress: TrialProgress, participants: Participants, now: float
    ) -> bool:
        """Record a client's message, carry it out, and return True. If it is refused, tell the client why."""
        try:
            self._check(message, progress, participants)
            self._message_log.add(message, int(now * 1e9), participants.name_of(client.player))
            if message.command == "requestUI":
                self._clients.send_controls(client, progress, participants, now)
            self._carry_out(message, client.player, progress, participants, now)
        except CommandRefused as refused:
            self._clients.send(client, messages.error(str(refused)))
            return False
        return True

    def _check(self, message: Message, progress: TrialProgress, participants: Participants) -> None:
        """Raise CommandRefused if the project does not offer what the message asks for. It is not recorded then."""
        if message.hidden is not None and isinstance(participants, Alone):
            raise CommandRefused("unknown field 'hidden'")
        if (message.say is not None or message.typing is not None) and self._config.chat is None:
            raise CommandRefused("nobody talks in this game")
        if message.frame_rate is not None and not self._config.allow_frame_rate_change:
            raise CommandRefused("the frame rate of this game is fixed")
        missing = not_offered(message, self._offered)
        if missing is not None:
            raise CommandRefused(f"{missing} is not offered in this game")
        if message.form is not None and message.form.page not in self._config.pages:
            raise CommandRefused(f"this game has no page {message.form.page}")
        if (messages.is_feedback(message.command) or message.form is not None) and progress.over:
            raise CommandRefused("the game is over, and no command has an effect any more")

    def _carry_out(
        self, message: Message, player: str, progress: TrialProgress, participants: Participants, now: float
    ) -> None:
        """Carry out a message of the human who plays `player`. Raises CommandRefused if it is not possible now."""
        if message.command is not None and not self.closed:
            self._command(message.command, player, participants, now)
        if message.frame_rate is not None:
            progress.change_frame_rate(message.frame_rate)
        if message.action is not None:
            progress.act(message.action, message.held, lasts=message.lasts, player=player)
        if message.key is not None:
            progress.act(KEY + message.key, message.held, player=player)

    def _command(self, command: str, player: str, participants: Participants, now: float) -> None:
        if command == "start":
            participants.start(player, now)
        elif command == "pause":
            participants.pause(now)
        elif command in ("reset", "stop") and command not in self.waiting:
            self.waiting.append(command)
            if command == "stop":
                participants.stop(player)

    def carry_out_waiting(self, progress: TrialProgress, participants: Participants, timing: Timing) -> None:
        """Carry out the commands that have waited for the end of a step."""
        commands, self.waiting = self.waiting, []
        for command in commands:
            timing.skip()
            if command == "stop":
                progress.stop()
                participants.stopped()
            else:
                progress.reset()


def not_offered(message: Message, ui: Collection[str]) -> str | None:
    """Return the control that a client needs for this message and `ui` lacks; None if `ui` lacks none.

    `ui` are the names of the controls that the project shows.
    """
    command, wish, name = message.command, message.frame_rate, message.action
    if command is not None and command not in ALWAYS_ALLOWED and command not in ui:
        return command
    if wish is not None:
        control = messages.FRAME_RATE_CONTROLS.get(str(wish), "fpsSet")
        if control not in ui:
            return control
    if name is not None and _COMBINED.fullmatch(name):
        keys = re.findall("up|down|left|right", name)
        return next((key for key in keys if key not in ui), None)
    return None
