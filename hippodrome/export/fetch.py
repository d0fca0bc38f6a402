"""Fetches new and changed files from the source into the folder, for several participants at once.

A file appears under its name whole or not at all, and only then a record (`records.py`) names it. So an interrupted run
can be continued.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import signal
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from hippodrome.export import keys, manifest, recording, scrub, talk
from hippodrome.export.keys import Item, KeyKind
from hippodrome.export.manifest import ExportedFile
from hippodrome.export.records import PRIVATE, Record, Records, SourceFile
from hippodrome.export.source import PARALLEL, FileGone, Source, TooLarge
from hippodrome.export.values import when
from hippodrome.protocol import session as sessions
from hippodrome.protocol.keys import sessions_folder
from hippodrome.protocol.session import is_session_id

MAX_WAITING = 4 * PARALLEL  # participants and sessions whose files are being fetched
CONVERTED_AT_ONCE = 1
MAX_PIECE = 256 * 1024 * 1024  # bytes; a piece holds what was said, and a model's answers, of two seconds
MAX_DOCUMENT = 4 * 1024 * 1024  # bytes; next_step accepts answers of 256 KB
_PLAYED = (KeyKind.RECORDING, KeyKind.TAPE)
_OWN = ("recordings", f"{PRIVATE}/raw", f"{PRIVATE}/records", f"{PRIVATE}/minari.part")
"""The folders that have only what runs have written."""


class Wanted(NamedTuple):
    """The data that a run fetches."""

    recordings: bool = True
    raw: bool = False  # whether the source's files are also copied unchanged
    apart: bool = False  # whether ids are kept apart, in `private/`
    dry: bool = False  # whether files are only counted


@dataclass
class Tally:
    """What a run has done, or would do: numbers of participants, files and bytes."""

    participants: int = 0
    new: int = 0
    changed: int = 0
    unchanged: int = 0
    gone: int = 0  # files that are no longer in the source
    bytes: int = 0  # the bytes to fetch
    damaged: int = 0  # files in the folder that have changed or are missing

    @property
    def to_fetch(self) -> int:
        return self.new + self.changed

    def add(self, other: Tally) -> None:
        for one in fields(self):
            setattr(self, one.name, getattr(self, one.name) + getattr(other, one.name))


class Played(NamedTuple):
    """Who has played a recording. `people` has a session's members: their numbers, by seat.

    `identities` has the texts that identify them, each with its replacement. `mark` changes with both, so that
    recordings are converted again.
    """

    identities: Mapping[str, str]
    people: Mapping[int, str] | None = None

    @property
    def mark(self) -> str:
        facts = json.dumps([sorted((self.people or {}).items()), sorted(self.identities.items())])
        return hashlib.blake2b(facts.encode("utf-8", "replace"), digest_size=8).hexdigest()


class Fetcher:
    """Fetches and converts files with several workers."""

    def __init__(self, project: str, source: Source, *, records: Records, folder: Path, wanted: Wanted) -> None:
        self._project = project
        self._source = source
        self._records = records
        self._folder = folder
        self._wanted = wanted
        self._seen: set[str] = set()  # the names of the records of those who have files in the source
        self._converter = ThreadPoolExecutor(1)  # of several threads each would keep a recording's memory
        self.incoming = folder / PRIVATE / "incoming"

    def run(self, progress: Callable[[int, int], None]) -> Tally:
        """Bring the folder up to date, and return what was done. `progress` is called with the number of listed files,
        and how many of them are done. If this raises, the records have the files so far."""
        if not self._wanted.dry:
            self.incoming.mkdir(parents=True, exist_ok=True)
            for left in self.incoming.iterdir():
                left.unlink()
        tally = Tally()
        pool = ThreadPoolExecutor(PARALLEL, thread_name_prefix="data")
        running: dict[Future[Tally], int] = {}
        listed = done = 0
        try:
            with interruption() as check:

                def collect(most: int) -> None:
                    """Wait until at most so many participants and sessions are being fetched."""
                    nonlocal done
                    while len(running) > most:
                        check()
                        for future in wait(running, timeout=0.2, return_when=FIRST_COMPLETED).done:
                            done += running.pop(future)
                            tally.add(future.result())
                        progress(listed, done)

                for user, items in self._units():
                    if not user or is_session_id(user):
                        collect(0)  # a session's recordings name its members, whose documents must be known first
                    record = self._records.of(user)
                    self._seen.add(record.folder)
                    listed += len(items)
                    running[pool.submit(self._update, record, items)] = len(items)
                    collect(MAX_WAITING)
                collect(0)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
            self._converter.shutdown()
        return tally

    def _units(self) -> Iterator[tuple[str, list[Item]]]:
        """The listed files of each participant, then those of each session, then those of neither."""
        strays: list[Item] = []
        for prefix in (keys.prefix(self._project), sessions_folder(self._project)):
            items = (keys.read(self._project, line) for line in self._source.list(prefix))
            for user, group in itertools.groupby(items, key=lambda item: item.user):
                if user:
                    yield user, list(group)
                else:
                    strays += group
        if strays:
            yield "", strays

    def forget_gone(self) -> int:
        """Forget those who have no file in the source any more, such as an erased participant; return how many files
        they had. `remove_unnamed` then removes what was exported of them."""
        count = 0
        for name in self._records.names - self._seen:
            record = self._records.load(name)
            count += len(record.files) if record else 0
            if not self._wanted.dry:
                self._records.remove(name)
        return count

    def remove_unnamed(self) -> None:
        """Remove what no record names: files that an interrupted run has left, or an earlier version. They may be those
        of somebody who has been erased since."""
        named: set[str] = set()
        for record in self._records:
            named.add(f"{PRIVATE}/records/{record.folder}.json")
            named.update(exported.path for file in record.files.values() for exported in file.exported)
        for path in own_files(self._folder):
            if path.relative_to(self._folder).as_posix() not in named:
                path.unlink()
        for name in _OWN:
            for top, *_ in os.walk(self._folder / name, topdown=False):
                remove_empty(Path(top), self._folder)

    # -- in the workers

    def _update(self, record: Record, items: list[Item]) -> Tally:
        """Fetch what is new or changed of one participant or session, and remove what the source has lost."""
        tally = Tally(participants=int(record.is_participant))
        lost = record.files.keys() - {item.listed.key for item in items}
        for key in lost:
            tally.gone += 1
            file = record.files.pop(key)
            if not self._wanted.dry:
                self._remove(file)
        documents = [item for item in items if item.kind not in _PLAYED]
        stale = [item for item in documents if not self._is_current(record, item, item.listed.version, tally)]
        for item in stale:
            self._fetch(record, item, SourceFile(item.listed.key, item.kind, item.listed.version, item.step))
        if (lost or stale) and not self._wanted.dry:
            self._records.save(record)
        played = self._played(record)
        mark = f"~{played.mark}"
        if self._wanted.dry and any(item.kind not in (KeyKind.ANSWER, KeyKind.FOREIGN) for item in stale):
            mark = ""  # it is not known yet
        for item in (item for item in items if item.kind in _PLAYED):
            version = f"{item.listed.version}{mark}"
            if not self._is_current(record, item, version, tally):
                file = SourceFile(item.listed.key, item.kind, version, item.step)
                self._fetch(record, item, file, played)
                if not self._wanted.dry:
                    self._records.save(record)
        return tally

    def _is_current(self, record: Record, item: Item, version: str, tally: Tally) -> bool:
        """Whether a file need not be fetched. Counts it."""
        before = record.files.get(item.listed.key)
        damaged = [file for file in before.exported if manifest.difference(self._folder, file)] if before else []
        tally.damaged += len(damaged)
        raw_missing = self._wanted.raw and item.kind is not KeyKind.FOREIGN and not (before and before.raw)
        skipped = item.kind in _PLAYED and not self._wanted.recordings
        if skipped or (before and before.version == version and not damaged and not raw_missing):
            tally.unchanged += 1
            return True
        if before:
            tally.changed += 1
        else:
            tally.new += 1
        tally.bytes += item.listed.size if item.kind is not KeyKind.FOREIGN else 0
        return False

    def _played(self, record: Record) -> Played:
        """Who has played the recordings of a participant or session."""
        if not record.is_session:
            return Played(record.identities if self._wanted.apart and record.user else {})
        people: dict[int, str] = {}
        identities: dict[str, str] = {}
        try:
            members = sessions.parse(json.dumps(record.session).encode()).members
        except sessions.BadSession:
            members = ()
        for member in members:
            theirs = self._records.of(member.user_id) if member.user_id else None
            if theirs and theirs.folder in self._seen:
                people[member.seat] = theirs.number
                identities |= theirs.identities if self._wanted.apart else {}
        return Played(identities, people)

    def _fetch(self, record: Record, item: Item, file: SourceFile, played: Played | None = None) -> None:
        """Fetch a file, and put it into the record in the place of its earlier version."""
        if self._wanted.dry:
            return
        try:
            if item.kind is KeyKind.FOREIGN:
                file.problems.append(f"no file of Hippodrome: {item.why}")
            elif played is None:
                self._document(record, item, file)
            elif item.kind is KeyKind.RECORDING:
                self._recording(record, item, file, played)
            else:
                self._tape(record, item, file, played)
        except FileGone:
            return  # the next run lists its new version, if there is one
        if before := record.files.get(file.key):
            self._remove(before, but=[now.path for now in file.exported])
        record.files[file.key] = file

    def _document(self, record: Record, item: Item, file: SourceFile) -> None:
        rest = "/".join(item.listed.key.split("/")[3:])
        body = self._read(item, file, f"private/raw/{record.folder}/{rest}", MAX_DOCUMENT)
        if body is None:
            return
        try:
            document = json.loads(body)
        except (ValueError, RecursionError):
            file.problems.append("it is no JSON")
            return
        if isinstance(document, dict):
            file.document = document
            file.problems += doubts(item, document)
        else:
            file.problems.append("it is no JSON object")

    def _tape(self, record: Record, item: Item, file: SourceFile, played: Played) -> None:
        raw = f"private/raw/{record.folder}/trials/{item.server}/{item.name}"
        body = self._read(item, file, raw, MAX_PIECE)
        if body is None:
            return
        attempt = keys.attempt(self._project, item.user, item.server)
        where = {"step": item.step, "attempt": attempt, "session": record.user if record.is_session else None}
        try:
            hide = scrub.Scrub(played.identities)
            file.document = talk.document(json.loads(body), where, played.people or {}, hide)
        except (ValueError, AttributeError, RecursionError):
            file.problems.append("it is no piece of a tape that this version can read")

    def _read(self, item: Item, file: SourceFile, raw: str, most: int) -> bytes | None:
        """Read a document, and keep it at the path `raw` too if that is wanted; None if it is too large."""
        try:
            body = self._source.read(item.listed.key, most)
        except TooLarge:
            file.problems.append(f"it is larger than {most:,} bytes and was not read")
            return None
        if self._wanted.raw:
            copy = self._temporary()
            copy.write_bytes(body)
            file.raw = self._move(copy, raw)
        return body

    def _recording(self, record: Record, item: Item, file: SourceFile, played: Played) -> None:
        attempt = keys.attempt(self._project, item.user, item.server)
        place = str(attempt) if attempt is not None else f"other-{self._token(item.server)}"
        label = item.server.rpartition("-")[0]
        servers = {item.server: place} | ({label: "(server)"} if label else {})
        hide = scrub.Scrub(played.identities, servers if self._wanted.apart else {})
        owner = {"session": record.user} if record.is_session else {"participant": record.number}
        constants = {**owner, "studyStep": item.step, "attempt": attempt}
        packed, made = self._temporary(), self._temporary()
        try:
            self._source.fetch(item.listed, packed)
            shown = not self._wanted.apart
            convert = partial(recording.convert, packed, made, constants, hide, shown=shown, people=played.people)
            converted = self._converter.submit(convert).result()
            file.made = self._move(made, f"recordings/{record.folder}/{place}/{item.name}.parquet")
            if self._wanted.raw:
                raw = f"private/raw/{record.folder}/trials/{item.server}/{item.name}.jsonl.gz"
                file.raw = self._move(packed, raw)
        finally:
            packed.unlink(missing_ok=True)
            made.unlink(missing_ok=True)
        file.frames, file.problems = converted.frames, converted.problems
        file.episodes = [{**episode, "step": item.step, "attempt": attempt} for episode in converted.episodes]

    def _token(self, server: str) -> str:
        """A token in the place of a server's name that Hippodrome has not made, and that may identify someone."""
        salt = (self._folder / PRIVATE / "salt").read_bytes()
        return hashlib.blake2b(server.encode(), key=salt, digest_size=5).hexdigest()

    def _temporary(self) -> Path:
        return self.incoming / f"{uuid.uuid4().hex}.part"

    def _move(self, file: Path, path: str) -> ExportedFile:
        """Move a finished file to its path in the folder."""
        target = self._folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, target)
        return manifest.entry(self._folder, target)

    def _remove(self, file: SourceFile, but: list[str] | None = None) -> None:
        """Remove a source file's exported files, except those with the paths in `but`, and the folders that are empty
        then."""
        for exported in file.exported:
            if exported.path not in (but or ()):
                path = self._folder / exported.path
                path.unlink(missing_ok=True)
                remove_empty(path.parent, self._folder)


