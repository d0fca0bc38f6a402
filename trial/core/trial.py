"""The core of a trial: every decision about one game step, from the first frame to the stored answer. Pure.

`Trial` is a state machine without I/O, threads, asyncio or a clock (a Sans-I/O core). Its shell,
`trial/server/loop.py`, calls a method for each event and carries out the effects (`trial/core/effects.py`) that the
method returns, in their order. All times are seconds of one monotonic clock.

Events in:
  already_played, start, agent_failed    what the store holds of the step, and whether the agent has started
  connect, disconnect, receive           clients; each connection belongs to a human
  call_returned, call_failed             the agent's thread has finished the call that it was given
  policy_acted, policy_failed            the policy of a player that is no human has answered
  recording_opened, recording_failed, answer_saved        the store
  advance                                the time `wake_at` has come
  close                                  the server must end

Effects out: messages, states and pictures for connections; one call at a time for the agent; questions for policies;
lines for the recording; the answer; lines for the log.

Phases: STARTING until the store was read and the agent has started, PLAYING, SAVING (the last lines, then recordings
and the answer), then FINISHED (the answer is stored) or CLOSED (there is no answer: the server had to end, or the game
could not begin).

A player is a place of the environment (`trial/core/players.py`): a human plays it, or a policy. Each connection belongs
to a human, and each human plays one player. Keys, actions and scores are kept by player in `trial/core/progress.py`.
"""

from __future__ import annotations

import logging
import math
import traceback
from collections.abc import Callable, Hashable, Mapping, Sequence
from enum import Enum
from typing import Any, Literal

from trial.core import messages, records
from trial.core.clients import Client, Clients, StateTimes, controls_of, scene_of, state_of
from trial.core.controls import ARROWS, KEY
from trial.core.effects import (
    AgentTimeout,
    Begun,
    Call,
    CloseRecording,
    Effect,
    FeedbackCall,
    Log,
    LogAgentError,
    OpenRecording,
    Pictures,
    RecordLine,
    ReplayCall,
    Replayed,
    ResetCall,
    ResetPolicy,
    SaveAnswer,
    StepCall,
    StepTaken,
    TellMoved,
    WriteLine,
)
from trial.core.episode_time import EpisodeTime
from trial.core.flow_control import Window
from trial.core.message_log import MessageLog
from trial.core.players import Player, View, alone
from trial.core.policies import FAILURES, Observed
from trial.core.progress import Break, CommandRefused, Episode, Progress
from trial.core.seeds import policy_seed
from trial.core.timing import Timing
from trial.core.unfinished import RecordedTrial, UnfinishedEpisode
from trial.settings import Settings

LAST_CALL_SECONDS = 2.0
"""The time that a call of the agent has to come back once the server must end."""

_POLICY_FAILURES_SAID = 20
EPISODE_FAILED = "Something went wrong in the game, so this round has ended. The next round begins."
EPISODE_BEGINS_AGAIN = "This round could not go on where it was, so it begins again. The rounds before it are kept."
TRIAL_FAILED = "Something went wrong in the game and it cannot go on. What you have played is kept; please continue."


class Phase(Enum):
    STARTING = "starting"
    PLAYING = "playing"
    SAVING = "saving"
    FINISHED = "finished"
    CLOSED = "closed"


