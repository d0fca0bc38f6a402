"""A run of `data`: fetches new files, removes what the source has lost, and writes all tables and the manifest."""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
import secrets
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.control.model.project import MASTER_LIST, MasterList, Project, read_list
from hippodrome.export import keys, manifest
from hippodrome.export.answers import Answers, LongAnswers, Runs, Tries
from hippodrome.export.fetch import Fetcher, Tally, Wanted, own_files
from hippodrome.export.keys import KeyKind
from hippodrome.export.manifest import ExportedFile
from hippodrome.export.page_fields import read_fields
from hippodrome.export.records import IDENTITIES, PRIVATE, Record, Records
from hippodrome.export.source import FileGone, Source, TooLarge
from hippodrome.export.table_files import Style, Table, TableFile
from hippodrome.export.tables import Callbacks, Episodes, Identities, Presence, Problems
from hippodrome.export.talk import Calls, Messages

_ABOUT = f"{PRIVATE}/about.json"  # what all runs of a folder have in common
_GAMES = ("episodes", "callbacks", "messages", "calls", "presence")
_TABLES = ("answers", "answers-long", "runs", "runs-*", "tries", "problems", *_GAMES)
_COUNTED = ("participants", "answers", "recordings", "episodes", "frames", "foreign", "finished", "problems")
_MAX_MASTER_LIST = 64 * 1024 * 1024  # bytes


@dataclass(frozen=True)
class Options:
    """The options of the command."""

    formats: frozenset[str] = frozenset({"csv", "parquet"})
    apart: bool = False  # whether ids are only in `private/`, and numbers everywhere else
    raw: bool = False  # whether the source's files are also copied unchanged
    long: bool = False  # whether the table answers-long, with a row per field, is written too
    spreadsheet: bool = False  # CSV for spreadsheets (`table_files.Style`)

    @property
    def wanted(self) -> Wanted:
        """The data to fetch: recordings only if a format needs them."""
        return Wanted(bool(self.formats & {"parquet", "minari"}), self.raw, self.apart)

    @property
    def style(self) -> Style:
        """The formats of tables. If datasets are the only format, tables are CSV."""
        parquet = "parquet" in self.formats
        return Style("csv" in self.formats or not parquet, parquet, self.spreadsheet)

    def with_those_in(self, folder: Path) -> Options:
        """Add the formats that the folder has from earlier runs: another format removes none, and none goes out of
        date. Formats whose packages are not installed are left out."""
        here = {name for name in ("csv", "parquet") if (folder / f"answers.{name}").exists()}
        here |= {"minari"} if (folder / "minari").is_dir() else set()
        packages = {"parquet": "pyarrow", "minari": "minari"}
        here -= {name for name, package in packages.items() if find_spec(package) is None}
        return replace(self, formats=self.formats | here, long=self.long or any(folder.glob("answers-long.*")))


def look(source: Source, project_id: str, folder: Path, options: Options) -> Tally:
    """Return what a run would do. Changes nothing. Raises `Problem`."""
    _refuse(source, project_id, folder, _find_project(source, project_id), options)
    options = options.with_those_in(folder)
    records = Records(folder, apart=options.apart, dry=True)
    wanted = options.wanted._replace(dry=True)
    fetcher = Fetcher(project_id, source, records=records, folder=folder, wanted=wanted)
    tally = fetcher.run(lambda listed, done: None)
    tally.gone += fetcher.forget_gone()
    return tally


def run(source: Source, project_id: str, folder: Path, options: Options) -> dict[str, Any]:
    """Bring the folder up to date with the source, and return its manifest with a summary of the run. Raises `Problem`.

    Answers are personal data, so only the files' owner can read them.
    """
    mask = os.umask(0o077)
    try:
        project = _find_project(source, project_id)
        _refuse(source, project_id, folder, project, options)
        with _locked(folder):
            return _Export(source, project_id, project, folder, options.with_those_in(folder)).run()
    except OSError as error:
        raise _refused(folder, error) from error
    finally:
        os.umask(mask)


