"""From the source into the folder: what is new or changed, a participant at a time, several at once.

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
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from export import keys, recording, scrub
from export.keys import Item, Kind, Listed
from export.source import PARALLEL, Gone, Source, TooLarge
from export.state import File, Kept, Person, State

MAX_WAITING = 4 * PARALLEL  # participants listed and not yet written down
COMMIT_EVERY = 2  # seconds: as much work may have to be done again after a power cut
LARGEST_DOCUMENT = 4 * 1024 * 1024  # bytes; next_step takes answers of 256 KB
_PIECE = 1024 * 1024  # bytes


class Wanted(NamedTuple):
    """What a run is to bring."""

    recordings: bool = True
    raw: bool = False
    apart: bool = False


class Unit(NamedTuple):
    """All that the source has of one participant; of the project itself where `user` is empty."""

    user: str
    items: list[Item]


@dataclass
class Tally:
    """What a run did, or would do."""

    participants: int = 0
    new: int = 0
    changed: int = 0
    unchanged: int = 0
    gone: int = 0
    bytes: int = 0
    damaged: int = 0

    @property
    def to_fetch(self) -> int:
        return self.new + self.changed


@dataclass
class Work:
    """What one worker is to fetch for one participant."""

    person: Person | None
    fetch: list[Item]
    seen: list[str]
    leave: list[str] = field(default_factory=list)  # paths that are replaced or gone


def units(project: str, listed: Iterable[Listed]) -> Iterator[Unit]:
    """The listing by participant; theirs stand together, in any order."""
    user, items = "", list[Item]()
    for line in listed:
        item = keys.read(project, line)
        if item.user != user or (not user and len(items) >= 1000):
            if items:
                yield Unit(user, items)
            user, items = item.user, []
        items.append(item)
    if items:
        yield Unit(user, items)


def choose(
    state: State, unit: Unit, wanted: Wanted, tally: Tally, damaged: frozenset[str]
) -> tuple[list[Item], list[str]]:
    """What of a unit has to be fetched, and the keys that may stay as they are. `damaged` are paths of ours."""
    known = state.files_of(unit.user)
    fetch, seen = [], []
    everything = False
    for item in sorted(unit.items, key=lambda item: item.kind is not Kind.PARTICIPANT):
        before = known.get(item.listed.key)
        skipped = item.kind is Kind.RECORDING and not wanted.recordings
        same = (
            before is not None
            and before.version == item.listed.version
            and not everything
            and damaged.isdisjoint((before.path, before.raw))
        )
        raw_missing = wanted.raw and item.kind is not Kind.FOREIGN and (before is None or before.raw is None)
        if skipped or (same and not raw_missing):
            tally.unchanged += 1
            seen.append(item.listed.key)
            continue
        tally.new, tally.changed = tally.new + (before is None), tally.changed + (before is not None)
        tally.bytes += item.listed.size if item.kind is not Kind.FOREIGN else 0
        fetch.append(item)
        # With another participant.json a participant has other identities, which must leave all their files.
        everything = everything or (item.kind is Kind.PARTICIPANT and wanted.apart)
    tally.participants += bool(unit.user)
    return fetch, seen


class Fetcher:
    """Workers that fetch and convert. `progress` is told how many files are known of and how many are done."""

    def __init__(
        self,
        project: str,
        *,
        source: Source,
        state: State,
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
        with self._state.together() as commit:
            self._all(tally, commit)
        return tally

    def _all(self, tally: Tally, commit: Callable[[], None]) -> None:
        running: dict[Future[list[File]], Work] = {}
        committed = time.monotonic()
        pool = ThreadPoolExecutor(PARALLEL, thread_name_prefix="data")
        try:
            for unit in units(self._project, self._source.list(keys.prefix(self._project))):
                work = self._work(unit, tally)
                if work.fetch:
                    running[pool.submit(self._fetch, work)] = work
                else:
                    self._keep(work, [])
                while len(running) >= MAX_WAITING:
                    self._collect(running)
                if time.monotonic() - committed > COMMIT_EVERY:
                    commit()
                    committed = time.monotonic()
            while running:
                self._collect(running)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            for future, work in running.items():
                if future.done() and not future.cancelled() and future.exception() is None:
                    self._keep(work, future.result())
            raise
        pool.shutdown()

    def _work(self, unit: Unit, tally: Tally) -> Work:
        person = self._state.meet(unit.user, self._wanted.apart) if unit.user else None
        fetch, seen = choose(self._state, unit, self._wanted, tally, self._damaged)
        self._listed += len(unit.items)
        self._done += len(seen)
        self._progress(self._listed, self._done)
        return Work(person, fetch, seen)

    def _collect(self, running: dict[Future[list[File]], Work]) -> None:
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            files = future.result()  # raises what the worker did not expect; the others are kept by `run`
            work = running.pop(future)
            self._keep(work, files)
            self._done += len(work.fetch)
        self._progress(self._listed, self._done)

    def _keep(self, work: Work, files: list[File]) -> None:
        user = work.person.user if work.person else ""
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
        document = work.person.document if work.person else {}
        for item in work.fetch:  # participant.json comes first
            file = File(item.listed.key, item.kind, item.listed.version, item.listed.size, step=item.step)
            try:
                if item.kind is Kind.FOREIGN or work.person is None:
                    file.problems.append(f"not one of ours: {item.why}")
                elif item.kind is Kind.RECORDING:
                    self._recording(item, work.person, document, file)
                else:
                    self._document(item, work.person, file)
            except Gone:
                continue  # the next run sees what has become of it
            if item.kind is Kind.PARTICIPANT:
                document = file.document or {}
            made.append(file)
        return made

    def _document(self, item: Item, person: Person, file: File) -> None:
        try:
            body = self._source.read(item.listed.key, LARGEST_DOCUMENT)
        except TooLarge:
            file.problems.append(f"it is larger than {LARGEST_DOCUMENT:,} bytes and was not read")
            return
        if self._wanted.raw:
            parts = item.listed.key.split("/")[3:]
            file.raw = self._put(body, f"private/raw/{'/'.join([person.folder, *parts])}")
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

    def _recording(self, item: Item, person: Person, document: Any, file: File) -> None:
        attempt = keys.attempt(self._project, person.user, item.server)
        place = str(attempt) if attempt is not None else f"other-{self._token(item.server)}"
        names = scrub.identities(person.user, person.number, document) | {item.server: place}
        label = item.server.rpartition("-")[0]
        hide = scrub.Scrub(names | ({label: "(server)"} if label else {})) if self._wanted.apart else scrub.nothing()
        packed, made = self._temporary(), self._temporary()
        try:
            self._source.fetch(item.listed, packed)
            who = {"participant": person.number, "studyStep": item.step, "attempt": attempt}
            converted = recording.convert(packed, made, who, hide, shown=not self._wanted.apart)
            path = f"recordings/{person.folder}/{place}/{item.name}.parquet"
            file.made = self._move(made, path)
            if self._wanted.raw:
                file.raw = self._move(packed, f"private/raw/{person.folder}/trials/{item.server}/{item.name}.jsonl.gz")
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


def forget_gone(state: State, folder: Path) -> int:
    """Remove here what is gone from the source, such as an erased participant. Return how many files that were."""
    count = 0
    with state.together():
        for key, user, kind, step, path, raw in state.unseen():
            for old in filter(None, (path, raw)):
                (folder / old).unlink(missing_ok=True)
                _prune((folder / old).parent, folder)
            state.forget(key, user, kind, step)
            count += 1
        state.forget_people()
    return count


def _prune(empty: Path, top: Path) -> None:
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
    if item.kind is Kind.PARTICIPANT:
        if recording.when(found.get("arrived")) is None:
            doubts.append("arrived is no time")
        if not isinstance(found.get("link", {}), dict):
            doubts.append("link is no object")
        return doubts
    if not isinstance(found.get("answers"), dict):
        doubts.append("answers is no object")
    if recording.when(found.get("answered")) is None:
        doubts.append("answered is no time")
    if found.get("step") != item.step:
        doubts.append("step is another one than the file's name says")
    return doubts
