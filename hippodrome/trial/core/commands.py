"""The commands of clients: checks whether they are offered, carries them out, or tells the client why not. Pure."""

from __future__ import annotations

import re
from collections.abc import Collection

from hippodrome.protocol.trial import TrialSection
from hippodrome.trial.core import messages
from hippodrome.trial.core.clients import Client, Clients
from hippodrome.trial.core.controls import ARROWS, KEY
from hippodrome.trial.core.message_log import MessageLog
from hippodrome.trial.core.messages import CommandRefused, Message
from hippodrome.trial.core.participants import Alone, Participants
from hippodrome.trial.core.progress import TrialProgress
from hippodrome.trial.core.timing import Timing

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
