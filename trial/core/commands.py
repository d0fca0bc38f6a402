"""What a client asks for: whether it may, and what that does to the game. Pure."""

from __future__ import annotations

from protocol.trial import Trial
from trial.core import messages
from trial.core.alone import Alone
from trial.core.controls import ARROWS, KEY
from trial.core.messages import CommandRefused, Message
from trial.core.progress import Progress
from trial.core.session import Session
from trial.core.timing import Timing


class Commands:
    """The clients' commands, actions and keys. `reset` and `stop` wait for the end of a step."""

    def __init__(self, config: Trial) -> None:
        shown = config.ui.shown()
        self._config = config
        self._offered = (*shown, *ARROWS) if config.keys else shown
        self.waiting: list[str] = []
        """Those that wait for the end of a step."""
        self.closed = False
        """The server must end, which has ended what was on: commands do nothing any more."""

    def check(self, message: Message, progress: Progress) -> None:
        """Raise CommandRefused, with words for the client, if the project does not offer what is asked for."""
        if message.frame_rate is not None and not self._config.allow_frame_rate_change:
            raise CommandRefused("the frame rate of this game is fixed")
        missing = messages.not_offered(message, self._offered)
        if missing is not None:
            raise CommandRefused(f"{missing} is not offered in this game")
        if messages.is_feedback(message.command) and progress.over:
            raise CommandRefused("the game is over, and no command has an effect any more")

    def carry_out(
        self, message: Message, player: str, progress: Progress, session: Alone | Session, now: float
    ) -> None:
        """Do what the human who plays `player` asks for. Raises CommandRefused if it is not possible now."""
        if message.command is not None and not self.closed:
            self._command(message.command, player, session, now)
        if message.frame_rate is not None:
            progress.change_frame_rate(message.frame_rate)
        if message.action is not None:
            progress.act(message.action, message.held, lasts=message.lasts, player=player)
        if message.key is not None:
            progress.act(KEY + message.key, message.held, player=player)

    def _command(self, command: str, player: str, session: Alone | Session, now: float) -> None:
        if command == "start":
            session.start(player, now)
        elif command == "pause":
            session.pause(now)
        elif command in ("reset", "stop") and command not in self.waiting:
            self.waiting.append(command)
            if command == "stop":
                session.stop(player)

    def carry_out_waiting(self, progress: Progress, session: Alone | Session, timing: Timing) -> None:
        """No step is being taken: do what has waited for that."""
        commands, self.waiting = self.waiting, []
        for command in commands:
            timing.skip()
            if command == "stop":
                progress.stop()
                session.stopped()
            else:
                progress.reset()
