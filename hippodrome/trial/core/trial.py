"""The core of a trial: every decision about one game step, from the first frame to the stored answer. Pure.

`Trial` is a state machine without I/O, threads, asyncio or a clock (a Sans-I/O core). Its shell,
`hippodrome/trial/server/loop.py`, calls a method for each event and carries out the effects
(`hippodrome/trial/core/effects.py`) that the method returns, in their order. All times are seconds of one monotonic
clock.

Events in:
  already_played, start, agent_failed    an earlier server has played the step; the agent has started, or cannot
  connect, disconnect, receive           clients; each connection belongs to a human
  advise                                 a program suggests or chooses an action
  reply_grows, reply_ended, agent_says   what the agent says; `moderated`: what it thinks of a line
  round_trip, member_saved               a member's browser has answered a ping; a member's answer is stored
  call_returned, call_failed             the agent's thread has finished the call that it was given
  policy_acted, policy_failed            a player's policy has answered
  recording_opened, recording_failed, answer_saved        the store
  advance                                the time `wake_at` has come
  close                                  the server must end

Effects out: messages, states and pictures for connections; one call at a time for the agent; questions for policies;
lines for the recording; the answer; lines for the log.

Phases: STARTING until the store was read and the agent has started, PLAYING, SAVING (the last lines, then recordings
and the answer), then FINISHED (the answer is stored) or CLOSED (there is no answer: the server had to end, or the game
could not begin).

This module decides what comes next, and passes each event to the part that it concerns. The other modules decide:
  choices, policies, controls            what each player does at the next step
  progress                               episodes, breaks, scores, and how the trial ends
  timing                                 when a step is due; when a turn, a break or an episode is over
  participants, session, presence        who is connected, and whether the game goes on, is held or ends
  episodes                               how an episode begins (also one of an earlier server), goes on and ends; which
                                         call the agent has now, one at a time
  talk                                   who says what to whom
  history, records                       what has happened, what is recorded of it, and what the answer holds
  clients, messages                      what is sent to clients; what they may ask for, and why it is refused

A player is a place of the environment (`hippodrome/trial/core/players.py`): a human plays it, or a policy. Each
connection belongs to a human, and each human plays one player.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from enum import Enum, auto
from typing import Any, Literal

from hippodrome.trial.core import messages, records
from hippodrome.trial.core.clients import LOOK_AGAIN, Client, Clients, Commands
from hippodrome.trial.core.effects import (
    AgentTimeout,
    Call,
    Effect,
    FeedbackCall,
    ReplayCall,
    SendDone,
    StepCall,
    TellAgent,
    WriteLog,
)
from hippodrome.trial.core.episodes import LAST_CALL_SECONDS, AgentCall, Episodes
from hippodrome.trial.core.history import MessageLog, RecordedTrial
from hippodrome.trial.core.participants import Alone, Participants
from hippodrome.trial.core.players import Player, alone
from hippodrome.trial.core.progress import TrialProgress
from hippodrome.trial.core.records import Recordings, words_of
from hippodrome.trial.core.session import TrialSession
from hippodrome.trial.core.talk import Talk
from hippodrome.trial.core.timing import Due, Timing, Window
from hippodrome.trial.settings import TrialSettings

EPISODE_FAILED = "Something went wrong, so this game has ended. You will continue with the next game."
EPISODE_BEGINS_AGAIN = (
    "This game could not be resumed, so it starts again from the beginning. Your earlier games are saved."
)
TRIAL_FAILED = "Something went wrong, so the game ends here. Everything so far is saved."


class Phase(Enum):
    """The phases of a trial, which the module's docstring explains."""

    STARTING = auto()
    PLAYING = auto()
    SAVING = auto()
    FINISHED = auto()
    CLOSED = auto()


