"""Writes and stores the recordings and answers of one trial, on the event loop. None is lost or overwritten."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import tempfile
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from hippodrome.protocol.answer import GAME, Answer, answers_in, to_json
from hippodrome.protocol.keys import answer_key, with_number
from hippodrome.protocol.trial import TrialSection
from hippodrome.trial.core.effects import OpenRecording
from hippodrome.trial.core.history import RecordedTrial
from hippodrome.trial.core.players import Player
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.recording import Recording
from hippodrome.trial.recordings.resume import load_recorded
from hippodrome.trial.recordings.store import FolderStore, Store, retry_forever, short_error, store_file
from hippodrome.trial.recordings.tape import Tape
from hippodrome.trial.settings import TrialSettings

log = logging.getLogger("trial")

FLUSH_SECONDS = 0.5
"""The time within which lines are written to the file: a process that is killed loses at most so much play."""


class Recorder:
    """Writes the recordings and answers of one trial, and reads what earlier servers of the step have written."""

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

    @cached_property
    def tape(self) -> Tape:
        """The tape of what is said."""
        return Tape(self._settings, self._step, self._store, kept=not self._spool.local_only)

    # ---- before

    async def earlier_answers(self) -> dict[str, Any] | None:
        """Return the participant's answer of this step, which an earlier server has stored; None if there is none."""
        return await self._earlier_answer(self._settings.user_id)

    async def members_answers(self) -> dict[str, Any]:
        """Return the stored answers of this step, by the members' ids.

        The step is over if each member has one. If a server was lost between two answers, it had stored all recordings
        before, and the next server stores the missing answers. The answer of a member who was refused in an earlier
        game was stored then.
        """
        answers = {user_id: await self._earlier_answer(user_id) for user_id in self._settings.seats}
        return {user_id: answer for user_id, answer in answers.items() if answer is not None}

    async def _earlier_answer(self, user_id: str) -> dict[str, Any] | None:
        try:
            body = await asyncio.to_thread(self._store.get, answer_key(self._settings.project_id, user_id, self._step))
        except Exception as error:  # noqa: BLE001 - any error of the store: no write will replace an answer anyway
            log.warning("cannot look for an earlier answer (%s)", short_error(error))
            return None
        return None if body is None else answers_in(body) or {}

    async def recorded(self) -> RecordedTrial | None:
        """Return what earlier servers have recorded of the step; None if there is nothing or it cannot be read."""
        folder, _, server = self._settings.recordings_folder.rpartition("/")
        try:
            return await asyncio.to_thread(load_recorded, self._store, folder, server, self._step)
        except Exception as error:  # noqa: BLE001 - any error of the store or of a recording: the step is played anew
            log.warning("cannot look for earlier recordings (%s)", short_error(error))
            return None

    # ---- recordings

    def stamp(self) -> dict[str, Any]:
        """Return the fields with which each line begins. May be called on any thread."""
        return {
            "v": recording.SCHEMA,
            "server": self._settings.server,
            "trial": self._trial_id,
            "time": datetime.now(UTC),
            "ns": time.monotonic_ns(),
        }

    @property
    def is_open(self) -> bool:
        """Whether a recording is open, to which lines can be written."""
        return self._recording is not None

    def open(self, opening: OpenRecording, players: Mapping[str, Any], action_starts: Mapping[str, int]) -> None:
        """Open a recording and write its header. Raises OSError.

        `players` describes who plays each player, if there are several (`Places.described`); else it is empty.
        `action_starts` are the environment's numbers of the players' action 0, where they are not 0.
        """
        settings, config = self._settings, self._settings.trial
        name = "trial" if config.data_file == "trial" else f"episode-{opening.episode:04d}"
        self._recording = self._spool.open(f"{settings.recordings_folder}/{self._step}-{name}.jsonl.gz")
        header = recording.line(
            "header",
            **self.stamp(),
            project=settings.project_id,
            **_whose(settings),
            step=self._step,
            game=config.game,
            actionSpace=list(opening.action_space),
            **({"actionStart": dict(action_starts)} if action_starts else {}),
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
        """Build a line of this kind, with the fields of `stamp`."""
        return recording.line(kind, **self.stamp(), **fields)

    def write(self, line: bytes) -> None:
        """Write a line. It is in the file within `FLUSH_SECONDS`. Without an open recording it is dropped."""
        if self._recording is None:
            return
        self._recording.add(line)
        if self._flush_timer is None:
            self._flush_later()

    def close(self) -> None:
        """Close the recording if one is open, and store it in the background."""
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
        """Store the answer after all recordings, so that a reader who finds the answer finds the recordings, too.

        The answer waits for `recordings_first_seconds` at most, and not after `hurry`. An answer that exists is not
        changed. `answers` is None in a session, where each member's own answer follows (`save_member`), or if there is
        no answer.
        """
        await self._store_recordings_first()
        settings, now = self._settings, datetime.now(UTC)
        if answers is not None:
            await self._create(settings.user_id, Answer(self._step, GAME, settings.group, now, answers))

    def hurry(self) -> None:
        """Let no answer wait for recordings any longer, because the server ends soon."""
        self._hurried.set()

    @property
    def storing(self) -> bool:
        """Whether a recording is closed, or something was said, and it is not stored yet."""
        return self.tape.storing or any(not task.done() for task in self._uploads)

    async def stored(self) -> None:
        """Wait until all closed recordings, and what was said, are stored."""
        await self.tape.stored()
        if self._uploads:
            await asyncio.wait(self._uploads)

    async def _store_recordings_first(self) -> None:
        if not self.storing:
            return
        waits = [asyncio.create_task(self.stored()), asyncio.create_task(self._hurried.wait())]
        limit = self._settings.recordings_first_seconds
        await asyncio.wait(waits, timeout=limit, return_when=asyncio.FIRST_COMPLETED)
        for task in waits:
            task.cancel()
        if self.storing:
            log.error("a recording is not stored yet; the answer does not wait for it")

    async def save_member(
        self, user_id: str, answers: Mapping[str, Any], later: Mapping[str, Any] | None = None
    ) -> None:
        """Store the answer of a member of a session. An answer that exists is not changed.

        `later` is the answer of each later game step, if the member does not play them either. These answers are stored
        first: as soon as the present step has its answer, the member goes on, and must not come to a later game.
        """
        settings = self._settings
        group = next((member.group for member in settings.members if member.user_id == user_id), None)
        following = settings.game_steps[settings.game_steps.index(self._step) + 1 :] if later is not None else ()
        for step, values in (*((step, later or {}) for step in following), (self._step, answers)):
            stored = {**values, "session": settings.session}
            await self._create(user_id, Answer(step, GAME, group, datetime.now(UTC), stored))

    async def _create(self, user_id: str, answer: Answer) -> None:
        key, data = answer_key(self._settings.project_id, user_id, answer.step), to_json(answer)
        await retry_forever("write the answer", lambda: asyncio.to_thread(self._store.create, key, data))


def _whose(settings: TrialSettings) -> dict[str, Any]:
    """Return the fields that say whose recording it is. The recording of a session contains no participant's id."""
    return {"session": settings.session, "group": settings.group} if settings.session else {"userId": settings.user_id}


def rules(config: TrialSection, players: Sequence[Player]) -> dict[str, Any]:
    """Return the fields of the header about the rules by which several players act: a replay needs them.

    `idleActions`: the numbers of the actions that the environment was given for players whose `action` is null.
    """
    return {
        "pace": config.pace,
        "input": config.input,
        "frameSkip": config.frame_skip,
        "policyActions": "held" if config.policies_hold else "single",
        "idleActions": {player.name: player.idle for player in players},
    }


def _with_actions(players: Mapping[str, Any], opening: OpenRecording) -> dict[str, Any]:
    """Add to each player's description the names of its actions, if they differ from the first human's."""
    spaces = {player.name: player.action_space for player in opening.players}
    return {
        name: {**described, **({} if spaces[name] == opening.action_space else {"actionSpace": list(spaces[name])})}
        for name, described in players.items()
    }


class Spool:
    """The folder where recordings are written before they are stored: SPOOL, the store's folder, or a temporary one."""

    def __init__(self, settings: TrialSettings, store: Store) -> None:
        self.local_only = not settings.trial.s3upload
        if settings.spool is not None:
            self.folder = settings.spool
        elif isinstance(store, FolderStore) and not self.local_only:
            self.folder = store.folder
        else:
            self.folder = Path(tempfile.mkdtemp(prefix="trial-"))

    def open(self, key: str) -> Recording:
        """Open a new recording for this key; for the key with a number if the key has a recording. Raises OSError."""
        for number in range(1, 100):
            numbered = with_number(key, number)
            path = self.folder / f"{numbered}.part"
            if (self.folder / numbered).exists():
                continue
            with contextlib.suppress(FileExistsError):
                return Recording(path, numbered)
        raise FileExistsError(key)

    def leftovers(self, prefix: str) -> list[tuple[str, Path]]:
        """Return the recordings with this prefix that a killed process has left here: their keys and paths.

        Those in which nothing was written are deleted.
        """
        leftovers = []
        for path in sorted((self.folder / prefix).glob("*.jsonl.gz.part")):
            if path.stat().st_size == 0:  # the disk was full, or the process was killed in its first half second
                path.unlink()
            else:
                leftovers.append((f"{prefix}/{path.name.removesuffix('.part')}", path))
        return leftovers