@contextlib.contextmanager
def interruption() -> Iterator[Callable[[], None]]:
    """Let Ctrl-C raise KeyboardInterrupt only where the block calls the function that this yields.

    Elsewhere it may break a lock that the workers share, and they then print tracebacks or wait for ever. A second
    Ctrl-C raises it at once. Nothing changes in a thread other than the main thread, or if Ctrl-C is ignored.
    """
    pressed: list[int] = []

    def check() -> None:
        if pressed:
            raise KeyboardInterrupt

    def press(number: int, _: object) -> None:
        check()
        pressed.append(number)

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler or threading.current_thread() is not threading.main_thread():
        yield check
        return
    signal.signal(signal.SIGINT, press)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
    check()


def own_files(folder: Path) -> Iterator[Path]:
    """Yield the files in the folders that have only what runs have written, and the database in which an earlier
    version kept answers."""
    for name in _OWN:
        for top, _, names in os.walk(folder / name):
            yield from (Path(top, name) for name in names)
    yield from (folder / PRIVATE).glob("state.sqlite*")


def remove_empty(empty: Path, top: Path) -> None:
    """Remove this folder if it is empty, and then the empty folders above it, up to `top`, which stays."""
    with contextlib.suppress(OSError):  # the folder is not empty
        while empty != top:
            empty.rmdir()
            empty = empty.parent


def doubts(item: Item, found: dict[str, Any]) -> list[str]:
    """Return the differences between a document and its description in `docs/data.md`. The export uses the valid
    parts."""
    doubts = []
    group = found.get("group")
    if group is not None and (not isinstance(group, int) or isinstance(group, bool)):
        doubts.append("group is no whole number")
    match item.kind:
        case KeyKind.PARTICIPANT:
            if when(found.get("arrived")) is None:
                doubts.append("arrived is no time")
            if not isinstance(found.get("link", {}), dict):
                doubts.append("link is no object")
        case KeyKind.MEMBERSHIP:
            if (session := found.get("session")) is not None and not is_session_id(session):
                doubts.append("session is no id of a session")
        case KeyKind.SESSION:
            try:
                sessions.parse(json.dumps(found).encode())
            except sessions.BadSession as bad:
                return [str(bad)]
        case KeyKind.ANSWER if item.step not in (keys.ASSIGNED, keys.ENDED):
            if not isinstance(found.get("answers"), dict):
                doubts.append("answers is no object")
            if when(found.get("answered")) is None:
                doubts.append("answered is no time")
            if found.get("step") != item.step.partition(".")[0]:
                doubts.append("step is not the one in the file's name")
    return doubts
