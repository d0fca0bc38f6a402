"""The trial server: admits one participant, or the members of one session, and connects them to their trials.

It ends when the last trial is over, or when no participant comes. A warm server does not know at first who plays, nor
does the server of a session that is not formed yet. They refuse clients until they know
(`hippodrome/trial/server/assignment.py`).
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
from collections.abc import AsyncIterator, Coroutine
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from hippodrome.protocol import assignment, exits
from hippodrome.protocol.session import assignment_key
from hippodrome.trial.agent import match
from hippodrome.trial.agent.agent import AgentAdapter
from hippodrome.trial.agent.tracebacks import IdFilter, report
from hippodrome.trial.agent.worker import Worker
from hippodrome.trial.core import messages
from hippodrome.trial.core.effects import AgentTimeout
from hippodrome.trial.core.messages import BadMessage, CloseConnection, CommandRefused, NotAMessage
from hippodrome.trial.core.players import PlayersError
from hippodrome.trial.llm.endpoint import Endpoint
from hippodrome.trial.pictures.reader import Drawing
from hippodrome.trial.policies.policy import PolicyError
from hippodrome.trial.recordings.recorder import Spool
from hippodrome.trial.recordings.store import Store, open_store, short_error, store_file
from hippodrome.trial.server import watch
from hippodrome.trial.server.admission import NOT_ASSIGNED, Admission, first_of
from hippodrome.trial.server.assignment import AssignmentDocument, Search, set_environment
from hippodrome.trial.server.handshake import check_matches, is_program, token_in_address
from hippodrome.trial.server.lifetime import Lifetime, exit_hard_after
from hippodrome.trial.server.listener import CLOSE_SECONDS, Listener
from hippodrome.trial.server.loop import TrialLoop
from hippodrome.trial.server.matching import Matching
from hippodrome.trial.server.own_certificate import CertificateAndKey
from hippodrome.trial.server.started import StartedAgent
from hippodrome.trial.settings import TrialSettings, trial_section
from hippodrome.trial.wire.connection import Connection, measure_round_trips
from hippodrome.trial.wire.inbound import Inbound

log = logging.getLogger("trial")

STORE_MARGIN = 10.0
"""The server stops trying to store recordings this many seconds before its process is killed."""
EXIT_MARGIN = 4.0
"""The process ends, whatever still runs, this many seconds before it would be killed."""
TELL_SECONDS = 5.0
"""If a trial cannot begin, the server ends after so many seconds, and another server replaces it. Until then it tells
clients that connect."""
_TOLD_SECONDS = 0.3  # once one client is told, the server ends within this time instead
_CANNOT_START = "The game cannot be started at the moment. Please wait: it is tried again."


class TrialServer:
    """The server of one participant, or of one session. `run` returns the process's exit status."""

    def __init__(self, settings: TrialSettings, own: Future[CertificateAndKey] | None = None) -> None:
        """`own`: the certificate for the server's own address, if it gets one (`own_certificate.py`)."""
        self.settings = settings
        self._own = own
        self._store: Store
        self._spool: Spool
        self._listener: Listener
        self._lifetime: Lifetime
        self._worker = Worker()
        self._drawing = Drawing(settings.trial.scene, settings.agent_dir)
        self._agent = AgentAdapter(
            settings.agent_dir, settings.trial.game, settings.trial.action_space, self._drawing.reader
        )
        self._agent_ready: asyncio.Task[StartedAgent | None]
        self._failure = 1  # the exit status if an error ends the server
        self._trials: list[TrialLoop] = []  # in their order, also ended ones, whose policies or callbacks may still run
        self._finished_steps: set[str] = set()
        self._assigned: assignment.Assigned | None = None
        self._search: Search
        self._admission: Admission
        self._connections: dict[Connection, asyncio.Task[None]] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._endpoint: Endpoint | None = None
        self._watchers = watch.Watchers()
        self._watching = 0  # the number of programs that watch

    async def run(self) -> int:
        """Serve until the last trial is over, no participant comes, the deadline passes, or `end` is called."""
        settings = self.settings
        log.addFilter(IdFilter(lambda: self.settings.private))
        if settings.asks_model:
            self._open_endpoint()  # before agent.py is imported
        self._lifetime = Lifetime(settings, saving=self._is_saving)
        self._store = await asyncio.to_thread(open_store, settings.store, settings.server, settings.credential)
        self._spool = await asyncio.to_thread(Spool, settings, self._store)
        self._search = Search(self._store, settings)
        self._admission = Admission(lambda: self.settings, self._search, self._store, self._finished_steps)
        self._listener = Listener(settings, self._store, self._connected, self._own)
        self._agent_ready = asyncio.create_task(self._start_agent())  # while the certificate is fetched
        ending, opening = asyncio.create_task(self._lifetime.over()), asyncio.create_task(self._listener.open())
        await asyncio.wait((ending, opening), return_when=asyncio.FIRST_COMPLETED)
        if not opening.done():  # the certificate may take minutes
            log.info("ending without a certificate: %s", ending.result())
            return self._failure if ending.result() == "error" else 0
        port = await opening
        print(json.dumps({"port": port}), flush=True)
        log.info("listening on port %d", port)
        if not settings.warm_server:
            self._in_background(self._store_files(await self._leftovers(settings)))
        if not settings.assigned:
            self._in_background(self._search.run(self._assign))
            if settings.match:
                self._in_background(self._match())
        self._in_background(self._listener.renew_certificate())
        self._lifetime.watch()
        reason = await ending
        log.info("ending: %s", reason)
        exit_hard_after(self.settings.stop_seconds - EXIT_MARGIN)
        await self._close(reason)
        return self._failure if reason == "error" else 0

    def end(self, reason: str) -> None:
        """End the server. `reason` is for the log; "error" makes the exit status a failure. For the event loop."""
        self._lifetime.end(reason)

    @property
    def stuck(self) -> bool:
        """Whether the researcher's code is still running, and may never return."""
        return self._worker.busy or any(trial.stuck for trial in self._trials)

    def _is_saving(self) -> bool:
        return any(trial.core.saving or trial.storing for trial in self._trials)

    async def _close(self, reason: str) -> None:
        for task in self._tasks:
            task.cancel()
        self._listener.close("the trial is done" if reason == "done" else "the server is going away")
        seconds = self.settings.stop_seconds - STORE_MARGIN
        if self._endpoint is not None and reason != "done":  # or the next server would pay for the same calls again
            await asyncio.to_thread(self._endpoint.close, seconds / 2)
            seconds /= 2
        await asyncio.gather(*(trial.close(seconds) for trial in self._trials))
        if not self._agent_ready.done():
            self._agent_ready.cancel()
        if not self._worker.busy:
            with contextlib.suppress(Exception):  # the game is over: an error of the agent changes nothing any more
                await self._worker.call(self._agent.close, limit=CLOSE_SECONDS)
        self._worker.close()
        for connection in self._connections:
            connection.abort()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._listener.wait_closed(), CLOSE_SECONDS)

    def _in_background(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # ---- before the participant comes

    async def _start_agent(self) -> StartedAgent | None:
        try:
            settings = self.settings
            start = partial(StartedAgent.start, self._agent, settings)
            started = await self._worker.call(start, limit=settings.start_seconds)
        except (PlayersError, PolicyError) as error:
            self._failure = exits.NO_AGENT
            log.error("%s", error)
            self._lifetime.end_in(TELL_SECONDS, "error")
            return None
        except Exception as error:  # noqa: BLE001 - the researcher's code may raise anything
            settings = self.settings  # the present settings: a warm server may have been assigned meanwhile
            self._failure = exits.LATE_AGENT if isinstance(error, AgentTimeout) else exits.NO_AGENT
            log.error("the agent cannot be started\n%s", report(error, settings.agent_dir, settings.private))
            self._lifetime.end_in(TELL_SECONDS, "error")
            return None
        log.info("the agent is ready")
        return started

    async def _match(self) -> None:
        """Answer the lobby's questions by the function `match`, from the agent's start until the server is assigned."""
        if await asyncio.shield(self._agent_ready) is None:
            return
        function = match.function_of(self._agent.agent_module)
        if function is None:
            log.error("config.yml has `matching: match`, but agent.py has no function match, so nobody is matched")
            return
        await Matching(self._store, lambda: self.settings, function).run()

    async def _assign(self, settings: TrialSettings, assignment_document: AssignmentDocument) -> None:
        """Use the new settings, which follow from the document that says who plays here."""
        if self.settings.warm_server:
            self._in_background(self._store_files(await self._leftovers(settings)))
            log.info("this server is assigned to a %s now", "session" if settings.session else "participant")
        set_environment(os.environ, assignment_document)
        self.settings = settings
        if settings.session and settings.assigned:
            log.info("the members of the session are known now: %d of %d", len(settings.seats), settings.players)
        if settings.assigned:
            self._lifetime.wait_for_participant()

    async def _leftovers(self, settings: TrialSettings) -> list[tuple[str, Path]]:
        """Return the recordings, with their keys, that an earlier process of this server has not stored.

        Call it before this process records anything.
        """
        if not self._spool.local_only:
            with contextlib.suppress(OSError):
                return await asyncio.to_thread(self._spool.leftovers, settings.recordings_folder)
        return []

    async def _store_files(self, leftovers: list[tuple[str, Path]]) -> None:
        for key, path in leftovers:
            log.warning("storing a recording that an earlier process left")
            await store_file(self._store, key, path)

    # ---- a connection

    async def _connected(self, websocket: ServerConnection) -> None:
        try:
            await self._serve(websocket)
        except ConnectionClosed:
            pass
        except CloseConnection as closing:
            try:
                async with asyncio.timeout(2 * CLOSE_SECONDS):
                    await websocket.send(messages.error(closing.words))
                    await websocket.close(closing.code, _reason(closing.words))
            except (TimeoutError, ConnectionClosed):
                websocket.transport.abort()
        except Exception:
            log.exception("a connection failed")
            await websocket.close(1011)

    async def _serve(self, websocket: ServerConnection) -> None:
        if is_program(websocket):
            await self._serve_watching(websocket)
            return
        hello = await self._admission.admit(websocket)
        self._listener.authenticated(websocket)
        await self._learn_games()
        trial = self._trial_of(hello.step)
        drawing = self._drawing
        connection = Connection(
            websocket,
            decodes=hello.decodes,
            lossless=trial.settings.trial.lossless,
            stalled_seconds=self.settings.stalled_seconds,
            assets=drawing.assets,
            draw=drawing.draw,
        )
        sender = asyncio.create_task(connection.run())
        self._connections[connection] = sender
        self._lifetime.connected()
        try:
            human = (hello.user_id or "") if self.settings.session else self.settings.user_id
            await self._connect(trial, human, connection)
            async with self._measured(trial, human, connection):
                await self._receive(trial, connection)
        except CloseConnection as closing:
            connection.close(closing.code, messages.error(closing.words))
            if closing.code == 1011:
                sender.add_done_callback(lambda _: self._lifetime.end_in(_TOLD_SECONDS, "error"))
        finally:
            trial.disconnect(connection)
            if websocket.close_code is None:  # the server ends the connection: messages that wait are sent first
                await asyncio.wait({sender}, timeout=2 * CLOSE_SECONDS)
                if not sender.done():
                    connection.abort()
            sender.cancel()
            del self._connections[connection]
            if not self._connections:
                self._lifetime.wait_for_participant()

    async def _serve_watching(self, websocket: ServerConnection) -> None:
        """Serve a program that watches, if its address has the token. Raises CloseConnection and ConnectionClosed."""
        check_matches(token_in_address(websocket), self.settings.token)
        if not self.settings.assigned:
            raise CloseConnection(1013, NOT_ASSIGNED)
        if self._watching >= watch.MAX_PROGRAMS:
            raise CloseConnection(1013, f"{watch.MAX_PROGRAMS} programs watch already; try later")
        self._listener.authenticated(websocket)
        self._watching += 1
        try:
            advise = self._advise if self.settings.trial.gym == "advise" else None
            await watch.Watching(websocket, self._watchers, self._action_space, advise).run()
        finally:
            self._watching -= 1

    def _action_space(self, player: str | None) -> tuple[str, ...]:
        return self._current().core.progress.choices.action_space_of(player)

    def _advise(self, action: int, player: str | None) -> None:
        self._current().advise(action, player)

    def _current(self) -> TrialLoop:
        if not self._trials:
            raise CommandRefused("no game is going on")
        return self._trials[-1]

    async def _connect(self, trial: TrialLoop, human: str, connection: Connection) -> None:
        """Connect a client to the trial once that is ready. Raises CloseConnection if the game cannot begin."""
        await first_of(trial.ready.wait(), connection.websocket.wait_closed())
        if connection.websocket.close_code is not None:
            return  # closed before the game was ready: it must not replace a client that plays now
        if trial.core.broken:
            raise CloseConnection(1011, _CANNOT_START)
        trial.connect(human, connection)

    @contextlib.asynccontextmanager
    async def _measured(self, trial: TrialLoop, human: str, connection: Connection) -> AsyncIterator[None]:
        """In a session, measure the connection's round trips within the `with`, and report them to the trial."""
        if not self.settings.session:
            yield
            return
        report, samples = partial(trial.round_trip, human), trial.settings.trial.ping_samples
        measuring = asyncio.create_task(measure_round_trips(connection.websocket, samples, report))
        try:
            yield
        finally:
            measuring.cancel()

    async def _receive(self, trial: TrialLoop, connection: Connection) -> None:
        """Receive a client's messages until its connection is closed. Raises CloseConnection and ConnectionClosed."""
        loop = asyncio.get_running_loop()
        inbound = Inbound(connection.window if connection.binary else None, messages.words_of(trial.settings.trial))
        async for data in connection.websocket:
            try:
                message = inbound.read(data, loop.time())
            except (NotAMessage, BadMessage) as error:
                connection.send(messages.error(str(error)))
                continue
            if message.ack is not None and connection.binary:
                connection.acknowledged(message.ack)
            if message.asset is not None and not connection.send_asset(message.asset):
                connection.send(messages.error("this game has no such image"))
            trial.receive(connection, message)

    # ---- trials

    def _trial_of(self, step: str | None) -> TrialLoop:
        """Return the trial of this step, which is begun if necessary. Raises CloseConnection.

        In a session, a member whose answer of an earlier step is not stored waits there, while the others play the next
        step: so there may be several trials that are not done.
        """
        trial = self._trials[-1] if self._trials else None
        if trial is not None and trial.core.broken:
            return trial
        if step is None:
            step = trial.core.step if trial is not None and not trial.core.finished else self._next_step()
        if trial is not None and trial.core.step == step:
            return trial
        unstored = next((trial for trial in self._trials if trial.core.step == step and trial.core.saving), None)
        if unstored is not None:
            return unstored
        if trial is not None and not trial.core.played:
            raise CloseConnection(4404, "another step's game is still going on")
        settings = self._settings_of(step)
        if settings.trial.llm is not None and self._endpoint is None:  # no other game has a model, and this one no key
            self._open_endpoint()
        trial = TrialLoop(
            settings,
            step,
            worker=self._worker,
            store=self._store,
            spool=self._spool,
            watchers=self._watchers,
            endpoint=self._endpoint,
            assets=self._drawing.assets.table(),
        )
        self._trials.append(trial)
        trial.begin(asyncio.shield(self._agent_ready)).add_done_callback(partial(self._trial_done, trial))
        return trial

    async def _learn_games(self) -> None:
        """Read once which games are played here, if the participants' games differ. Raises CloseConnection."""
        settings = self.settings
        if not settings.has_assignment or self._assigned is not None:
            return
        owner = settings.session or settings.user_id
        try:
            body = await asyncio.to_thread(self._store.get, assignment_key(settings.project_id, owner))
            found = assignment.parse(body) if body is not None else None
        except Exception as error:
            log.warning("cannot read the assignment (%s)", short_error(error))
            raise CloseConnection(1013, NOT_ASSIGNED) from error
        if found is None or not found.games.keys() <= set(settings.game_steps):
            raise CloseConnection(1013, NOT_ASSIGNED)
        if self._assigned is None:
            self._assigned, self.settings = found, replace(self.settings, game_steps=tuple(found.games))

    def _settings_of(self, step: str) -> TrialSettings:
        """The settings of the trial of this step: with the keys of `trial` that the game has for itself."""
        game = self._assigned.games.get(step) if self._assigned else None
        if self._assigned is None or game is None:
            return replace(self.settings, answers={name: (name,) for name in self.settings.trial.answers})
        section = trial_section({**self.settings.trial.document(), **game.trial})
        levels = {**game.levels, "position": game.position} if game.levels else {}
        condition = self._assigned.condition
        return replace(self.settings, trial=section, condition=condition, levels=levels, answers=game.answers)

    def _open_endpoint(self) -> None:
        """Open the way to the language model, and tell programs where it is."""
        self._endpoint = Endpoint(self.settings.llm_key, self.settings.llm_url)
        os.environ.update(self._endpoint.environment())

    def _next_step(self) -> str:
        steps = self.settings.game_steps
        return next((step for step in steps if step not in self._finished_steps), steps[-1])

    def _trial_done(self, trial: TrialLoop, done: asyncio.Future[None]) -> None:
        if done.exception() is not None:
            log.error("an error of the server has ended the trial", exc_info=done.exception())
            self.end("error")
        elif trial.core.broken:
            self._lifetime.end_in(TELL_SECONDS, "error")
        elif trial.core.finished:
            self._finished_steps.add(trial.core.step)
            if trial.core.step == self.settings.game_steps[-1]:
                self._in_background(self._end_when_stored())

    async def _end_when_stored(self) -> None:
        """End the server once all answers and recordings are stored. Those of the last game step are stored already."""
        for trial in self._trials:
            await trial.stored()
        self._lifetime.end_in(self.settings.linger_seconds, "done")


def _reason(words: str) -> str:
    """Shorten the words to the reason of a close, which has at most 123 bytes (RFC 6455, 5.5)."""
    return words.encode("utf-8", "replace")[:120].decode("utf-8", "ignore")
