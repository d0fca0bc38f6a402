"""The asyncio shell of a trial: passes events to its core (`trial/core/trial.py`), and carries out the effects."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import uuid
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from hippodrome.trial.agent.callbacks import Callbacks, TrialFacts
from hippodrome.trial.agent.calls import AgentCalls, Calls
from hippodrome.trial.agent.joint import JointAdapter
from hippodrome.trial.agent.joint_calls import JointCalls
from hippodrome.trial.agent.replies import Mouth, Replies, TalkOfAgent
from hippodrome.trial.agent.signatures import MODERATE, REPLY, TALK_METHODS
from hippodrome.trial.agent.tracebacks import report, where, without
from hippodrome.trial.agent.worker import Worker
from hippodrome.trial.core.effects import (
    AskReply,
    Call,
    Close,
    CloseRecording,
    Effect,
    FeedbackCall,
    LogAgentError,
    Moderate,
    OpenRecording,
    RecordLine,
    RecordTalk,
    ReplayCall,
    ResetCall,
    ResetPolicy,
    SaveAnswer,
    SaveMember,
    SendDone,
    SendMessage,
    SendPicture,
    SendState,
    SendTalk,
    StepCall,
    TellAgent,
    WriteLine,
    WriteLog,
)
from hippodrome.trial.core.history import RecordedTrial
from hippodrome.trial.core.messages import Message
from hippodrome.trial.core.players import Player, PlayersError
from hippodrome.trial.core.policies import AskPolicy
from hippodrome.trial.core.trial import Trial
from hippodrome.trial.llm.client import ModelError
from hippodrome.trial.llm.endpoint import Endpoint, Game
from hippodrome.trial.llm.ledger import Ledger, Moment
from hippodrome.trial.llm.partner import NoPrompt, Partner, prompt_of
from hippodrome.trial.policies.places import Places
from hippodrome.trial.policies.policy import PolicyError
from hippodrome.trial.recordings.recorder import Recorder, Spool
from hippodrome.trial.recordings.store import Store, short_error
from hippodrome.trial.server.callbacks import TrialCallbacks
from hippodrome.trial.server.earlier_answers import read_earlier
from hippodrome.trial.server.started import StartedAgent, TrialPlayers
from hippodrome.trial.server.watch import Watchers
from hippodrome.trial.settings import TrialSettings
from hippodrome.trial.wire.connection import Connection

log = logging.getLogger("trial")


class TrialLoop:
    """Runs one trial. All methods are for the event loop."""

    def __init__(
        self,
        settings: TrialSettings,
        step: str,
        *,
        worker: Worker,
        store: Store,
        spool: Spool,
        watchers: Watchers,
        endpoint: Endpoint | None = None,
        assets: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        """`assets` describe the images of a game that is drawn by objects (`Assets.table`).

        `endpoint`: the way to the language model, if some game of the study may ask one.
        """
        self.core = Trial(
            settings, step, trial_id=uuid.uuid4().hex, new_seed=lambda: secrets.randbelow(2**31), assets=assets
        )
        self.ready = asyncio.Event()
        """An event that is set once there is a first frame, or the trial is over without one."""
        self.settings = settings
        """The server's settings, with what this game has for itself."""
        self._hide = partial(without, settings.private) if settings.session else str
        """A function that removes members' ids from a text, since a session's recording belongs to all members."""
        self._worker = worker
        self._watchers = watchers
        self._store = store
        self._endpoint = endpoint
        self._recorder = Recorder(settings, step, self.core.id, store, spool)
        self._calls: Calls
        self._callbacks = TrialCallbacks(
            worker,
            settings.step_seconds,
            self._write,
            is_open=lambda: self._recorder.is_open,
            is_over=lambda: self.core.done,
        )
        self._places = Places(self._acted)
        self._replies: Replies | None = None
        self._partner: Partner | None = None
        self._ledger: Ledger | None = None
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._starting: asyncio.Task[None] | None = None
        self._saving: asyncio.Task[None] | None = None
        self._saving_members: set[asyncio.Task[None]] = set()
        self._done: asyncio.Future[None] = self._loop.create_future()
        self._logged: set[str] = set()
        self._carry_out: dict[type[Effect], Callable[[Any], None]] = {
            **dict.fromkeys((StepCall, FeedbackCall, ResetCall, ReplayCall), self._call),
            SendMessage: lambda effect: effect.connection.send(effect.text),
            SendState: self._send_state,
            SendTalk: lambda effect: effect.connection.send_talk(effect.fields),
            AskReply: self._ask_agent,
            Moderate: self._ask_agent,
            RecordTalk: self._record_talk,
            SendPicture: lambda effect: effect.connection.show(effect.picture, effect.frame_id),
            SendDone: self._send_done,
            Close: lambda effect: effect.connection.close(effect.code, effect.text),
            WriteLine: self._write_line,
            TellAgent: self._callbacks.tell_agent,
            RecordLine: self._record_line,
            OpenRecording: self._open_recording,
            CloseRecording: lambda _: self._recorder.close(),
            SaveAnswer: self._save,
            SaveMember: self._save_member,
            WriteLog: lambda effect: log.log(effect.level, effect.text),
            LogAgentError: self._log_agent_error,
            AskPolicy: self._places.ask,
            ResetPolicy: self._places.reset,
        }

    @property
    def stuck(self) -> bool:
        """Whether a callback of the agent or a policy has not returned, and may never."""
        return self._places.busy or self._callbacks.busy or (self._replies is not None and self._replies.busy)

    def begin(self, agent_ready: Awaitable[StartedAgent | None]) -> asyncio.Future[None]:
        """Begin the trial once the agent is ready. If `agent_ready` returns None, the agent cannot be started.

        The returned future is done when the trial is done. It fails if an error ends the trial.
        """
        self._starting = asyncio.create_task(self._start(agent_ready))
        self._starting.add_done_callback(self._started)
        return self._done

    @property
    def storing(self) -> bool:
        """Whether a closed recording is not stored yet."""
        return self._recorder.storing

    async def stored(self) -> None:
        """Wait until all closed recordings are stored, and the answers if the trial is over."""
        if self._saving is not None:
            await asyncio.wait({self._saving})
        await self._recorder.stored()

    async def close(self, seconds: float) -> None:
        """End the game where it is, and store its recordings and answers. Give up after `seconds`.

        An answer waits for the recordings for half of this time.
        """
        if self._starting is not None:
            self._starting.cancel()
        self._do(self.core.close)
        hurrying = self._loop.call_later(seconds / 2, self._recorder.hurry)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await asyncio.wait({self._done})
                await self.stored()
        hurrying.cancel()

    # ---- clients

    def connect(self, human: str, connection: Connection) -> None:
        """Show the trial to a human's client, which has connected, from now on."""
        connection.rate = self.core.progress.frame_rate
        self._apply(self.core.connect(human, connection, connection.window, self._loop.time()))

    def disconnect(self, connection: Connection) -> None:
        """Forget a connection that is closed. It need not have been connected."""
        self._apply(self.core.disconnect(connection, self._loop.time()))

    def round_trip(self, human: str, seconds: float) -> None:
        """Report a human's round trip: their browser has answered a ping after `seconds`."""
        self._do(self.core.round_trip, human, seconds)

    def receive(self, connection: Connection, message: Message) -> None:
        """Carry out a message of a client."""
        self._apply(self.core.receive(connection, message, self._loop.time()))

    # ---- programs

    def advise(self, action: int, player: str | None) -> None:
        """Take a program's advice, or the action that it chooses: see `Choices.advise`. Raises CommandRefused."""
        self._apply(self.core.advise(action, player, self._loop.time()))

    # ---- events

    async def _start(self, agent_ready: Awaitable[StartedAgent | None]) -> None:
        answers, answered = await self._earlier()
        if answers is not None:
            self._apply(self.core.already_played(answers))
            return
        answers_given = await self._answers_given(answered)
        started = await agent_ready
        playing = None if started is None else await self._players_of(started)
        if started is None or playing is None or answers_given is None or not await self._read_tape():
            self._apply(self.core.agent_failed(self._loop.time()))
            return
        recorded = await self._recorder.recorded()
        by_player = {player: answers_given[user_id] for user_id, player in playing.places.items()}
        earlier = by_player if self.settings.session else answers_given[self.settings.user_id]
        self._calls = self._calls_of(started, playing, earlier)
        try:
            self._use_model()
        except NoPrompt as error:
            log.error("%s", error)
            self._apply(self.core.agent_failed(self._loop.time()))
            return
        self._action_starts = started.agent.action_starts
        self._places.fill(playing.players, playing.policies, playing.stand_ins, playing.seats)
        self._use_callbacks(started, playing.players, earlier)
        effects = self.core.start(
            playing.players,
            recorded,
            self._loop.time(),
            places=playing.places,
            vacant=playing.vacant,
            erased=playing.erased,
            answered=answered,
            said=self._recorder.tape.earlier,
        )
        self._recorder.tape.seats = playing.seats
        self._use_talk(recorded)
        self._apply(effects)

    async def _read_tape(self) -> bool:
        """Read what was said on earlier servers. Return False if that fails, which is logged.

        Then another server replaces this one: without the tape, lines would be lost and calls paid for again.
        """
        config = self.settings.trial
        if config.chat is not None or config.llm is not None:
            try:
                await self._recorder.tape.load()
            except Exception as error:  # noqa: BLE001 - the store may raise anything
                log.error("cannot read what was said before (%s)", short_error(error))
                return False
        return True

    def _use_talk(self, recorded: RecordedTrial | None) -> None:
        """Let the agent answer and look at lines from now on, and, while steps are taken again, lines of before."""
        talk, replies = self.core.talk, self._replies
        if talk is None or replies is None:
            return
        talk.replies, talk.moderates = replies.reply is not None, replies.moderate is not None
        repeats = talk.repeats(recorded.unfinished.number) if recorded is not None and recorded.unfinished else []

        def repeat(moment: Moment) -> None:
            while repeats and repeats[0][0] <= moment.step:
                replies.repeat(repeats.pop(0)[1])

        self._calls.repeat = repeat

    async def _earlier(self) -> tuple[Mapping[str, Any] | None, Mapping[str, Any]]:
        """Return the stored answer if the step is over, else None; and the answers of some members if it is not over.

        In a session, both hold members' answers by the members' ids.
        """
        if not self.settings.session:
            return await self._recorder.earlier_answers(), {}
        answers = await self._recorder.members_answers()
        over = bool(answers) and len(answers) == len(self.settings.seats)
        return (answers, {}) if over else (None, answers)

    async def _answers_given(self, over: Collection[str]) -> dict[str, dict[str, Any]] | None:
        """The answers to earlier steps that the agent gets, by participant; None if they cannot be read.

        That is logged, and another server replaces this one, as if the agent could not be started.
        """
        try:
            return await read_earlier(self._store, self.settings, over)
        except OSError as error:
            log.error("the participants' answers to earlier steps cannot be read (%s)", short_error(error))
            return None

    async def _players_of(self, started: StartedAgent) -> TrialPlayers | None:
        """Return who plays in this trial; None if the policies cannot be loaded, which is logged."""
        settings = self.settings
        try:
            return await self._worker.call(lambda: started.players_of(settings), limit=settings.start_seconds)
        except (PlayersError, PolicyError) as error:
            log.error("%s", error)
        except Exception as error:  # noqa: BLE001 - a policy may be the researcher's code
            log.error("a policy cannot be loaded\n%s", report(error, settings.agent_dir, settings.private))
        return None

    def _calls_of(self, started: StartedAgent, playing: TrialPlayers, earlier: Mapping[str, Any]) -> Calls:
        stamp, config = self._recorder.stamp, self.settings.trial
        started.agent.set_game(config.options, earlier if config.answers else None)
        if isinstance(started.agent, JointAdapter):
            return JointCalls(
                started.agent,
                playing.players,
                stamp,
                record_observations=config.record_observations,
                stand_ins=playing.stand_ins,
            )
        views = config.pace == "turns"
        return AgentCalls(started.agent, stamp, record_observations=config.record_observations, views=views)

    def _acted(self, player: str, ask_id: int, action: int | None, error: Exception | None) -> None:
        """Tell the core that a policy has answered, with an action or an error."""
        if error is not None:
            self._do(self.core.policy_failed, player, ask_id, error)
        else:
            self._do(self.core.policy_acted, player, ask_id, action)

    def _started(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and task.exception() is not None:
            self._fail(task.exception())

    def _do(self, event: Callable[..., list[Effect]], *args: Any) -> None:
        """Pass an event to the core. No caller could handle an error, so an error ends the trial."""
        try:
            self._apply(event(*args, self._loop.time()))
        except Exception as error:  # noqa: BLE001 - the future of `begin` gets it
            self._fail(error)

    def _fail(self, error: BaseException | None) -> None:
        if not self._done.done() and error is not None:
            self._done.set_exception(error)

    def _call_ended(self, call: Call, result: Any, error: Exception | None) -> None:
        if not isinstance(call, StepCall) or error is not None:
            self._callbacks.write_lines()  # now, because the end of an episode may close its recording
        if error is not None:
            self._do(self.core.call_failed, call, error)
        else:
            self._do(self.core.call_returned, call, result)

    # ---- effects

    def _apply(self, effects: list[Effect]) -> None:
        """Carry out the effects, then set the timer for the core's `wake_at`."""
        for effect in effects:
            self._carry_out[type(effect)](effect)
        core = self.core
        if core.ready:
            self.ready.set()
        if core.done and not self._done.done():
            self._done.set_result(None)
            self._callbacks.close()
            self._places.close()
            if self._replies is not None:
                self._replies.close()
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if core.wake_at is None else self._loop.call_at(core.wake_at, self._wake)

    def _wake(self) -> None:
        self._timer = None
        self._do(self.core.advance)

    def _call(self, call: Call) -> None:
        self._callbacks.on_agent(partial(self._calls.run, call), call.limit, partial(self._call_ended, call))

    def _use_model(self) -> None:
        """Let the agent ask the game's language model from now on, if the game has one. Raises NoPrompt."""
        if self._endpoint is None:
            return
        section = self.settings.trial.llm
        if section is None:
            self._endpoint.play(None)
            return
        self._partner = Partner(section, prompt_of(section, self.settings.agent_dir))
        ledger = self._ledger = Ledger.of(section, self._recorder.tape.earlier)
        self._endpoint.play(Game(section, ledger, self._recorder.tape, self._moment))

    def _moment(self) -> Moment:
        """Return when in the game the agent is now. May be called on any thread."""
        line = None if self._replies is None else self._replies.answering
        return replace(self._calls.moment, line=line)

    def _use_callbacks(self, started: StartedAgent, players: Sequence[Player], earlier: Mapping[str, Any]) -> None:
        """If the agent has callbacks, or somebody talks, call them from now on."""
        settings, agent, partner = self.settings, started.agent, self._partner
        talks, model = settings.trial.chat is not None, settings.trial.llm
        if not started.callbacks and not talks:
            return
        self.core.callbacks = bool(started.callbacks)
        mouth = Mouth(lambda: self.core.talk, partial(self._do, self.core.agent_says))
        callbacks = self._calls.callbacks = Callbacks(
            started.callbacks,
            TrialFacts(
                self.core.id,
                self.core.step,
                settings.group,
                tuple(player.name for player in players),
                tuple(player.name for player in players if player.human),
                settings.condition,
                settings.levels,
                earlier if settings.trial.answers else {},
            ),
            lambda: agent.env,
            seconds=settings.trial.callback_seconds,
            stamp=self._recorder.stamp,
            failed=self._callback_failed,
            hide=self._hide,
            late=self._callbacks.late,
            talk=TalkOfAgent(
                settings.trial.options,
                mouth.lines,
                mouth.say if talks else None,
                **({"ask": partner.ask} if partner else {}),
            ),
        )
        self._callbacks.begin(callbacks)
        if talks:
            methods = agent.talk
            self._replies = Replies(
                methods.get(REPLY) or (partner.reply if partner else None),
                methods.get(MODERATE),
                callbacks.session_of,
                grows=partial(self._do, self.core.reply_grows),
                ended=partial(self._do, self.core.reply_ended),
                moderated=partial(self._do, self.core.moderated),
                failed=self._talk_failed,
                fallback=None if model is None else model.fallback,
            )

    def _callback_failed(self, name: str, error: BaseException) -> None:
        """Log the error of a callback; of `reply` and `moderate` place and type: a message may quote what was said."""
        folder = self.settings.agent_dir
        if isinstance(error, ModelError):  # its message quotes nothing, and says such things as status 401
            log.error("%s failed: %s: %s", name, type(error).__name__, error)
        elif name in TALK_METHODS:
            log.error("%s failed: %s at %s", name, type(error).__name__, where(error, folder) or "an unknown place")
        else:
            log.error("the callback %s failed\n%s", name, report(error, folder, self.settings.private))

    def _talk_failed(self, name: str, error: Exception) -> None:
        """Record that `reply` or `moderate` has raised, or took too long."""
        assert self._calls.callbacks is not None
        self._calls.callbacks.talk_failed(name, error)
        moment = self._calls.moment
        place = {"episode": moment.episode, "step": moment.step}
        self._recorder.tape.add({"kind": "error", "method": name, "name": type(error).__name__, **place})

    def _ask_agent(self, effect: AskReply | Moderate) -> None:
        assert self._replies is not None
        if isinstance(effect, AskReply):
            self._replies.ask(effect)
        else:
            self._replies.check(effect)

    def _record_talk(self, effect: RecordTalk) -> None:
        """Add a line of the talk to the tape."""
        self._recorder.tape.add(dict(effect.fields))

    def _record_line(self, effect: RecordLine) -> None:
        fields = effect.fields
        if effect.kind == "error":
            fields = {**fields, "error": self._hide(fields["error"])}
        self._write(self._recorder.line(effect.kind, fields))

    def _write_line(self, effect: WriteLine) -> None:
        """Write the line of a step or a reset, then the lines that callbacks recorded during it."""
        self._write(effect.line)
        self._callbacks.write_lines()

    def _send_state(self, effect: SendState) -> None:
        connection: Any = effect.connection
        connection.rate = effect.frame_rate
        connection.send_state(effect.text)

    def _send_done(self, effect: SendDone) -> None:
        connection: Any = effect.connection
        connection.close_done(effect.episodes, effect.score, effect.outcome, effect.words)

    def _write(self, line: bytes) -> None:
        self._recorder.write(line)
        self._watchers.tell(line)

    def _open_recording(self, opening: OpenRecording) -> None:
        try:
            self._recorder.open(opening, self._places.described if opening.players else {}, self._action_starts)
        except OSError as error:
            log.error("a recording cannot be opened (%s)", short_error(error))
            self._apply(self.core.recording_failed(self._loop.time()))
        else:
            self._apply(self.core.recording_opened(self._loop.time()))

    def _save(self, effect: SaveAnswer) -> None:
        self._saving = asyncio.create_task(self._save_all(effect))
        self._saving.add_done_callback(self._saved)

    async def _save_all(self, effect: SaveAnswer) -> None:
        """Store the answers after the recordings. Also wait until the answers of earlier `SaveMember` are stored."""
        await self._recorder.save(None if effect.answers is None else self._with_talk(effect.answers))
        for human, answers in effect.by_human.items():
            self._save_member(SaveMember(human, answers))
        if self._saving_members:
            await asyncio.wait(self._saving_members)

    def _with_talk(self, answers: Mapping[str, Any]) -> Mapping[str, Any]:
        """Add to an answer how much the participant has said, and what the game's language model was asked, if any."""
        talk, found = self.core.talk, {}
        if talk is not None:
            earlier = self._recorder.tape.earlier
            fallbacks = sum(record.get("kind") == "error" and record.get("method") == REPLY for record in earlier)
            fallbacks += self._replies.fallbacks if self._replies is not None else 0
            said = talk.said_by(str(answers.get("player", talk.people[0])))
            found = {"lines": said, "fallbacks": fallbacks}
        if self._ledger is not None and self._partner is not None:
            found |= {**self._ledger.summary(), **self._partner.hashes()}
        return {**answers, "talk": found} if found else answers

    def _saved(self, task: asyncio.Task[None]) -> None:
        if task.cancelled():
            return
        if task.exception() is not None:
            self._fail(task.exception())
        else:
            self._do(self.core.answer_saved)

    def _save_member(self, effect: SaveMember) -> None:
        answers = self._with_talk(effect.answers)
        task = asyncio.create_task(self._recorder.save_member(effect.human, answers, effect.later))
        self._saving_members.add(task)

        def saved(task: asyncio.Task[None]) -> None:
            self._saving_members.discard(task)
            if not task.cancelled() and task.exception() is not None:
                self._fail(task.exception())
            elif not task.cancelled():
                self._do(self.core.member_saved, effect.human)

        task.add_done_callback(saved)

    def _log_agent_error(self, effect: LogAgentError) -> None:
        text = report(effect.error, self.settings.agent_dir, self.settings.private)
        if text in self._logged:
            log.warning("the agent failed again, in the same way")
        else:
            self._logged.add(text)
            log.error("the agent failed\n%s", text)