@dataclass
class _Export:
    """A run of a folder that it has the lock of."""

    source: Source
    project_id: str
    project: Project | None
    folder: Path
    options: Options

    def __post_init__(self) -> None:
        private = self.folder / PRIVATE
        (private / "records").mkdir(exist_ok=True)
        self._salt = private / "salt"
        if not self._salt.exists():
            self._salt.write_bytes(secrets.token_bytes(32))
        if not _read_about(self.folder):
            about = _about(self.source, self.project_id, self.options)
            (self.folder / _ABOUT).write_text(json.dumps(about))
        self._records = Records(self.folder, apart=self.options.apart)
        self._answers = Answers(self.project, self.options.apart, read_fields(self.source, self.project))
        self._counts = Counter(dict.fromkeys(_COUNTED, 0))
        self._replaced = 0  # identities in answers
        self._written: list[Path] = []

    def run(self) -> dict[str, Any]:
        tally = self._fetch()
        with _bar("Writing tables") as progress:
            self._write_tables()
            progress(1, 1)
        return {"folder": str(self.folder), **self._write_manifest(self._datasets()), "run": asdict(tally)}

    def _fetch(self) -> Tally:
        known = any(own_files(self.folder))
        wanted = self.options.wanted
        fetcher = Fetcher(self.project_id, self.source, records=self._records, folder=self.folder, wanted=wanted)
        with _bar("Fetching") as progress:
            tally = fetcher.run(progress)
        if known and not tally.participants:
            raise Problem(
                f"There are no participants of {self.project_id} in the {self.source.where}, and this folder holds "
                "theirs.",
                "If that is right, delete the folder. If not, look at STUDY, --stack and --region.",
            )
        tally.gone += fetcher.forget_gone()
        fetcher.remove_unnamed()
        return tally

    def _tables(self) -> list[Table]:
        """All tables that are shared. The last is written as CSV alone."""
        blocks = range(len(self.project.blocks)) if self.project else ()
        runs = [Runs(self._answers, self.project, block) for block in blocks if self.project]
        long = [LongAnswers(self._answers)] if self.options.long else []
        games: list[Table] = []
        if self.options.wanted.recordings:
            games = [Episodes(), Callbacks(self.folder), Messages(), Calls(), Presence(self.folder)]
        return [self._answers, *runs, Tries(), *long, *games, Problems(self.project_id, self.options.apart)]

    def _write_tables(self) -> None:
        """Read all records twice: first to find the tables' columns, then to write their rows."""
        tables = self._tables()
        for record in self._shown():
            self._count(record)
            for table in tables:
                table.see(record)
        tables = [table for table in tables if table.needed]
        only_csv = Style(parquet=False, spreadsheet=self.options.spreadsheet)
        places = [(table, self.folder, self.options.style) for table in tables[:-1]]
        places.append((tables[-1], self.folder, only_csv))
        if self.options.apart:
            places.append((Identities(self._answers), self.folder / PRIVATE, only_csv))
        self._replaced = 0
        with contextlib.ExitStack() as stack:
            files = [
                (table, stack.enter_context(TableFile(place / table.name, table.columns, style)))
                for table, place, style in places
            ]
            for record in self._shown():
                for table, file in files:
                    file.add(table.rows(record))
        self._written = [path for _, file in files for path in file.paths if path.parent == self.folder]
        for path in (path for name in _TABLES for path in self.folder.glob(f"{name}.*")):
            if path not in self._written:
                path.unlink()  # an earlier run has written it, and this one has not

    def _shown(self) -> Iterator[Record]:
        """The records; with `apart`, without identities in answers."""
        for record in self._records:
            self._replaced += record.without_identities() if self.options.apart else 0
            yield record

    def _count(self, record: Record) -> None:
        counts = self._counts
        counts["participants"] += record.is_participant
        counts["answers"] += len(record.answers)
        counts["finished"] += bool(record.is_participant and self._answers.finished(record))
        for file in record.files.values():
            counts["recordings"] += file.made is not None
            counts["episodes"] += len(file.episodes)
            counts["frames"] += file.frames
            counts["foreign"] += file.kind == KeyKind.FOREIGN
            counts["problems"] += len(file.problems)
            if file.kind == KeyKind.SESSION:
                counts["sessions"] += 1

    def _converted(self) -> Iterator[ExportedFile]:
        return (file.made for record in self._records for file in record.recordings() if file.made)

    def _datasets(self) -> list[dict[str, Any]]:
        """Make the Minari datasets if the options ask for them, and return their summaries. Datasets of other
        recordings than those that are here now are removed."""
        target, wanted = self.folder / "minari", "minari" in self.options.formats
        if not wanted and not target.exists():
            return []
        last = _read_manifest(self.folder) or {"files": [], "minari": []}
        files = [file for file in last["files"] if file.path.startswith("minari/")]
        same = {file for file in last["files"] if file.path.startswith("recordings/")} == {*self._converted()}
        if files and same and not any(manifest.difference(self.folder, file) for file in files):
            made: list[dict[str, Any]] = last["minari"]
            return made
        if not wanted:
            shutil.rmtree(target)
            return []
        from hippodrome.export import datasets  # noqa: PLC0415 - imports numpy, which `--format csv` does without

        with _bar("Writing Minari datasets") as progress:
            return datasets.build(self.folder, self._records, self.project_id, progress)

    def _write_manifest(self, datasets: list[dict[str, Any]]) -> dict[str, Any]:
        """Write the manifests of the folder and of `private/`, and return that of the folder without its files."""
        about = {
            "project": self.project_id,
            "projectVersion": self.project.version if self.project else None,
            "made": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            "source": self.source.where,
            "identities": "apart" if self.options.apart else "together",
            "identitiesReplacedInAnswers": self._replaced,
            "formats": sorted(self.options.formats),
            "counts": dict(self._counts),
            "columns": [column.name for column in self._answers.columns],
            "moved": [moved._asdict() for moved in self._answers.moved],
            "minari": datasets,
        }
        kept = [self._salt, *([self.folder / IDENTITIES] if self.options.apart else [])]
        raw = (file.raw for record in self._records for file in record.files.values() if file.raw)
        private = itertools.chain((manifest.entry(self.folder, path) for path in kept), raw)
        manifest.write(self.folder / PRIVATE / manifest.NAME, {"project": self.project_id}, private)
        trees = (path for path in sorted((self.folder / "minari").rglob("*")) if path.is_file())
        made_now = (manifest.entry(self.folder, path) for path in itertools.chain(self._written, trees))
        manifest.write(self.folder / manifest.NAME, about, itertools.chain(made_now, self._converted()))
        return about