class Trial:
    """Decides everything about the trial of one game step. The module's docstring lists events, effects and phases."""

    _now: float
    """The time of the present event, which sets it first if anything reads it."""

    def __init__(
        self,
        settings: TrialSettings,
        step: str,
        *,
        trial_id: str,
        new_seed: Callable[[], int],
        assets: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        """`new_seed` draws the seed of an episode. `assets` describe the images of a game that is drawn by objects."""
        self.settings = settings
        self.config = settings.trial
        self.step = step
        self.id = trial_id
        self.phase = Phase.STARTING
        self.ready = False
        """Whether there is a first frame, or the trial is over without one."""
        self.callbacks = False
        """Whether the agent has callbacks. They are called when an episode ends, and when players come and go."""
        self.wake_at: float | None = None
        """The time at which the shell must call `advance` if no other event comes before; None if it need not."""
        self.progress = TrialProgress(self.config, alone(self.config.action_space or ("noop",)))
        self._effects: list[Effect] = []
        self._emit = self._effects.append
        self._messages = MessageLog()
        self._timing = Timing(self.config)
        self._recording = Recordings(self._emit)
        self._clients = Clients(self.config, self._timing, self._emit, assets)
        self._commands = Commands(self.config, self._clients, self._messages)
        self._agent = AgentCall(self._emit)
        self._episodes = Episodes(
            settings,
            timing=self._timing,
            recording=self._recording,
            message_log=self._messages,
            clients=self._clients,
            new_seed=new_seed,
            emit=self._emit,
        )
        self._participants: Participants = Alone(self.progress, trial_id)
        self.talk: Talk | None = None
        """What participants and the agent say; None if they do not talk, and before the start."""
        self._failed_words: str | None = None
        self._earlier_answers: Mapping[str, Any] | None = None
        self._have_come: set[str] = set()  # players whose participants have connected at least once

    @property
    def broken(self) -> bool:
        """Whether the game could not begin: there is no frame and will be no answer. Only `ready` makes it known."""
        return self.progress.outcome == "failed" and self._clients.pictures is None

    @property
    def finished(self) -> bool:
        """Whether all recordings and the answer are stored."""
        return self.phase is Phase.FINISHED

    @property
    def played(self) -> bool:
        """Whether the game is over and its last line written. Recordings or the answer may not be stored yet."""
        return self.finished or (self.progress.over and self._episodes.all_written)

    @property
    def done(self) -> bool:
        """Whether the trial has reached its last phase: no event changes anything any more."""
        return self.phase in (Phase.FINISHED, Phase.CLOSED)

    @property
    def saving(self) -> bool:
        """Whether the trial is over, and recordings or the answer are not stored yet."""
        return self.progress.over and not self.finished

    # ---- events: the start

    def already_played(self, answers: Mapping[str, Any]) -> list[Effect]:
        """Finish at once, because an earlier server has played the game step and stored its answer.

        `answers` is that answer; in a session, the answer of each member by their id.
        """
        self._earlier_answers = answers
        self.phase = Phase.FINISHED
        self.ready = True
        return []

    def agent_failed(self, now: float) -> list[Effect]:
        """End the trial as failed, because the agent cannot be started."""
        if self.phase is not Phase.STARTING:
            return []
        self.phase = Phase.PLAYING
        self.progress.failed(fatal=True)
        return self.advance(now)

    def start(
        self,
        players: Sequence[Player],
        recorded: RecordedTrial | None,
        now: float,
        *,
        places: Mapping[str, str] | None = None,
        vacant: Sequence[str] = (),
        erased: Sequence[str] = (),
        answered: Mapping[str, Mapping[str, Any]] | None = None,
        said: Iterable[Mapping[str, Any]] = (),
    ) -> list[Effect]:
        """Begin the game with the environment's `players`, after what earlier servers have `recorded`.

        In a session: `places` is the player that each member plays, by the member's id. `vacant` are the players
        without a member, whom policies play. `erased` are the players of members whose data were erased, and who never
        come. `answered` holds the answers of this step that some members have already, by their ids.

        `said` are the records of the talk on earlier servers.
        """
        if self.phase is not Phase.STARTING:
            return []
        self.phase = Phase.PLAYING
        self.progress = TrialProgress(self.config, players)
        if places:
            self._participants = TrialSession(
                self.config,
                self.progress,
                places,
                vacant=vacant,
                erased=erased,
                answered=answered or {},
                recorded=recorded,
                trial_id=self.id,
                say_each=self._clients.say_each,
                recording=self._recording,
                emit=self._emit,
            )
        else:
            self._participants = Alone(self.progress, self.id)
        if self.config.chat is not None:
            people = {*places.values(), *vacant, *erased} if places else {self.progress.first}
            self.talk = self._clients.talk = Talk(
                self.config.chat,
                [name for name in self.progress.players if name in people],
                self.config.player_names,
                where=lambda: (self.progress.episode, self.progress.steps),
                send=self._clients.send_talk,
                emit=self._emit,
            )
            self.talk.restore(said)
        if recorded is not None:
            self.progress.resume(recorded.ended)
            self._episodes.unfinished = recorded.unfinished
            self._timing.seconds = recorded.seconds
        return self.advance(now)

    # ---- events: clients

    def connect(self, human: str, connection: Hashable, window: Window, now: float) -> list[Effect]:
        """Show the trial to a human's client that has connected. It replaces an earlier one. Call it once `ready`.

        `window` counts the frames that this connection has not acknowledged.
        """
        self._now = now
        replaced = self._clients.replace(human)
        if replaced is not None:
            self._left(replaced)
        participants = self._participants
        player = participants.place_of(human)
        client = self._clients.add(human, connection, window, player)
        self._note("connected", client)
        if self.finished:
            self._send_done(human, client)
            return self._take_effects()
        participants.come(player, now)
        self._tell("on_return" if player in self._have_come else "on_join", player)
        self._have_come.add(player)
        self._clients.send_controls(client, self.progress, participants, now)
        client.sent = self._clients.state_of(self.progress, player)
        words = participants.sentence(player) or self._failed_words
        if words is None and self._episodes.begun_again == self.progress.episode and not self.progress.steps:
            words = EPISODE_BEGINS_AGAIN
        if words is not None:
            self._clients.send(client, messages.error(words))
        if self.talk is not None:
            self.talk.connected(player)
        if participants.has_answered(human):
            self._send_done(human, client)
        self._clients.show_again(client)
        return self.advance(now)

    def disconnect(self, connection: Hashable, now: float) -> list[Effect]:
        """Hold the game after a connection was closed until `start` is sent; in a session, until the member is back."""
        self._now = now
        client = self._clients.remove(connection)
        if client is None:
            return []
        self._left(client)
        return self.advance(now)

    def round_trip(self, human: str, seconds: float, now: float) -> list[Effect]:
        """Take a sample of a human's round trip, in seconds, which their browser's answer to a ping has measured."""
        if self.phase is not Phase.PLAYING:
            return []
        self._participants.round_trip(self._participants.place_of(human), seconds, now)
        return self.advance(now)

    def receive(self, connection: Hashable, message: messages.Message, now: float) -> list[Effect]:
        """Carry out a client's message. It changes nothing if another connection has replaced this one."""
        client = self._clients.of(connection)
        if client is None or not self._participants.receive(client.player, message, client.window, now):
            return []
        accepted = self._commands.receive(client, message, self.progress, self._participants, now)
        if accepted and message.form is not None:
            self._tell("on_form", client.player, message.form.fields)
        if accepted and self.talk is not None and not self.progress.over:
            if message.say is not None:
                self.talk.say(client.player, message.say, now)
            elif message.typing is not None:
                self.talk.typing(client.player, message.typing)
        return self.advance(now)

    def advise(self, action: int, player: str | None, now: float) -> list[Effect]:
        """Take a program's advice for the next action, or its choice for a player that the program plays.

        `action` and `player` are as in `Choices.advise`. Raises CommandRefused.
        """
        if self.phase is not Phase.PLAYING:
            raise messages.CommandRefused("no game is going on")
        self.progress.choices.advise(action, player)
        return self.advance(now) if self.progress.turns is not None else []

    # ---- events: talk

    def reply_grows(self, ask_id: int, text: str, now: float) -> list[Effect]:
        """Show what the agent's `reply` has yielded so far, in answer to the `AskReply` of this id."""
        if self.talk is not None and not self.done:
            self.talk.reply_grows(ask_id, text)
        return self._take_effects()

    def reply_ended(self, ask_id: int, text: str | None, now: float) -> list[Effect]:
        """Say what the agent's `reply` has returned; None if it says nothing."""
        if self.talk is not None and not self.done:
            self.talk.reply_ended(ask_id, text)
        return self._take_effects()

    def moderated(self, ask_id: int, result: str | bool | None, now: float) -> list[Effect]:
        """Say a line, another text instead of it, or nothing (False), as the agent's `moderate` has decided."""
        if self.talk is not None and not self.done:
            self.talk.moderated(ask_id, result)
        return self._take_effects()

    def agent_says(self, text: str, to: Sequence[str] | None, by: str | None, now: float) -> list[Effect]:
        """Say a line of the agent, to these players or to all, under this name or its own."""
        if self.talk is not None and not self.done and not self.talk.agent_says(text, to, by, now):
            self._emit(WriteLog(logging.WARNING, "the agent says too many lines; some are dropped"))
        return self._take_effects()

    # ---- events: the agent

    def call_returned(self, call: Call, result: Any, now: float) -> list[Effect]:
        """Go on after a call of the agent has returned `result`. A call that was given up changes nothing."""
        if not self._agent.has_ended(call):
            return []
        self._now = now
        if isinstance(call, StepCall):
            self._episodes.taken(call, result, self.progress, now)
        elif isinstance(call, FeedbackCall):
            self._episodes.record(call, self.progress, self._participants)
        elif isinstance(call, ReplayCall):
            self._episodes.replayed(call.unfinished, result, self.progress, now)
            self.ready = True
        else:
            self._episodes.began(result, self.progress, now)
            self.ready = True
        return self.advance(now)

    def call_failed(self, call: Call, error: Exception, now: float) -> list[Effect]:
        """Go on after a call of the agent has raised this error; AgentTimeout if it has not returned in time."""
        hangs = isinstance(error, AgentTimeout)
        if not self._agent.has_ended(call, hangs=hangs):
            return []
        self._now = now
        if isinstance(call, ReplayCall) and not hangs:
            kind = type(error).__name__
            text = f"the episode cannot go on where it was and begins again ({kind})"
            self._emit(WriteLog(logging.WARNING, text))
            self._agent.make(self._episodes.begin_again(self.progress, self._participants))
        elif isinstance(call, FeedbackCall) and not isinstance(call, StepCall):
            self._recording.agent_failed(error, records.number(self.progress.ended[0]), self.progress.steps)
            if hangs:
                self._fail(fatal=True)
            self._episodes.record(call, self.progress, self._participants)
        else:
            if isinstance(call, StepCall):
                self._messages.heard(call.heard)  # the messages stay, for the line that ends the episode
            self._recording.agent_failed(error, self.progress.episode, self.progress.steps)
            self._fail(fatal=hangs)
            if isinstance(call, ReplayCall):
                self._messages.repeat(call.unfinished.unheard, self._ns())
        return self.advance(now)

    # ---- events: policies

    def policy_acted(self, player: str, ask_id: int, action: Any, now: float) -> list[Effect]:
        """Take the action that the player's policy has chosen. An answer to an earlier question changes nothing."""
        problem = self.progress.choices.policies.acted(player, ask_id, action)
        if problem is not None:
            self._recording.policy_failed(self.progress, player, problem)
        # In real time the action waits for the next step.
        return self.advance(now) if problem is not None or self.progress.turns is not None else []

    def policy_failed(self, player: str, ask_id: int, error: Exception, now: float) -> list[Effect]:
        """Go on after the player's policy has raised this error."""
        if self.progress.choices.policies.failed(player, ask_id):
            self._recording.policy_failed(self.progress, player, words_of(error))
        return self.advance(now)

    # ---- events: the store

    def recording_opened(self, now: float) -> list[Effect]:
        """Begin the episode, since the recording of the last `OpenRecording` is open."""
        self._now = now
        self._recording.opened()
        self._agent.make(self._episodes.opened(self.progress, self._participants, self._ns()))
        return self.advance(now)

    def recording_failed(self, now: float) -> list[Effect]:
        """End the game, since its recording cannot be opened and every game must be recorded."""
        self._recording.failed()
        self._fail(fatal=True)
        return self.advance(now)

    def answer_saved(self, now: float) -> list[Effect]:
        """Finish the trial, since all recordings and answers are stored, or close it if it has no answer."""
        if not self.progress.over or self.broken:
            self.phase = Phase.CLOSED
            return []
        self.phase = Phase.FINISHED
        for human, client in self._clients.by_human.items():
            if not self._participants.has_answered(human):
                self._send_done(human, client)
        text = f"trial over: {self.progress.outcome} after {self.progress.episodes_played} episodes"
        return [WriteLog(logging.INFO, text), *self._take_effects()]

    def member_saved(self, human: str, now: float) -> list[Effect]:
        """Let a member whose answer is stored go on to the next step, even if the others still play."""
        self._participants.saved(human)
        client = self._clients.by_human.get(human)
        if client is not None and not self.finished:
            self._send_done(human, client)
        return self.advance(now)

    # ---- events: time

    def advance(self, now: float) -> list[Effect]:
        """Do everything that is due at this time. The methods for the other events call this one."""
        self._now = now
        self.wake_at = None
        self._agent.give_up(now)
        while self._agent.call is None and not self._recording.is_awaited and self._go_on():
            pass
        if self._agent.call is not None:
            self.wake_at = self._agent.give_up_at
        elif self.phase is Phase.PLAYING and not self._episodes.closing:
            wake_at = self._participants.wake_at(now)
            if wake_at is not None:
                self.wake_at = wake_at if self.wake_at is None else min(wake_at, self.wake_at)
        if not self.finished:
            self._clients.send_state(self.progress, self._participants, now)
        return self._take_effects()

    def close(self, now: float) -> list[Effect]:
        """Stop playing and write the last lines, because the server must end.

        Only a trial that is over has an answer.
        """
        self._commands.closed = self._episodes.closing = True
        if self.talk is not None:
            self.talk.close()
        if self._agent.call is not None:
            self._agent.give_up_at = now + LAST_CALL_SECONDS
        if self.phase is Phase.STARTING:
            self.phase = Phase.CLOSED
        return self.advance(now)

    # ---- what comes next

    def _go_on(self) -> bool:
        """Do the next thing that is due; return whether something else may be due at this time."""
        if self.phase is Phase.PLAYING:
            return self._play()
        if self.phase is Phase.SAVING and not self._episodes.all_written:
            self._write_last_lines()
            return True
        return False

    def _play(self) -> bool:
        progress, closing = self.progress, self._episodes.closing
        if not closing:
            self._participants.attend(self._now, self._timing.seconds)
            if self.talk is not None and self.talk.alternates:
                self.talk.silence(self._participants.silent)
            if self._commands.waiting:
                self._commands.carry_out_waiting(progress, self._participants, self._timing)
            if progress.ended:
                self._write_end()
                return True
        if progress.over or closing:
            self.phase = Phase.SAVING
            self.ready = True
            return True
        due = self._timing.next(progress, self._now)
        if due is Due.STEP:
            stalled = self._clients.stalled(self._now)
            if stalled is None:
                self.wake_at = self._now + LOOK_AGAIN
                return False
            if not self._paused_by(stalled):
                self._agent.make(self._episodes.take(progress, self._now))
        elif due is Due.RESET:
            call = self._episodes.begin(progress, self._participants)
            if call is not None:
                self._agent.make(call)
        elif due is Due.NOTHING:
            self.wake_at = self._timing.wake_at
            return False
        return True

    def _paused_by(self, stalled: Sequence[Client]) -> bool:
        """Hold the game for the pages that have stopped answering; return whether one of them was here before."""
        newly = [each for each in stalled if self._participants.stalls(each.player, self._now)]
        for client in newly:
            self._emit(WriteLog(logging.INFO, "the player's page has stopped answering: paused"))
            self._note("stopped answering", client)
        return bool(newly)

    def _write_end(self) -> None:
        """Record the end of an episode or a break, after a last call that gives the agent the feedback before it."""
        call = self._episodes.last_feedback(self.progress)
        if (call.feedback or self.callbacks) and not self._agent.hangs:
            self._agent.make(call)
        else:
            self._episodes.record(call, self.progress, self._participants)

    def _write_last_lines(self) -> None:
        self._episodes.shut_down_break(self.progress)
        if self.progress.ended:
            self._write_end()
        else:
            self._episodes.write_last(self.progress, self._participants, broken=self.broken)

    def _fail(self, *, fatal: bool) -> None:
        self.progress.failed(fatal=fatal)
        words = EPISODE_FAILED
        if self.progress.over:
            words = self._failed_words = TRIAL_FAILED
        self._clients.send_all(messages.error(words))

    # ---- clients

    def _left(self, client: Client) -> None:
        self._note("disconnected", client)
        self._participants.go(client.player, self._now, closing=self._episodes.closing)
        self._tell("on_leave", client.player)
        if self.talk is not None:
            self.talk.disconnected(client.player)

    def _tell(
        self,
        callback: Literal["on_join", "on_leave", "on_return", "on_form"],
        player: str,
        fields: Mapping[str, Any] | None = None,
    ) -> None:
        if self.callbacks and self.phase is Phase.PLAYING and not self._agent.hangs:
            self._emit(TellAgent(callback, player, fields))

    def _note(self, event: str, client: Client) -> None:
        """Record an event of a client among its messages, such as its connection."""
        self._messages.note(event, self._ns(), self._participants.name_of(client.player))

    def _ns(self) -> int:
        return int(self._now * 1e9)

    def _send_done(self, human: str, client: Client) -> None:
        """Tell a client that the trial is over, with the values of the answer that this or an earlier server stored."""
        answers = self._earlier_answers
        if answers is None:
            answers = self._participants.answer_of(human)
        elif self.settings.session:
            answers = answers.get(human)
        result = records.result(self.progress, client.player, answers, in_session=bool(self.settings.session))
        outcome = self.progress.outcome if answers is None else answers.get("outcome")
        self._emit(SendDone(client.connection, *result, words=TRIAL_FAILED if outcome == "failed" else None))

    def _take_effects(self) -> list[Effect]:
        effects = self._effects.copy()
        self._effects.clear()
        return effects
