"""Fetches new and changed files (`listing.py`) from the source into the folder, for several participants at once.

A file appears under its name whole or not at all, and only then the state records it. So an interrupted run can be
continued.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import time
import uuid
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hippodrome.export import keys, recording, scrub, talk
from hippodrome.export.interruption import interruption
from hippodrome.export.keys import Item, KeyKind
from hippodrome.export.listing import Members, Tally, Unit, Wanted, choose, lines, members, units, version_of
from hippodrome.export.recording_columns import when
from hippodrome.export.source import PARALLEL, FileGone, Source, TooLarge
from hippodrome.export.state import ExportedFile, ExportedParticipant, ExportState, SourceFile
from hippodrome.protocol import session as sessions
from hippodrome.protocol.session import is_session_id

MAX_WAITING = 4 * PARALLEL  # participants and sessions whose files are being fetched
COMMIT_EVERY = 2  # seconds; after a power cut, the work of these seconds may have to be repeated
MAX_PIECE = 256 * 1024 * 1024  # bytes; a piece holds what was said, and a model's answers, of two seconds
MAX_DOCUMENT = 4 * 1024 * 1024  # bytes; next_step accepts answers of 256 KB


@dataclass
class Work:
    """The files of one participant or one session that a worker fetches."""

    user: str  # the id of the participant or of the session; "" for files of neither
    owner: ExportedParticipant | Members | None
    fetch: list[Item]
    unchanged: list[str]  # keys
    then: Unit | None = None  # the session's other files, which are fetched after its document is read


class Fetcher:
    """Fetches and converts files with several workers. `progress` is called with the number of listed files, and how
    many of them are done. `damaged` are paths in the folder whose files have changed or are missing."""

    def __init__(
        self,
        project: str,
        *,
        source: Source,
        state: ExportState,
        folder: Path,
        wanted: Wanted,
        progress: Callable[[int, int], None],
        damaged: frozenset[str],
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
        """Bring the folder up to date, and return what was done. If this raises, the state has the files so far."""
        tally = Tally()
        self.incoming.mkdir(parents=True, exist_ok=True)
        for left in self.incoming.iterdir():
            left.unlink()
        self._state.begin_run()
        with self._state.in_transactions() as commit, interruption() as check:
            self._all(tally, commit, check)
        return tally

    def _all(self, tally: Tally, commit: Callable[[], None], check: Callable[[], None]) -> None:
        """Fetch and save all files. `check` is called often, and may raise KeyboardInterrupt."""
        running: dict[Future[list[SourceFile]], Work] = {}
        committed = time.monotonic()
        pool = ThreadPoolExecutor(PARALLEL, thread_name_prefix="data")

        def begin(work: Work) -> None:
            if work.fetch:
                running[pool.submit(self._fetch, work)] = work
            else:
                self._save(work, [])
                follow(work)

        def follow(work: Work) -> None:
            if work.then is not None:
                begin(self._work(work.then, tally, members(self._state, work.then.user)))

        def collect() -> None:
            for work in self._collect(running, check):
                follow(work)

        try:
            for unit in units(self._project, lines(self._source, self._project, self._state)):
                while unit.is_session and any(isinstance(work.owner, ExportedParticipant) for work in running.values()):
                    collect()  # the participants of a session must be known first
                check()
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
                    self._save(work, future.result())
            raise
        pool.shutdown()

    def _work(self, unit: Unit, tally: Tally, known: Members | None = None) -> Work:
        """The work for a unit. A session has two: first its document alone; its other files once its members are
        `known`."""
        owner: ExportedParticipant | Members | None = known
        then = None
        if unit.is_session and known is None:
            document = [item for item in unit.items if item.kind is KeyKind.SESSION]
            others = [item for item in unit.items if item.kind is not KeyKind.SESSION]
            owner, unit, then = Members(unit.user), Unit(unit.user, document), Unit(unit.user, others)
        elif unit.user and known is None:
            owner = self._state.find_or_add(unit.user, self._wanted.apart)
        mark = known.mark if known else ""
        fetch, unchanged = choose(self._state, unit, self._wanted, tally, self._damaged, mark=mark)
        self._listed += len(unit.items)
        self._done += len(unchanged)
        self._progress(self._listed, self._done)
        return Work(unit.user, owner, fetch, unchanged, then)

    def _collect(self, running: dict[Future[list[SourceFile]], Work], check: Callable[[], None]) -> list[Work]:
        done: set[Future[list[SourceFile]]] = set()
        while not done:
            check()
            done, _ = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
        collected = []
        for future in done:
            files = future.result()  # `result` may raise; then `_all` saves the results of the other workers
            work = running.pop(future)
            self._save(work, files)
            self._done += len(work.fetch)
            collected.append(work)
        self._progress(self._listed, self._done)
        return collected

    def _save(self, work: Work, files: list[SourceFile]) -> None:
        """Save the files in the state, and remove their earlier versions from the folder."""
        before = self._state.files_of(work.user) if files else {}
        self._state.save(work.user, work.unchanged, files)
        for file in files:
            old = before.get(file.key)
            for path, now in ((old.path, file.made), (old.raw, file.raw)) if old else ():
                if path and (now is None or now.path != path):
                    (self._folder / path).unlink(missing_ok=True)

    # -- in the workers

    def _fetch(self, work: Work) -> list[SourceFile]:
        made = []
        owner = work.owner
        for item in work.fetch:  # participant.json comes first
            mark = owner.mark if isinstance(owner, Members) else ""
            file = SourceFile(item.listed.key, item.kind, version_of(item, mark), item.listed.size, step=item.step)
            try:
                if item.kind is KeyKind.FOREIGN or owner is None:
                    file.problems.append(f"no file of Hippodrome: {item.why}")
                elif item.kind is KeyKind.RECORDING:
                    self._recording(item, owner, file)
                elif item.kind is KeyKind.TAPE:
                    self._tape(item, owner, file)
                else:
                    self._document(item, owner, file)
            except FileGone:
                continue  # the next run lists its new version, if there is one
            if isinstance(owner, ExportedParticipant):  # the participant's later files are read with what these say
                if item.kind is KeyKind.PARTICIPANT:
                    owner = owner._replace(document=file.document or {})
                elif item.kind is KeyKind.MEMBERSHIP:
                    owner = owner._replace(membership=file.document or {})
            made.append(file)
        return made

    def _document(self, item: Item, owner: ExportedParticipant | Members, file: SourceFile) -> None:
        try:
            body = self._source.read(item.listed.key, MAX_DOCUMENT)
        except TooLarge:
            file.problems.append(f"it is larger than {MAX_DOCUMENT:,} bytes and was not read")
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

    def _tape(self, item: Item, owner: ExportedParticipant | Members, file: SourceFile) -> None:
        try:
            body = self._source.read(item.listed.key, MAX_PIECE)
        except TooLarge:
            file.problems.append(f"it is larger than {MAX_PIECE:,} bytes and was not read")
            return
        if self._wanted.raw:
            file.raw = self._put(body, f"private/raw/{_folder(owner)}/trials/{item.server}/{item.name}")
        identities = scrub.identities(owner) if isinstance(owner, ExportedParticipant) else dict(owner.identities)
        hide = scrub.Scrub(identities if self._wanted.apart else {})
        attempt = keys.attempt(self._project, item.user, item.server)
        where: dict[str, Any] = {"step": item.step, "attempt": attempt, "session": None}
        people: Mapping[int, str] = {}
        if isinstance(owner, Members):
            where["session"], people = owner.session, owner.people
        try:
            file.document = talk.document(json.loads(body), where, people, hide)
        except (ValueError, AttributeError, RecursionError):
            file.problems.append("it is no piece of a tape that this version can read")

    def _recording(self, item: Item, owner: ExportedParticipant | Members, file: SourceFile) -> None:
        attempt = keys.attempt(self._project, item.user, item.server)
        place = str(attempt) if attempt is not None else f"other-{self._token(item.server)}"
        if isinstance(owner, ExportedParticipant):
            column, identities, people = {"participant": owner.number}, scrub.identities(owner), None
        else:
            column, identities, people = {"session": owner.session}, dict(owner.identities), owner.people
        folder, label = _folder(owner), item.server.rpartition("-")[0]
        servers = {item.server: place} | ({label: "(server)"} if label else {})
        hide = scrub.Scrub(identities, servers) if self._wanted.apart else scrub.Scrub({})
        packed, made = self._temporary(), self._temporary()
        try:
            self._source.fetch(item.listed, packed)
            constants = {**column, "studyStep": item.step, "attempt": attempt}
            converted = recording.convert(packed, made, constants, hide, shown=not self._wanted.apart, people=people)
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
        """A token in the place of a server's name that Hippodrome has not made, and that may identify someone."""
        salt = (self._folder / "private" / "salt").read_bytes()
        return hashlib.blake2b(server.encode(), key=salt, digest_size=5).hexdigest()

    def _temporary(self) -> Path:
        return self.incoming / f"{uuid.uuid4().hex}.part"

    def _put(self, body: bytes, path: str) -> ExportedFile:
        written = self._temporary()
        written.write_bytes(body)
        return self._move(written, path)

    def _move(self, file: Path, path: str) -> ExportedFile:
        """Move a finished file to its path in the folder."""
        size, digest = file.stat().st_size, sha256(file)
        target = self._folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, target)
        return ExportedFile(path, size, digest)