# The source


def _master_list(source: Source) -> MasterList:
    """The list of studies; an empty one if there is none. Raises ValueError and TooLarge."""
    try:
        return read_list(source.read(MASTER_LIST, _MAX_MASTER_LIST))
    except FileGone:
        return MasterList([])


def _find_project(source: Source, project_id: str) -> Project | None:
    """The registered study, which has the order of its steps; None if it cannot be read, or is not there."""
    try:
        listed = _master_list(source)
    except (TooLarge, ValueError):
        screen.warning(f"{MASTER_LIST} cannot be read: steps stand in the order of their names.")
        return None
    project = listed.find(project_id)
    if project is None and any(entry.id in (None, project_id) for entry in listed.unreadable):
        screen.warning(f"An entry of {MASTER_LIST} cannot be read, maybe this project's: steps stand by their names.")
    return project


def _refuse(source: Source, project_id: str, folder: Path, project: Project | None, options: Options) -> None:
    """Raise `Problem` for a folder that holds something else, or for a source without participants of this project."""
    if folder.exists() and not folder.is_dir():
        raise Problem(f"{folder} is a file.", "Name a folder, or none.")
    ours = (folder / PRIVATE / "lock").exists() or bool(_read_manifest(folder))
    if folder.is_dir() and not ours and any(folder.iterdir()):
        raise Problem(f"{folder} has other files already.", "Name an empty folder, or one that does not exist yet.")
    _refuse_other(source, project_id, folder, options)
    if not _read_about(folder) and not any(True for _ in source.list(keys.prefix(project_id))):
        if project:
            raise Problem(f"No participant has begun {project_id} yet.", f"Answers will be in the {source.where}.")
        with contextlib.suppress(TooLarge, ValueError):
            if here := sorted(project.id for project in _master_list(source).projects):
                raise Problem(
                    f"There is no project {project_id} in the {source.place}.",
                    f"It holds: {', '.join(here)}. Name the right study: its id, or its folder.",
                )
        raise Problem(
            f"There is no project {project_id} in the {source.place}.",
            "Name the right study, or the right data: the folder data/ of a study, or data-try/try-… of one rehearsal, "
            "with --from.",
        )


