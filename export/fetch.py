"""From the source into the folder: what is new or changed (`listing.py`), a participant at a time, several at once.

A file appears under its name whole or not at all, and is written down only then: whatever cuts a run off, the next one
goes on from there.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import time
import uuid
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from export import keys, recording, scrub
from export.keys import Item, KeyKind
from export.listing import Members, Tally, Unit, Wanted, choose, lines, members, units, version_of
from export.recording_columns import when
from export.source import PARALLEL, FileGone, Source, TooLarge
from export.state import ExportedParticipant, ExportState, File, Kept
from protocol import session as sessions
from protocol.session import is_session_id

MAX_WAITING = 4 * PARALLEL  # participants listed and not yet written down
COMMIT_EVERY = 2  # seconds: as much work may have to be done again after a power cut
LARGEST_DOCUMENT = 4 * 1024 * 1024  # bytes; next_step takes answers of 256 KB


@dataclass
class Work:
    """What one worker is to fetch for one participant or one session."""

    owner: ExportedParticipant | Members | None
    fetch: list[Item]
    seen: list[str]
    then: Unit | None = None  # what follows when the session's own document is here

    @property
    def user(self) -> str:
        """The id of the participant or of the session."""
        match self.owner:
            case ExportedParticipant(user=user):
                return user
            case Members(session=session):
                return session
        return ""


class Fetcher:
    """Workers that fetch and convert. `progress` is told how many files are known of and how many are done."""

    def __init__(
        self,
        project: str,
        *,
        source: Source,
        state: ExportState,
        folder: Path,
        wanted: Wanted,
        progress: Callable[[int, int], None],
        damaged: frozenset[str] = frozenset(),
    ) -> None:
        self._project = project
        self._source = source
        self._state = state
        self._folder = folder
        self._wanted = wanted
        self._progress = progress
        self._damaged = damaged
        self._listed = self._done = 0
        self.incoming = folder / "private" / "incoming"

    def run(self) -> Tally:
        """Bring the folder up to date. Whatever is raised, what was done so far is written down."""
        tally = Tally()
        self.incoming.mkdir(parents=True, exist_ok=True)
        for left in self.incoming.iterdir():
            left.unlink()
        self._state.begin_run()
        with self._state.in_transactions() as commit:
            self._all(tally, commit)
        return tally

    def _all(self, tally: Tally, commit: Callable[[], None]) -> None:
        running: dict[Future[list[File]], Work] = {}
        committed = time.monotonic()
        pool = ThreadPoolExecutor(PARALLEL, thread_name_prefix="data")

        def begin(work: Work) -> None:
            if work.fetch:
                running[pool.submit(self._fetch, work)] = work
            else:
                self._keep(work, [])
                follow(work)

        def follow(work: Work) -> None:
            if work.then is not None:
                begin(self._work(work.then, tally, members(self._state, work.then.user)))

        def collect() -> None:
            for work in self._collect(running):
                follow(work)

        try:
            for unit in units(self._project, lines(self._source, self._project, self._state)):
                while unit.is_session and any(isinstance(work.owner, ExportedParticipant) for work in running.values()):
                    collect()  # who plays there has to be known first
                begin(self._work(unit, tally))
                while len(running) >= MAX_WAITING:
                    collect()
                if time.monotonic() - committed > COMMIT_EVERY:
                    commit()
                    committed = time.monotonic()
            while running:
                collect()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            for future, work in running.items():
                if future.done() and not future.cancelled() and future.exception() is None:
                    self._keep(work, future.result())
            raise
        pool.shutdown()

    def _work(self, unit: Unit, tally: Tally, known: Members | None = None) -> Work:
        """What is to be done for a unit. Of a session first its own document; the rest when its members are `known`."""
        owner: ExportedParticipant | Members | None = known
        then = None
        if unit.is_session and known is None:
            about, rest = list[Item](), list[Item]()
            for item in unit.items:
                (about if item.kind is KeyKind.SESSION else rest).append(item)
            owner, unit, then = Members(unit.user), Unit(unit.user, about), Unit(unit.user, rest)
        elif unit.user and known is None:
            owner = self._state.find_or_add(unit.user, self._wanted.apart)
        mark = known.mark if known else ""
        fetch, seen = choose(self._state, unit, self._wanted, tally, self._damaged, mark=mark)
        self._listed += len(unit.items)
        self._done += len(seen)
        self._progress(self._listed, self._done)
        return Work(owner, fetch, seen, then)

    def _collect(self, running: dict[Future[list[File]], Work]) -> list[Work]:
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        collected = []
        for future in done:
            files = future.result()  # raises what the worker did not expect; the others are kept by `run`
            work = running.pop(future)
            self._keep(work, files)
            self._done += len(work.fetch)
            collected.append(work)
        self._progress(self._listed, self._done)
        return collected

    def _keep(self, work: Work, files: list[File]) -> None:
        user = work.user
        before = self._state.files_of(user) if files else {}
        self._state.keep(user, work.seen, files)
        for file in files:
            old = before.get(file.key)
            for path, now in ((old.path, file.made), (old.raw, file.raw)) if old else ():
                if path and (now is None or now.path != path):
                    (self._folder / path).unlink(missing_ok=True)

    # -- in the workers

    def _fetch(self, work: Work) -> list[File]:
        made = []
        owner = work.owner
        for item in work.fetch:  # participant.json comes first
            mark = owner.mark if isinstance(owner, Members) else ""
            file = File(item.listed.key, item.kind, version_of(item, mark), item.listed.size, step=item.step)
            try:
                if item.kind is KeyKind.FOREIGN or owner is None:
                    file.problems.append(f"not one of ours: {item.why}")
                elif item.kind is KeyKind.RECORDING:
                    self._recording(item, owner, file)
                else:
                    self._document(item, owner, file)
            except FileGone:
                continue  # the next run sees what has become of it
            if isinstance(owner, ExportedParticipant) and item.kind is KeyKind.PARTICIPANT:
                owner = owner._replace(document=file.document or {})
            if isinstance(owner, ExportedParticipant) and item.kind is KeyKind.MEMBERSHIP:
                owner = owner._replace(membership=file.document or {})
            made.append(file)
        return made

    def _document(self, item: Item, owner: ExportedParticipant | Members, file: File) -> None:
        try:
            body = self._source.read(item.listed.key, LARGEST_DOCUMENT)
        except TooLarge:
            file.problems.append(f"it is larger than {LARGEST_DOCUMENT:,} bytes and was not read")
            return
        if self._wanted.raw:
            parts = item.listed.key.split("/")[3:]
            file.raw = self._put(body, f"private/raw/{'/'.join([_folder(owner), *parts])}")
        try:
            found = json.loads(body)
        except (ValueError, RecursionError):
            file.problems.append("it is no JSON")
            return
        if not isinstance(found, dict):
            file.problems.append("it is no JSON object")
            return
        file.document = found
        file.problems += _doubts(item, found)

    def _recording(self, item: Item, owner: ExportedParticipant | Members, file: File) -> None:
        attempt = keys.attempt(self._project, item.user, item.server)
        place = str(attempt) if attempt is not None else f"other-{self._token(item.server)}"
        if isinstance(owner, ExportedParticipant):
            whose, theirs, people = {"participant": owner.number}, scrub.identities(owner), None
        else:
            whose, theirs, people = {"session": owner.session}, dict(owner.identities), owner.people
        folder, names = _folder(owner), theirs | {item.server: place}
        label = item.server.rpartition("-")[0]
        hide = scrub.Scrub(names | ({label: "(server)"} if label else {})) if self._wanted.apart else scrub.nothing()
        packed, made = self._temporary(), self._temporary()
        try:
            self._source.fetch(item.listed, packed)
            who = {**whose, "studyStep": item.step, "attempt": attempt}
            converted = recording.convert(packed, made, who, hide, shown=not self._wanted.apart, people=people)
            path = f"recordings/{folder}/{place}/{item.name}.parquet"
            file.made = self._move(made, path)
            if self._wanted.raw:
                file.raw = self._move(packed, f"private/raw/{folder}/trials/{item.server}/{item.name}.jsonl.gz")
        finally:
            packed.unlink(missing_ok=True)
            made.unlink(missing_ok=True)
        file.frames, file.problems = converted.frames, converted.problems
        file.episodes += [{**episode, "step": item.step, "attempt": attempt} for episode in converted.episodes]

    def _token(self, server: str) -> str:
        """Stands for a server's name that says nothing to us; it may say something to others."""
        return hashlib.blake2b(server.encode(), key=self._salt, digest_size=5).hexdigest()

    @property
    def _salt(self) -> bytes:
        return (self._folder / "private" / "salt").read_bytes()

    def _temporary(self) -> Path:
        return self.incoming / f"{uuid.uuid4().hex}.part"

    def _put(self, body: bytes, path: str) -> Kept:
        written = self._temporary()
        written.write_bytes(body)
        return self._move(written, path)

    def _move(self, file: Path, path: str) -> Kept:
        """Give a whole file its name."""
        size, digest = file.stat().st_size, sha256(file)
        target = self._folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, target)
        return Kept(path, size, digest)