def _folder(owner: ExportedParticipant | Members) -> str:
    """The name of a participant's or a session's folder in the export folder."""
    return owner.folder if isinstance(owner, ExportedParticipant) else owner.session


def forget_gone(state: ExportState, folder: Path) -> int:
    """Remove the files that the source does not have any more, such as the files of an erased participant; return how
    many there were."""
    count = 0
    with state.in_transactions():
        for key, user, kind, path, raw in state.unseen():
            for old in filter(None, (path, raw)):
                (folder / old).unlink(missing_ok=True)
                remove_empty((folder / old).parent, folder)
            state.forget(key, user, kind)
            count += 1
        state.forget_participants()
    return count


def remove_empty(empty: Path, top: Path) -> None:
    """Remove this folder if it is empty, and then the empty folders above it, up to `top`, which stays."""
    with contextlib.suppress(OSError):  # the folder is not empty
        while empty != top:
            empty.rmdir()
            empty = empty.parent


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hex digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _doubts(item: Item, found: dict[str, Any]) -> list[str]:
    """The differences between a document and its description in `docs/data.md`. The export uses the valid parts."""
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
        session = found.get("session")
        return doubts if session is None or is_session_id(session) else [*doubts, "session is no id of a session"]
    if item.kind is KeyKind.SESSION:
        try:
            sessions.parse(json.dumps(found).encode())
        except sessions.BadSession as bad:
            doubts.append(str(bad))
        return doubts
    if item.step in (keys.ASSIGNED, keys.ENDED):
        return doubts
    if not isinstance(found.get("answers"), dict):
        doubts.append("answers is no object")
    if when(found.get("answered")) is None:
        doubts.append("answered is no time")
    if found.get("step") != item.step.partition(".")[0]:
        doubts.append("step is not the one in the file's name")
    return doubts
