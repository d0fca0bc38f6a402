"""The recordings and the answer of a trial, on the event loop: written soon, stored when they are complete."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from protocol.answer import GAME, Answer, answers_in, to_json
from protocol.keys import answer_key
from protocol.trial import TrialSection
from trial.core.effects import OpenRecording
from trial.core.players import Player
from trial.core.unfinished import RecordedTrial
from trial.recordings import recording
from trial.recordings.recording import Recording
from trial.recordings.resume import load_recorded
from trial.recordings.spool import Spool, retry_forever, store_file
from trial.recordings.store import Store, short_error
from trial.settings import TrialSettings

log = logging.getLogger("trial")

FLUSH_SECONDS = 0.5
"""Play that may be lost if the process is killed outright."""


class Recorder:
    """Writes what one trial leaves behind, and reads what earlier servers left of the same step."""

    def __init__(self, settings: TrialSettings, step: str, trial_id: str, store: Store, spool: Spool) -> None:
        self._settings = settings
        self._step = step
        self._trial_id = trial_id
        self._store = store
        self._spool = spool
        self._recording: Recording | None = None
        self._flush_timer: asyncio.TimerHandle | None = None
        self._flushing: asyncio.Task[None] | None = None
        self._uploads: set[asyncio.Task[None]] = set()
        self._hurried = asyncio.Event()

    # ---- before

    async def earlier_answers(self) -> dict[str, Any] | None:
        """What an earlier server answered for the participant's step; None if the step has not been played."""
        return await self._earlier_answer(self._settings.user_id)

    async def members_answers(self) -> dict[str, Any]:
        """In a session: the answers of this step that are there, by the members' ids.

        If each of them has one, the step is over. A server that is lost between two answers has stored all recordings
        before, so the next one stores those that are missing. Who was refused in an earlier game has one from there.
        """
        found = {user_id: await self._earlier_answer(user_id) for user_id in self._settings.seats}
        return {user_id: answers for user_id, answers in found.items() if answers is not None}

    async def _earlier_answer(self, user_id: str) -> dict[str, Any] | None:
        try:
            found = await asyncio.to_thread(self._store.get, answer_key(self._settings.project_id, user_id, self._step))
        except Exception as error:  # noqa: BLE001 - whatever the store raises; the answer is not overwritten anyway
            log.warning("cannot look for an earlier answer (%s)", short_error(error))
            return None
        return None if found is None else answers_in(found) or {}

    async def recorded(self) -> RecordedTrial | None:
        """What earlier servers recorded of the step."""
        folder, _, server = self._settings.recordings_folder.rpartition("/")
        try:
            return await asyncio.to_thread(load_recorded, self._store, folder, server, self._step)
        except Exception as error:  # noqa: BLE001 - whatever the store or an old recording raises: it is played anew
            log.warning("cannot look for earlier recordings (%s)", short_error(error))
            return None

    # ---- recordings

    def stamp(self) -> dict[str, Any]:
        """What every line begins with. May be called on any thread."""
        return {
            "v": recording.SCHEMA,
            "session": self._settings.server,
            "trial": self._trial_id,
            "time": datetime.now(UTC),
            "ns": time.monotonic_ns(),
        }

    @property
    def is_open(self) -> bool:
        """There is a recording to which lines can be written."""
        return self._recording is not None

    def open(self, opening: OpenRecording, players: Mapping[str, Any]) -> None:
        """Open a recording and write its header, with who plays whom if there are several. Raises OSError."""
        settings, config = self._settings, self._settings.trial
        name = "trial" if config.data_file == "trial" else f"episode-{opening.episode:04d}"
        self._recording = self._spool.open(f"{settings.recordings_folder}/{self._step}-{name}.jsonl.gz")
        header = recording.line(
            "header",
            **self.stamp(),
            project=settings.project_id,
            **_whose(settings),
            server=settings.server,
            step=self._step,
            game=config.game,
            actionSpace=list(opening.action_space),
            **({"players": _with_actions(players, opening), **rules(config, opening.players)} if players else {}),
            frameRate=opening.frame_rate,
            actionBufferLifespan=config.action_buffer_lifespan,
            episode=opening.episode,
            seed=opening.seed,
            versions=recording.versions(
                (*(recording.OF_SEVERAL if players else ()), *recording.packages(settings.agent_dir))
            ),
        )
        self._recording.add(header)

    def line(self, kind: str, fields: Mapping[str, Any]) -> bytes:
        """A line of this kind, stamped with the time."""
        return recording.line(kind, **self.stamp(), **fields)

    def write(self, line: recording.Line) -> None:
        """Write a finished line. It is in the file within `FLUSH_SECONDS`."""
        if self._recording is None:
            return
        self._recording.add(line)
        if self._flush_timer is None:
            self._flush_later()

    def close(self) -> None:
        """Close the recording and store it, in the background."""
        current, self._recording = self._recording, None
        if current is not None:
            self._uploads.add(asyncio.create_task(self._finish(current)))

    def _flush_later(self) -> None:
        self._flush_timer = asyncio.get_running_loop().call_later(FLUSH_SECONDS, self._flush_soon)

    def _flush_soon(self) -> None:
        self._flush_timer = None
        current = self._recording
        if current is not None and current.dirty:
            self._flushing = asyncio.create_task(self._flush(current))

    async def _flush(self, current: Recording) -> None:
        try:
            await asyncio.to_thread(current.flush)
        except OSError as error:
            log.warning("a recording cannot be written (%s); trying again", short_error(error))
            if self._flush_timer is None:
                self._flush_later()

    async def _finish(self, current: Recording) -> None:
        await retry_forever("close a recording", lambda: asyncio.to_thread(current.close))
        if self._spool.local_only:
            current.path.replace(current.path.with_suffix(""))
            return
        await store_file(self._store, current.key, current.path)

    # ---- the end

    async def save(self, answers: Mapping[str, Any] | None) -> None:
        """Wait until all recordings are stored, then store the answer: a reader of the answer finds them.

        If they cannot be stored for `recordings_first_seconds`, or the server ends (`hurry`), the answer does not wait
        any longer. An answer that is there already stays as it is. None in a session: each member's own answer follows
        (`save_member`).
        """
        await self._store_recordings_first()
        settings, now = self._settings, datetime.now(UTC)
        if answers is not None:
            await self._create(settings.user_id, Answer(self._step, GAME, settings.group, now, answers))

    def hurry(self) -> None:
        """The server ends soon: an answer waits for recordings no longer."""
        self._hurried.set()

    @property
    def storing(self) -> bool:
        """There is a recording that is closed and not stored."""
        return any(not task.done() for task in self._uploads)

    async def stored(self) -> None:
        """Wait until all closed recordings are stored."""
        if self._uploads:
            await asyncio.wait(self._uploads)

    async def _store_recordings_first(self) -> None:
        if not self.storing:
            return
        until = [asyncio.create_task(self.stored()), asyncio.create_task(self._hurried.wait())]
        limit = self._settings.recordings_first_seconds
        await asyncio.wait(until, timeout=limit, return_when=asyncio.FIRST_COMPLETED)
        for task in until:
            task.cancel()
        if self.storing:
            log.error("a recording is not stored yet; the answer does not wait for it")

    async def save_member(
        self, user_id: str, answers: Mapping[str, Any], later: Mapping[str, Any] | None = None
    ) -> None:
        """Store the answer of a member of a session. One that is there already stays as it is.

        `later` is the answer of each later game step, if they are out of those, too. It is stored first: a member whose
        own step has its answer goes on, and comes to no game that does not take them.
        """
        settings = self._settings
        group = next((member.group for member in settings.members if member.user_id == user_id), None)
        following = settings.game_steps[settings.game_steps.index(self._step) + 1 :] if later is not None else ()
        for step, said in (*((step, later or {}) for step in following), (self._step, answers)):
            found = {**said, "session": settings.session}
            await self._create(user_id, Answer(step, GAME, group, datetime.now(UTC), found))

    async def _create(self, user_id: str, answer: Answer) -> None:
        key, data = answer_key(self._settings.project_id, user_id, answer.step), to_json(answer)
        await retry_forever("write the answer", lambda: asyncio.to_thread(self._store.create, key, data))


def _whose(settings: TrialSettings) -> dict[str, Any]:
    """Whose recording it is. No participant's id stands in that of a session."""
    return {"sessionId": settings.session, "group": settings.group} if settings.session else {"user": settings.user_id}


def rules(config: TrialSection, players: Sequence[Player]) -> dict[str, Any]:
    """By which rules several players act: what is needed to take the steps of a recording again.

    `idleActions` are the numbers that the environment was given for players whose `action` is null.
    """
    return {
        "pace": config.pace,
        "input": config.input,
        "frameSkip": config.frame_skip,
        "idleActions": {player.name: player.idle for player in players},
    }


def _with_actions(players: Mapping[str, Any], opening: OpenRecording) -> dict[str, Any]:
    """What is said of each player, with its actions if they are others than those of the first human."""
    spaces = {player.name: player.action_space for player in opening.players}
    return {
        name: {**said, **({} if spaces[name] == opening.action_space else {"actionSpace": list(spaces[name])})}
        for name, said in players.items()
    }