def _folder(owner: ExportedParticipant | Members) -> str:
    """The name of a participant's or a session's folder among ours."""
    return owner.folder if isinstance(owner, ExportedParticipant) else owner.session


def forget_gone(state: ExportState, folder: Path) -> int:
    """Remove here what is gone from the source, such as an erased participant. Return how many files that were."""
    count = 0
    with state.in_transactions():
        for key, user, kind, step, path, raw in state.unseen():
            for old in filter(None, (path, raw)):
                (folder / old).unlink(missing_ok=True)
                remove_empty((folder / old).parent, folder)
            state.forget(key, user, kind, step)
            count += 1
        state.forget_participants()
    return count


def remove_empty(empty: Path, top: Path) -> None:
    """Remove this folder and those above it that are empty then, up to `top`, which stays."""
    with contextlib.suppress(OSError):  # not empty
        while empty != top:
            empty.rmdir()
            empty = empty.parent


def sha256(path: Path) -> str:
    """The SHA-256 of a file, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _doubts(item: Item, found: dict[str, Any]) -> list[str]:
    """What is not as `docs/data.md` says. The document is used as far as it goes."""
    doubts = []
    group = found.get("group")
    if group is not None and (not isinstance(group, int) or isinstance(group, bool)):
        doubts.append("group is no whole number")
    if item.kind is KeyKind.PARTICIPANT:
        if when(found.get("arrived")) is None:
            doubts.append("arrived is no time")
        if not isinstance(found.get("link", {}), dict):
            doubts.append("link is no object")
        return doubts
    if item.kind is KeyKind.MEMBERSHIP:
        known = found.get("session")
        return doubts if known is None or is_session_id(known) else [*doubts, "session is the id of none"]
    if item.kind is KeyKind.SESSION:
        try:
            sessions.parse(json.dumps(found).encode())
        except sessions.BadSession as bad:
            doubts.append(str(bad))
        return doubts
    if not isinstance(found.get("answers"), dict):
        doubts.append("answers is no object")
    if when(found.get("answered")) is None:
        doubts.append("answered is no time")
    if found.get("step") != item.step:
        doubts.append("step is another one than the file's name says")
    return doubts