class Trial:
    """One game step as it is played on this server. See the module's docstring for events, effects and phases."""

    def __init__(
        self,
        settings: Settings,
        step: str,
        *,
        trial_id: str,
        new_seed: Callable[[], int],
        assets: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        """`assets` are the images of a game that is drawn by objects, as clients are told of them."""
        self.settings = settings
        self.config = settings.trial
        shown = self.config.ui.shown()
        self._offered = (*shown, *ARROWS) if self.config.keys else shown
        self._scene = scene_of(self.config, assets)
        self.step = step
        self.id = trial_id
        self.phase = Phase.STARTING
        self.ready = False
        """The first frame is there, or the trial is over."""
        self.callbacks = False
        """The agent has callbacks, which are told of the end of each episode and of players who come and go."""
        self.wake_at: float | None = None
        """When `advance` is to be called if nothing else happens before; None: there is no need to."""
        self.progress = Progress(self.config, alone(self.config.action_space or ("noop",)))
        self._new_seed = new_seed
        self._effects: list[Effect] = []
        self._clients = Clients(self._emit)
        self._messages = MessageLog()
        self._timing = Timing()
        self._episode_time = EpisodeTime(self.config.reset_freeze, self.config.episode_seconds)
        self._call: Call | None = None  # the agent has this call
        self._agent_hangs = False  # a call was given up, so the agent's thread takes no other
        self._commands: list[str] = []  # reset and stop wait for the end of a step
        self._recording = False  # a recording is open
        self._opening = False  # an episode waits for its recording to be opened
        self._seed = 0  # of the episode
        self._unfinished: UnfinishedEpisode | None = None  # an earlier server began it
        self._begun_again: int | None = None  # this episode, because it could not be replayed
        self._failed_words: str | None = None
        self._earlier_answers: Mapping[str, Any] | None = None
        self._closing = False
        self._give_up_at: float | None = None
        self._break_shut_down = False
        self._last_lines_written = False
        self._met: set[str] = set()  # players whose participants have been here
        self._said: set[str] = set()  # of policies, in the log
        config = self.config
        self._timed = config.pace == "turns" or bool(config.reset_freeze or config.episode_seconds)
        """Clients are told of times also while the game goes on."""
        self._now = 0.0

    @property
    def broken(self) -> bool:
        """The game could not even begin: there is no frame, and there will be no answer. Certain once it is `ready`."""
        return self.progress.outcome == "failed" and self._clients.pictures is None

    @property
    def finished(self) -> bool:
        """All recordings and the answer are stored."""
        return self.phase is Phase.FINISHED

    @property
    def done(self) -> bool:
        """Nothing happens any more."""
        return self.phase in (Phase.FINISHED, Phase.CLOSED)

    @property
    def saving(self) -> bool:
        """The trial is over, and not everything is stored."""
        return self.progress.over and not self.finished

    # ---- events: the start

    def already_played(self, answers: Mapping[str, Any]) -> list[Effect]:
        """An earlier server stored this answer of the step."""
        self._earlier_answers = answers
        self.phase = Phase.FINISHED
        self.ready = True
        return []

    def agent_failed(self, now: float) -> list[Effect]:
        """The agent cannot be started."""
        if self.phase is not Phase.STARTING:
            return []
        self.phase = Phase.PLAYING
        self.progress.failed(fatal=True)
        return self.advance(now)

    def start(self, players: Sequence[Player], recorded: RecordedTrial | None, now: float) -> list[Effect]:
        """The agent has started: these are the environment's players, and what earlier servers recorded of the step."""
        if self.phase is not Phase.STARTING:
            return []
        self.phase = Phase.PLAYING
        self.progress = Progress(self.config, players)
        if recorded is not None:
            self.progress.resume(recorded.ended)
            self._unfinished = recorded.unfinished
            self._timing.seconds = recorded.seconds
        return self.advance(now)

    # ---- events: clients

    def connect(self, human: str, connection: Hashable, window: Window, now: float) -> list[Effect]:
        """A human's client has connected, once the trial is `ready`. It replaces an earlier one of this human.

        `window` knows the acknowledgements of this connection.
        """
        self._now = now
        replaced = self._clients.replace(human)
        if replaced is not None:
            self._left(replaced)
        client = self._clients.add(human, connection, window, self.progress.humans)
        self._note("connected")
        if self.finished:
            self._send_done()
            return self._take_effects()
        self._tell_moved("on_return" if client.player in self._met else "on_join", client.player)
        self._met.add(client.player)
        self._clients.send(client, self._controls(client))
        client.sent = state_of(self.progress, client.player)
        if self._failed_words is not None:
            self._clients.send(client, messages.error(self._failed_words))
        elif self._begun_again == self.progress.episode and not self.progress.steps:
            self._clients.send(client, messages.error(EPISODE_BEGINS_AGAIN))
        self._clients.show_again(client)
        return self.advance(now)

    def disconnect(self, connection: Hashable, now: float) -> list[Effect]:
        """A connection is closed. The game is held until its human starts it again."""
        self._now = now
        client = self._clients.remove(connection)
        if client is None:
            return []
        self._left(client)
        return self.advance(now)

    def receive(self, connection: Hashable, message: messages.Message, now: float) -> list[Effect]:
        """A client's message. One from a connection that was replaced changes nothing."""
        self._now = now
        client = self._clients.of(connection)
        if client is None:
            return []
        try:
            self._handle(client, message)
        except CommandRefused as error:
            self._clients.send(client, messages.error(str(error)))
        return self.advance(now)

    def advise(self, action: int, player: str | None, now: float) -> list[Effect]:
        """A program that may do so advises an action for the next step, or chooses it for a player that it plays.

        `player` as in `Progress.advise`. Raises CommandRefused.
        """
        if self.phase is not Phase.PLAYING:
            raise CommandRefused("no game is going on")
        self.progress.advise(action, player)
        return self.advance(now) if self.progress.turns is not None else []

    # ---- events: the agent

    def call_returned(self, call: Call, result: Any, now: float) -> list[Effect]:
        """The agent's call came back. One that was given up changes nothing."""
        if call is not self._call:
            return []
        self._now, self._call, self._give_up_at = now, None, None
        if isinstance(call, StepCall):
            self._stepped(call, result)
        elif isinstance(call, FeedbackCall):
            self._record_end(call)
        elif isinstance(call, ReplayCall):
            self._replayed(call.unfinished, result)
        else:
            self._began(result)
        return self.advance(now)

    def call_failed(self, call: Call, error: Exception, now: float) -> list[Effect]:
        """The agent's call raised this error; AgentTimeout: it has not come back."""
        if call is not self._call:
            return []
        self._now, self._call, self._give_up_at = now, None, None
        hangs = self._agent_hangs = isinstance(error, AgentTimeout)
        if isinstance(call, ReplayCall) and not hangs:
            kind = type(error).__name__
            text = f"the episode cannot go on where it was and begins again ({kind})"
            self._emit(Log(logging.WARNING, text))
            self._begun_again = self.progress.episode
            self._reset()
        elif isinstance(call, FeedbackCall) and not isinstance(call, StepCall):
            self._record_error(error, records.number(self.progress.ended[0]))
            if hangs:
                self._fail(fatal=True)
            self._record_end(call)
        else:
            if isinstance(call, StepCall):
                self._messages.heard(call.heard)  # the messages stay, for the line that ends the episode
            self._record_error(error, self.progress.episode)
            self._fail(fatal=hangs)
            if isinstance(call, ReplayCall):
                self._repeat_feedback(call.unfinished)
        return self.advance(now)

    # ---- events: policies

    def policy_acted(self, player: str, ask_id: int, action: Any, now: float) -> list[Effect]:
        """The player's policy chose this action. An answer to an earlier question changes nothing."""
        self._now = now
        wrong = self.progress.policies.acted(player, ask_id, action)
        if wrong is not None:
            self._policy_failed(player, wrong)
        # In real time the answer waits for the next step.
        return self.advance(now) if wrong is not None or self.progress.turns is not None else []

    def policy_failed(self, player: str, ask_id: int, error: Exception, now: float) -> list[Effect]:
        """The player's policy raised this error."""
        self._now = now
        if self.progress.policies.failed(player, ask_id):
            self._policy_failed(player, "".join(traceback.format_exception_only(error)).strip()[:2000])
        return self.advance(now)

    # ---- events: the store

    def recording_opened(self, now: float) -> list[Effect]:
        """The recording that was asked for is open."""
        self._now, self._recording, self._opening = now, True, False
        unfinished, self._unfinished = self._unfinished, None
        if unfinished is not None and unfinished.steps:
            self.progress.begins(self._seed)
            default = {name: player.idle for name, player in self.progress.players.items()}
            self._start_call(
                ReplayCall(limit=self.settings.start_seconds, unfinished=unfinished, default_actions=default)
            )
        else:
            if unfinished is not None:
                self._repeat_feedback(unfinished)
            self._reset()
        return self.advance(now)

    def recording_failed(self, now: float) -> list[Effect]:
        """The recording cannot be opened: nothing is played that is not recorded."""
        self._now, self._opening = now, False
        self._fail(fatal=True)
        return self.advance(now)

    def answer_saved(self, now: float) -> list[Effect]:
        """Everything is stored."""
        self._now = now
        if not self.progress.over or self.broken:
            self.phase = Phase.CLOSED
            return []
        self.phase = Phase.FINISHED
        self._send_done()
        text = f"trial over: {self.progress.outcome} after {self.progress.episodes_played} episodes"
        return [Log(logging.INFO, text), *self._take_effects()]

    # ---- events: time

    def advance(self, now: float) -> list[Effect]:
        """Do all that can be done at this time. Every other event does this, too."""
        self._now = now
        self.wake_at = None
        if self._give_up_at is not None and now >= self._give_up_at:
            self._call, self._give_up_at, self._agent_hangs = None, None, True
        while self._call is None and not self._opening and self._go_on():
            pass
        if self._call is not None:
            self.wake_at = self._give_up_at
        self._send_state()
        return self._take_effects()

    def close(self, now: float) -> list[Effect]:
        """The server must end: stop where the game stands. There is no answer unless the trial is over."""
        self._closing = True
        if self._call is not None:
            self._give_up_at = now + LAST_CALL_SECONDS
        if self.phase is Phase.STARTING:
            self.phase = Phase.CLOSED
        return self.advance(now)

    # ---- what comes next

    def _go_on(self) -> bool:
        """Do the next thing; whether there is another one to do at this time."""
        if self.phase is Phase.PLAYING:
            return self._play()
        if self.phase is Phase.SAVING and not self._last_lines_written:
            return self._write_last_lines()
        return False

    def _play(self) -> bool:
        progress = self.progress
        if not self._closing:
            self._do_commands()
            if progress.ended:
                return self._write_end()
        if progress.over or self._closing:
            self.phase = Phase.SAVING
            self.ready = True
            return True
        left = self._break_left()
        if not progress.playing:
            self._episode_time.rest(self._now)
        if left is not None:
            self._timing.rest()
            if left > 0.0:
                self.wake_at = self._now + left if left < math.inf else None
                return False
            progress.go_on()
        elif progress.needs_reset:
            self._begin_episode()
        elif not progress.playing:
            self._timing.rest()
            if progress.turns is not None:
                progress.turns.hold(self._now)
            return False
        elif self._stands():
            return False
        elif progress.turns is not None:
            return self._turn_if_over()
        else:
            return self._step_if_due()
        return True

    def _stands(self) -> bool:
        """Whether the episode's first picture still stands; if not, the episode is played from now on."""
        progress, left = self.progress, self._episode_time.starts_in(self._now)
        if left > 0.0:
            self._timing.rest()
            if progress.turns is not None:
                progress.turns.hold(self._now)
            self.wake_at = self._now + left
            return True
        if progress.frozen:
            progress.thaw()
        self._episode_time.run(self._now)
        return False

    def _do_commands(self) -> None:
        if not self._commands:
            return
        commands, self._commands = self._commands, []
        for command in commands:
            self._timing.skip()
            if command == "stop":
                self.progress.stop()
            else:
                self.progress.reset()

    def _break_left(self) -> float | None:
        """Seconds until the next episode, infinite if the player begins it; None if this is no break."""
        if not self.progress.on_break:
            self._timing.break_over()
            return None
        return self._timing.break_left(self._now, self.config.between_seconds)

    def _begin_episode(self) -> None:
        unfinished = self._unfinished
        self._seed = self._next_seed() if unfinished is None or unfinished.seed is None else unfinished.seed
        if self._recording:
            self._reset()
            return
        self._opening = True
        progress = self.progress
        players = tuple(progress.players.values()) if progress.several else ()
        self._emit(OpenRecording(progress.episode, self._seed, progress.frame_rate, progress.action_space, players))

    def _next_seed(self) -> int:
        first = self.config.seed
        return self._new_seed() if first is None else first + self.progress.episode - 1

    def _reset(self) -> None:
        self.progress.begins(self._seed)
        self._reset_policies({})
        self._start_call(ResetCall(limit=self.settings.step_seconds, episode=self.progress.episode, seed=self._seed))

    def _reset_policies(self, observed: Mapping[str, Sequence[Observed]]) -> None:
        for player in self.progress.policies.asked:
            seed = policy_seed(self._seed, player.name)
            self._emit(ResetPolicy(player.name, seed, observed.get(player.name, ())))

    def _began(self, begun: Begun) -> None:
        self._emit(WriteLine(begun.line))
        self.progress.began()
        self._episode_time.begin()
        self._see(begun.view)
        self._show(begun.pictures)

    def _see(self, view: View | None) -> None:
        """The players see this, and those that are no humans are asked."""
        progress = self.progress
        progress.see(view, self._now)
        if view is not None and progress.policies:
            for ask in progress.policies.asks(view, progress.steps, self._now):
                self._emit(ask)

    def _replayed(self, unfinished: UnfinishedEpisode, replayed: Replayed) -> None:
        steps = len(unfinished.steps)
        self._emit(RecordLine("resume", {"episode": unfinished.number, "steps": steps}))
        self._reset_policies(replayed.observed)
        self._episode_time.go_on(steps / self.progress.frame_rate)
        self.progress.replayed(steps, unfinished.scores or {self.progress.first: unfinished.score})
        self.progress.policies.go_on(unfinished.going_on)
        self._see(replayed.view)
        self._show(replayed.pictures)
        self._emit(Log(logging.INFO, f"the game goes on after {steps} steps of an earlier server"))
        self._repeat_feedback(unfinished)

    def _repeat_feedback(self, unfinished: UnfinishedEpisode) -> None:
        """Take up the feedback that an earlier server's agent did not hear any more."""
        self._messages.repeat(unfinished.unheard, self._ns())

    def _step_if_due(self) -> bool:
        due = self._timing.step_due(self._now, self.progress.frame_rate)
        if self._now < due:
            self.wake_at = due
            return False
        self._timing.skip()
        if self._paused_by_stalled():
            return True
        self._take_step()
        return False

    def _paused_by_stalled(self) -> bool:
        """Pause if a page has stopped answering; whether that is so."""
        stalled = self._clients.stalled(self._now)
        for client in stalled:
            self._emit(Log(logging.INFO, "the player's page has stopped answering: paused"))
            self._note("stopped answering")
            self.progress.leave(client.player)
        return bool(stalled)

    def _turn_if_over(self) -> bool:
        """Take the step of this turn once all have chosen; whether there is another thing to do at this time."""
        progress, turns, now = self.progress, self.progress.turns, self._now
        assert turns is not None
        turns.run(now)
        progress.policies_choose(now)
        ends_in = turns.ends_in(now) if progress.humans_waited_for else None
        if ends_in is not None and ends_in <= 0.0:
            progress.turn_over()
            return True
        left = self._episode_time.left(now)
        if turns.waiting:
            if left is not None and left <= 0.0:
                progress.time_over()
                return True
            until = progress.policies_until()
            ends = [until] if until is not None else []
            ends += [] if left is None else [now + left]
            self.wake_at = min([*ends, now + ends_in] if ends_in is not None else ends, default=None)
            return False
        due = self._timing.turn_due(progress.frame_rate)
        if due is not None and now < due:
            self.wake_at = due
            return False
        if self._paused_by_stalled():
            return True
        self._take_step()
        return False

    def _take_step(self) -> None:
        progress, clients = self.progress, self._clients
        said, dropped = self._messages.messages, self._messages.take_dropped()
        fields: dict[str, Any] = {
            "episode": progress.episode,
            "step": progress.steps + 1,
            "frame": clients.frame_id + 1,
        }
        if said:
            fields["messages"] = said
        if dropped:
            fields["messagesDropped"] = dropped
        self._start_call(
            StepCall(
                limit=self.settings.step_seconds,
                actions=progress.next_actions(),
                feedback=self._messages.feedback,
                messages=len(said),
                fields=fields,
                truncated_by=self._truncates(),
            )
        )

    def _truncates(self) -> str | None:
        """The key of `trial` that makes the step that begins now the episode's last one, if there is one."""
        most = self.config.max_steps
        if most and self.progress.steps + 1 >= most:
            return "maxSteps"
        left = self._episode_time.left(self._now)
        nearest = 0.5 / self.progress.frame_rate  # the step before would be farther from the limit, or the next one
        return "episodeSeconds" if left is not None and left <= nearest else None

    def _stepped(self, call: StepCall, step: StepTaken) -> None:
        self._emit(WriteLine(step.line))
        self._messages.recorded(call.messages, len(call.feedback))
        self._timing.stepped(self._now, self.progress.frame_rate)
        progress, ended = self.progress, len(self.progress.ended)
        progress.stepped(step.rewards, step.terminated, step.truncated, call.truncated_by)
        if len(progress.ended) == ended and (step.view is not None or progress.turns is not None):
            self._see(step.view)
        self._show(step.pictures)

    def _show(self, pictures: Pictures) -> None:
        self._clients.show(pictures)
        self.ready = True

    def _start_call(self, call: Call) -> None:
        self._call = call
        self._emit(call)

    # ---- what ends

    def _write_end(self) -> bool:
        """Record the end of an episode or a break, and its last messages. The agent hears their feedback before."""
        progress = self.progress
        call = FeedbackCall(
            limit=LAST_CALL_SECONDS if self._closing else self.settings.step_seconds,
            feedback=self._messages.feedback,
            messages=len(self._messages.messages),
            over=progress.ended[0],
            last=progress.over and len(progress.ended) == 1,
        )
        if (call.feedback or self.callbacks) and not self._agent_hangs:
            self._start_call(call)
            return False
        self._record_end(call)
        return True

    def _record_end(self, call: FeedbackCall) -> None:
        over = self.progress.ended.pop(0)
        if isinstance(over, Episode):
            for player, late in self.progress.policies.late().items():
                self._emit(Log(logging.INFO, f"the policy of {player} was late at {late} of {over.steps} steps"))
        self._emit(records.end(over, self._messages.messages[: call.messages]))
        self._messages.recorded(call.messages, len(call.feedback))
        # The break after an episode belongs to its file.
        more = isinstance(self.progress.ended[0], Break) if self.progress.ended else self.progress.on_break
        if self.config.data_file == "episode" and not more:
            self._close_recording()

    def _write_last_lines(self) -> bool:
        progress = self.progress
        if self._closing and progress.on_break and not self._break_shut_down:
            self._break_shut_down = True
            progress.ended.append(Break(progress.episode, "shutdown"))
        if progress.ended:
            return self._write_end()
        self._last_lines_written = True
        if self._closing and not progress.over and not progress.on_break:
            self._emit(records.shutdown(progress, self._messages.messages))
        self._close_recording()
        played = progress.over and not self.broken
        self._emit(SaveAnswer(records.answers(progress, self._timing.seconds, self.id) if played else None))
        return False

    def _close_recording(self) -> None:
        if self._recording:
            self._recording = False
            self._emit(CloseRecording())

    # ---- what fails

    def _record_error(self, error: Exception, episode: int) -> None:
        words = "".join(traceback.format_exception_only(error)).strip()
        self._emit(LogAgentError(error))
        self._emit(RecordLine("error", {"episode": episode, "step": self.progress.steps, "error": words[:2000]}))

    def _policy_failed(self, player: str, words: str) -> None:
        """Say in the log and in the recording that a policy has failed, once for each reason."""
        plays = self.progress.players[player].plays
        said = [f"the policy of {player} ({plays}) failed: {words}"]
        if self.progress.policies.idles(player):
            said.append(f"the policy of {player} failed {FAILURES} times in a row: it idles until the episode is over")
        for text in said:
            if text in self._said or len(self._said) >= _POLICY_FAILURES_SAID:
                continue
            self._said.add(text)
            self._emit(Log(logging.ERROR, text))
            where = {"episode": self.progress.episode, "step": self.progress.steps, "player": player}
            self._emit(RecordLine("error", {**where, "error": text}))

    def _fail(self, *, fatal: bool) -> None:
        self.progress.failed(fatal=fatal)
        words = EPISODE_FAILED
        if self.progress.over:
            words = self._failed_words = TRIAL_FAILED
        self._clients.send_all(messages.error(words))

    # ---- clients

    def _left(self, client: Client) -> None:
        self._note("disconnected")
        if not self._closing:  # the end of the server has ended what was on
            self.progress.leave(client.player)
        self._tell_moved("on_leave", client.player)

    def _tell_moved(self, callback: Literal["on_join", "on_leave", "on_return"], player: str) -> None:
        if self.callbacks and self.phase is Phase.PLAYING and not self._agent_hangs:
            self._emit(TellMoved(callback, player))

    def _handle(self, client: Client, message: messages.Message) -> None:
        """Do what a client asks for. Raises CommandRefused with words for the client."""
        command = message.command
        if message.frame_rate is not None and not self.config.allow_frame_rate_change:
            raise CommandRefused("the frame rate of this game is fixed")
        missing = messages.not_offered(message, self._offered)
        if missing is not None:
            raise CommandRefused(f"{missing} is not offered in this game")
        if messages.is_feedback(command) and self.progress.over:
            raise CommandRefused("the game is over, and no command has an effect any more")
        self._messages.add(message, self._ns())
        if command is not None:
            self._command(client, command)
        if message.frame_rate is not None:
            self.progress.change_frame_rate(message.frame_rate)
        if message.action is not None:
            self.progress.act(message.action, message.held, lasts=message.lasts, player=client.player)
        if message.key is not None:
            self.progress.act(KEY + message.key, message.held, player=client.player)

    def _command(self, client: Client, command: str) -> None:
        if command == "requestUI":
            self._clients.send(client, self._controls(client))
        elif self._closing:
            pass  # the end of the server has ended what was on
        elif command == "start":
            self.progress.start()
        elif command == "pause":
            self.progress.pause()
        elif command in ("reset", "stop") and command not in self._commands:
            self._commands.append(command)

    def _note(self, event: str) -> None:
        """Keep for the recording an event that no message reports."""
        self._messages.note(event, self._ns())

    def _ns(self) -> int:
        return int(self._now * 1e9)

    def _send_state(self) -> None:
        if not self.finished:
            progress = self.progress
            self._clients.send_state(progress, self._times if self._timed or progress.on_break else None)

    def _times(self) -> StateTimes:
        progress, now = self.progress, self._now
        return StateTimes(
            next_in=self._break_left(),
            turn_ends_in=None if progress.turns is None else progress.turns.ends_in(now),
            starts_in=self._episode_time.starts_in(now) if progress.stands else None,
            time_left=None if progress.over or progress.on_break else self._episode_time.left(now),
        )

    def _controls(self, client: Client) -> str:
        return controls_of(self.progress, client.player, self._times(), self._scene)

    def _send_done(self) -> None:
        episodes, score = self.progress.episodes_played, self.progress.score
        if self._earlier_answers is not None:
            episodes, score = self._earlier_answers.get("episodes", 0), self._earlier_answers.get("score", 0)
            self._clients.send_done(episodes, self._earlier_answers.get("scores") or {}, score)
            return
        self._clients.send_done(episodes, self.progress.scores, score)

    def _emit(self, effect: Effect) -> None:
        self._effects.append(effect)

    def _take_effects(self) -> list[Effect]:
        effects, self._effects = self._effects, []
        return effects