def _about(source: Source, project_id: str, options: Options) -> dict[str, str]:
    mode = "apart" if options.apart else "together"
    return {"project": project_id, "identities": mode, "source": source.where, "place": source.place}


def _read_about(folder: Path) -> dict[str, str]:
    """What the earlier runs of the folder had in common; {} if there were none."""
    try:
        about: dict[str, str] = json.loads((folder / _ABOUT).read_text())
    except (FileNotFoundError, ValueError):
        return {}
    return about


def _read_manifest(folder: Path) -> dict[str, Any]:
    """The folder's manifest; {} if there is none, or if it is damaged or not one of Hippodrome."""
    with contextlib.suppress(Problem):
        return manifest.read(folder) or {}
    return {}


def _refuse_other(source: Source, project_id: str, folder: Path, options: Options) -> None:
    """Raise `Problem` if an earlier run of this folder had another study, source or mode of identities, or if nobody
    knows any more whose its numbers are."""
    words = {
        "project": "holds the data of the project {}",
        "identities": "was made with identities {}",
        "source": "was filled from the {}",
        "place": "was filled from the {}",
    }
    before = _read_about(folder) or _read_manifest(folder)  # an earlier version wrote no about.json
    for name, value in _about(source, project_id, options).items():
        if (other := before.get(name, value)) != value:
            other = f"{other} of this machine" if other == "folder" else other
            raise Problem(
                f"{folder} {words[name].format(other)}.",
                f"Name another folder, such as --to {folder}-2, or rename this one.",
            )
    if options.apart and (folder / manifest.NAME).exists() and not (folder / IDENTITIES).exists():
        raise Problem(
            f"{folder} holds data with numbers in place of ids, but {IDENTITIES} is missing there.",
            "Put the file back, or name another folder. In another folder people get other numbers.",
        )


# The folder


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, which the system releases when the process ends. Makes the folder. Raises `Problem` if
    that is not possible, or if another run has the lock."""
    import fcntl  # noqa: PLC0415 - not on every system

    private = folder / PRIVATE
    try:
        private.mkdir(parents=True, exist_ok=True)
        private.chmod(0o700)
    except OSError as error:
        raise Problem(f"{folder} cannot be written: {error.strerror}.", "Name another folder.") from None
    with (private / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Problem(
                f"Another run is filling {folder}.", "Wait until it is done, or name another folder."
            ) from None
        yield


_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_NO_RIGHT = (errno.EACCES, errno.EPERM, errno.EROFS)


def _refused(folder: Path, error: OSError) -> Problem:
    """The problem for an error of the file system, with advice for its cause."""
    reason = error.strerror or str(error) or type(error).__name__
    reason = f"{reason} ({error.filename})" if error.filename else reason
    if error.errno in _NO_ROOM:
        return Problem(f"A file cannot be written: {reason}.", "Make room; the same command goes on from here.")
    if error.errno in _NO_RIGHT:
        advice = f"See who may read and write {error.filename or folder}; the same command goes on from here."
        return Problem(f"A file cannot be read or written: {reason}.", advice)
    return Problem(
        f"The operating system has refused something with a file: {reason}.",
        "Run the command again: it goes on from here. If that does not help, HIPPODROME_DEBUG=1 shows where it fails.",
    )


@contextlib.contextmanager
def _bar(description: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar. Yields a function that updates it: call it with the total, and the number done."""
    with screen.ProgressBars() as bars:
        task = bars.add_task(description, total=None)
        yield lambda total, done: bars.update(task, total=total, completed=done)
