"""The asyncio shell of a trial: brings events to its core (`trial/core/trial.py`) and carries out the effects."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import uuid
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any

from trial.agent.callbacks import About, Callbacks
from trial.agent.calls import AgentCalls, Calls
from trial.agent.joint import JointAdapter
from trial.agent.joint_calls import JointCalls
from trial.agent.tracebacks import report
from trial.agent.worker import Worker
from trial.core.effects import (
    Call,
    Close,
    CloseRecording,
    Effect,
    Log,
    LogAgentError,
    OpenRecording,
    RecordLine,
    ResetPolicy,
    SaveAnswer,
    SendDone,
    SendMessage,
    SendPicture,
    SendState,
    StepCall,
    TellMoved,
    WriteLine,
)
from trial.core.messages import Message
from trial.core.players import Player, PlayersError
from trial.core.policies import AskPolicy
from trial.core.trial import Trial
from trial.policies.policy import PolicyError
from trial.policies.seats import Seats
from trial.programs.watch import Watchers
from trial.recordings.recorder import Recorder
from trial.recordings.spool import Spool
from trial.recordings.store import Store, short_error
from trial.server.started import Started, Table
from trial.settings import Settings
from trial.wire.connection import Connection

log = logging.getLogger("trial")

_MOVES = 4  # participants who came and went, of whom callbacks have not been told; more are put together


class TrialLoop:
    """Runs one trial on the event loop, from which all methods are to be called."""

    def __init__(
        self,
        settings: Settings,
        step: str,
        *,
        worker: Worker,
        store: Store,
        spool: Spool,
        watchers: Watchers,
        assets: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        """`assets` are the images of a game that is drawn by objects (`Assets.table`)."""
        self.core = Trial(
            settings, step, trial_id=uuid.uuid4().hex, new_seed=lambda: secrets.randbelow(2**31), assets=assets
        )
        self.ready = asyncio.Event()
        """The first frame is there, or the trial is over."""
        self._settings = settings
        self._worker = worker
        self._watchers = watchers
        self._recorder = Recorder(settings, step, self.core.id, store, spool)
        self._calls: Calls
        self._callbacks: Callbacks | None = None
        self._moves: deque[TellMoved] = deque()  # the first is being told
        self._seats = Seats(self._acted)
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._starting: asyncio.Task[None] | None = None
        self._saving: asyncio.Task[None] | None = None
        self._done: asyncio.Future[None] = self._loop.create_future()
        self._logged: set[str] = set()
        self._pictured: list[Connection] = []  # connections that have a new picture
        self._carry_out: dict[type[Effect], Callable[[Any], None]] = {
            SendMessage: lambda effect: effect.connection.send(effect.text),
            SendState: self._send_state,
            SendPicture: self._send_picture,
            SendDone: lambda effect: effect.connection.close_done(effect.episodes, effect.score),
            Close: lambda effect: effect.connection.close(effect.code, effect.text),
            WriteLine: lambda effect: self._write(effect.line),
            TellMoved: self._tell_moved,
            RecordLine: lambda effect: self._write(self._recorder.line(effect.kind, effect.fields)),
            OpenRecording: self._open_recording,
            CloseRecording: lambda _: self._recorder.close(),
            SaveAnswer: self._save,
            Log: lambda effect: log.log(effect.level, effect.text),
            LogAgentError: self._log_agent_error,
            AskPolicy: self._seats.ask,
            ResetPolicy: self._seats.reset,
        }

    @property
    def stuck(self) -> bool:
        """A callback of the agent or a policy has not returned, and may never."""
        return self._seats.busy or (self._callbacks is not None and self._callbacks.busy)

    def begin(self, agent_ready: Awaitable[Started | None]) -> asyncio.Future[None]:
        """Play, once the agent is ready. The future is done when the trial is, and has the exception that broke it."""
        self._starting = asyncio.create_task(self._start(agent_ready))
        self._starting.add_done_callback(self._started)
        return self._done

    async def close(self, seconds: float) -> None:
        """End playing where the game stands and store what was recorded.

        Gives up after `seconds`, even if the researcher's code or the store never answers.
        """
        if self._starting is not None:
            self._starting.cancel()
        self._do(self.core.close)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await asyncio.wait({self._done})

    # ---- clients

    def connect(self, human: str, connection: Connection) -> None:
        """Show the trial to this client and do what it asks for."""
        connection.rate = self.core.progress.frame_rate
        self._apply(self.core.connect(human, connection, connection.window, self._loop.time()))

    def disconnect(self, connection: Connection) -> None:
        self._apply(self.core.disconnect(connection, self._loop.time()))

    def receive(self, connection: Connection, message: Message) -> None:
        self._apply(self.core.receive(connection, message, self._loop.time()))

    # ---- programs

    def advise(self, action: int, player: str | None) -> None:
        """A program advises an action, or chooses it. Raises CommandRefused."""
        self._apply(self.core.advise(action, player, self._loop.time()))

    # ---- events

    async def _start(self, agent_ready: Awaitable[Started | None]) -> None:
        answers = await self._recorder.earlier_answers()
        if answers is not None:
            self._apply(self.core.already_played(answers))
            return
        started = await agent_ready
        table = None if started is None else await self._table(started)
        if started is None or table is None:
            self._apply(self.core.agent_failed(self._loop.time()))
            return
        recorded = await self._recorder.recorded()
        self._calls = self._calls_of(started, table.players)
        self._seats.fill(table.players, table.policies)
        self._find_callbacks(started, table.players)
        self._apply(self.core.start(table.players, recorded, self._loop.time()))

    async def _table(self, started: Started) -> Table | None:
        """Who plays whom; None if the policies cannot be loaded, which the log says."""
        settings = self._settings
        try:
            return await self._worker.call(lambda: started.take(settings.group), limit=settings.start_seconds)
        except (PlayersError, PolicyError) as error:
            log.error("%s", error)
        except Exception as error:  # noqa: BLE001 - a policy may be the researcher's code
            log.error("a policy cannot be loaded\n%s", report(error, settings.agent_dir, settings.user_id))
        return None

    def _calls_of(self, started: Started, players: Sequence[Player]) -> Calls:
        stamp, config = self._recorder.stamp, self._settings.trial
        if isinstance(started.agent, JointAdapter):
            return JointCalls(started.agent, players, stamp, record_observations=config.record_observations)
        views = config.pace == "turns"
        return AgentCalls(started.agent, stamp, record_observations=config.record_observations, views=views)

    def _acted(self, player: str, ask_id: int, action: int | None, error: Exception | None) -> None:
        """A policy has answered."""
        if error is not None:
            self._do(self.core.policy_failed, player, ask_id, error)
        else:
            self._do(self.core.policy_acted, player, ask_id, action)

    def _started(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and task.exception() is not None:
            self._fail(task.exception())

    def _do(self, event: Callable[..., list[Effect]], *args: Any) -> None:
        """Bring an event to the core. No caller waits for it, so an error here ends the trial."""
        try:
            self._apply(event(*args, self._loop.time()))
        except Exception as error:  # noqa: BLE001 - the future of `begin` gets it
            self._fail(error)

    def _fail(self, error: BaseException | None) -> None:
        if not self._done.done() and error is not None:
            self._done.set_exception(error)

    def _called(self, call: Call, result: Any, error: Exception | None) -> None:
        if not isinstance(call, StepCall):
            self._write_callbacks()  # before the episode's end, with which its recording may be closed
        if error is not None:
            self._do(self.core.call_failed, call, error)
        else:
            self._do(self.core.call_returned, call, result)
        self._write_callbacks()

    # ---- effects

    def _apply(self, effects: list[Effect]) -> None:
        """Carry out effects; then see when to go on."""
        for effect in effects:
            if isinstance(effect, Call):
                self._call(effect)
            else:
                self._carry_out[type(effect)](effect)
        while self._pictured:  # after the messages of the same event
            self._pictured.pop().send_now()
        core = self.core
        if core.ready:
            self.ready.set()
        if core.done and not self._done.done():
            self._done.set_result(None)
            if self._callbacks:
                self._callbacks.close()
            self._seats.close()
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if core.wake_at is None else self._loop.call_at(core.wake_at, self._do, core.advance)

    def _call(self, call: Call) -> None:
        self._worker.submit(lambda: self._calls.run(call), call.limit, lambda *found: self._called(call, *found))

    def _find_callbacks(self, started: Started, players: Sequence[Player]) -> None:
        """The agent has started: from now on its callbacks are called, if it has some."""
        settings, loop, agent = self._settings, self._loop, started.agent
        if not started.callbacks:
            return
        self.core.callbacks = True
        self._callbacks = self._calls.callbacks = Callbacks(
            started.callbacks,
            About(
                self.core.id,
                self.core.step,
                settings.group,
                tuple(player.name for player in players),
                tuple(player.name for player in players if player.human),
            ),
            lambda: agent.env,
            seconds=settings.trial.callback_seconds,
            stamp=self._recorder.stamp,
            failed=lambda name, error: log.error(
                "the callback %s failed\n%s", name, report(error, settings.agent_dir, settings.user_id)
            ),
            late=lambda: _soon(loop, self._write_callbacks),
        )

    def _write_callbacks(self) -> None:
        """Write what callbacks have recorded, if a recording is open."""
        if self._callbacks and self._recorder.is_open:
            for line in self._callbacks.take():
                self._write(line)

    def _tell_moved(self, effect: TellMoved) -> None:
        """On the agent's thread, between two calls, so that the callback sees the environment at rest.

        One move after the other, with calls in between. If many wait, a participant who left and returned did not move.
        """
        moves = self._moves
        if not self._callbacks:
            return
        if effect.callback == "on_return" and len(moves) >= _MOVES:
            before = max((index for index, move in enumerate(moves) if move.player == effect.player), default=0)
            if before > 0 and moves[before].callback == "on_leave":
                del moves[before]
                return
        moves.append(effect)
        if len(moves) == 1:
            self._tell_next_move()

    def _tell_next_move(self) -> None:
        callbacks, move = self._callbacks, self._moves[0]
        assert callbacks is not None
        self._worker.submit(
            lambda: callbacks.player_moved(move.callback, move.player),
            self._settings.step_seconds,
            lambda *_: self._told_move(),
        )

    def _told_move(self) -> None:
        self._write_callbacks()
        self._moves.popleft()
        if self._moves and not self.core.done:
            self._tell_next_move()

    def _send_state(self, effect: SendState) -> None:
        connection: Any = effect.connection
        connection.rate = effect.frame_rate
        connection.send_state(effect.text)

    def _send_picture(self, effect: SendPicture) -> None:
        connection: Any = effect.connection
        connection.put_picture(effect.picture, effect.frame_id)
        self._pictured.append(connection)

    def _write(self, line: bytes) -> None:
        self._recorder.write(line)
        self._watchers.tell(line)

    def _open_recording(self, opening: OpenRecording) -> None:
        try:
            self._recorder.open(opening, self._seats.described if opening.players else {})
        except OSError as error:
            log.error("a recording cannot be opened (%s)", short_error(error))
            self._apply(self.core.recording_failed(self._loop.time()))
        else:
            self._apply(self.core.recording_opened(self._loop.time()))

    def _save(self, effect: SaveAnswer) -> None:
        self._saving = asyncio.create_task(self._recorder.save(effect.answers))
        self._saving.add_done_callback(self._saved)

    def _saved(self, task: asyncio.Task[None]) -> None:
        if task.cancelled():
            return
        if task.exception() is not None:
            self._fail(task.exception())
        else:
            self._do(self.core.answer_saved)

    def _log_agent_error(self, effect: LogAgentError) -> None:
        text = report(effect.error, self._settings.agent_dir, self._settings.user_id)
        if text in self._logged:
            log.warning("the agent failed again, in the same way")
        else:
            self._logged.add(text)
            log.error("the agent failed\n%s", text)


def _soon(loop: asyncio.AbstractEventLoop, function: Callable[[], None]) -> None:
    """Call it on the event loop, from another thread, unless the loop has ended."""
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(function)
