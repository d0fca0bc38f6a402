"""A run of `data`: fetches new files, removes what the source has lost, and writes all tables and the manifest."""

from __future__ import annotations

import contextlib
import csv
import errno
import itertools
import os
import secrets
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.control.model.project import MASTER_LIST, Project, read_list
from hippodrome.export import calls, fetch, keys, listing, manifest, runs, table_files, tables, talk
from hippodrome.export.answers import StudyAnswers
from hippodrome.export.fetch import Fetcher
from hippodrome.export.listing import Tally, Wanted
from hippodrome.export.page_fields import read_fields
from hippodrome.export.source import FileGone, Source, TooLarge
from hippodrome.export.state import ExportedFile, ExportState

PRIVATE = "private"
_STATE = f"{PRIVATE}/state.sqlite"
_DATASETS = 1  # raised with what datasets hold: those with another number are made again
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


def _with_those_here(folder: Path, options: Options) -> Options:
    """Add the formats that the folder has from earlier runs: another format removes none, and none goes out of date.

    Formats whose packages are not installed are left out.
    """
    here = {name for name in ("csv", "parquet") if (folder / f"answers.{name}").exists()}
    here |= {"minari"} if (folder / "minari").is_dir() else set()
    missing = {name for name, package in (("parquet", "pyarrow"), ("minari", "minari")) if find_spec(package) is None}
    long = options.long or any(folder.glob("answers-long.*"))
    return replace(options, formats=options.formats | (here - missing), long=long)


def find_project(source: Source, project_id: str) -> Project | None:
    """Return the registered study, which has the order of its steps; None if it cannot be read, or is not there."""
    try:
        listed = read_list(source.read(MASTER_LIST, _MAX_MASTER_LIST))
    except FileGone:
        return None
    except (TooLarge, ValueError):
        screen.warning(f"{MASTER_LIST} cannot be read: steps stand in the order of their names.")
        return None
    found = listed.find(project_id)
    if found is None and any(entry.id in (None, project_id) for entry in listed.unreadable):
        screen.warning(f"An entry of {MASTER_LIST} cannot be read, maybe this project's: steps stand by their names.")
    return found


def _refuse_unknown(source: Source, project_id: str, folder: Path, project: Project | None) -> None:
    """Raise `Problem` if a new folder would be filled from a source that holds no participant of this project."""
    if (folder / _STATE).exists() or any(True for _ in source.list(keys.prefix(project_id))):
        return
    if project:
        raise Problem(f"No participant has begun {project_id} yet.", f"Answers will be in the {source.where}.")
    here = _registered(source)
    raise Problem(
        f"There is no project {project_id} in the {source.place}.",
        f"It holds: {', '.join(here)}. Name the right study: its id, or its folder."
        if here
        else "Name the right study, or the right data: the folder "
        "data/ of a study, or data-try/try-… of one rehearsal, with --from.",
    )


def _registered(source: Source) -> list[str]:
    """Return the ids of the projects that are registered in the source, as far as their list can be read."""
    try:
        return sorted(project.id for project in read_list(source.read(MASTER_LIST, _MAX_MASTER_LIST)).projects)
    except (FileGone, TooLarge, ValueError):
        return []


def look(source: Source, project_id: str, folder: Path, options: Options) -> Tally:
    """Return what a run would do. Changes nothing. Raises `Problem`."""
    _refuse_unknown(source, project_id, folder, find_project(source, project_id))
    options = _with_those_here(folder, options)
    with _checked(folder, source, project_id, options) as (state, damaged):
        tally, known = Tally(damaged=len(damaged)), 0
        for unit in listing.units(project_id, listing.lines(source, project_id, state)):
            before = state.files_of(unit.user)
            known += sum(item.listed.key in before for item in unit.items)
            mark = listing.members(state, unit.user).mark if unit.is_session else ""
            listing.choose(state, unit, options.wanted, tally, damaged, mark=mark)
        tally.gone = state.file_count() - known
        return tally


@contextlib.contextmanager
def _checked(
    folder: Path, source: Source, project_id: str, options: Options
) -> Iterator[tuple[ExportState, frozenset[str]]]:
    """The folder's state, which cannot be changed, and the paths of damaged files."""
    _refuse_foreign(folder)
    try:
        state = ExportState.read_only(folder / _STATE)
    except sqlite3.DatabaseError:
        raise _broken_state(folder) from None
    try:
        _same_study(state, folder, source, project_id, options, write=False)
        yield state, _damaged(folder, state)
    except sqlite3.DatabaseError:
        raise _broken_state(folder) from None
    finally:
        state.close()


def run(source: Source, project_id: str, folder: Path, options: Options) -> dict[str, Any]:
    """Bring the folder up to date with the source, and return its manifest with a summary of the run. Raises `Problem`.

    Answers are personal data, so only the files' owner can read them.
    """
    mask = os.umask(0o077)
    try:
        return _bring_up_to_date(source, project_id, folder, options)
    finally:
        os.umask(mask)


def _bring_up_to_date(source: Source, project_id: str, folder: Path, options: Options) -> dict[str, Any]:
    project = find_project(source, project_id)
    _refuse_foreign(folder)
    _refuse_unknown(source, project_id, folder, project)
    try:
        private = folder / PRIVATE
        private.mkdir(parents=True, exist_ok=True)
        private.chmod(0o700)
    except OSError as error:
        raise Problem(f"{folder} cannot be written: {error.strerror}.", "Name another folder.") from None
    with _locked(folder):
        options = _with_those_here(folder, options)
        try:
            state = ExportState(folder / _STATE)
        except sqlite3.DatabaseError:
            raise _broken_state(folder) from None
        try:
            return _run(source, project_id, project, folder=folder, state=state, options=options)
        except sqlite3.DatabaseError as error:
            raise _broken_state(folder) from error
        except OSError as error:
            raise _refused(folder, error) from error
        finally:
            state.close()


def _run(
    source: Source, project_id: str, project: Project | None, *, folder: Path, state: ExportState, options: Options
) -> dict[str, Any]:
    _same_study(state, folder, source, project_id, options, write=True)
    salt = folder / PRIVATE / "salt"
    if not salt.exists():
        salt.write_bytes(secrets.token_bytes(32))
    damaged = _damaged(folder, state)
    files_before = state.file_count()
    with _bar("Fetching") as progress:
        tally = Fetcher(
            project_id,
            source=source,
            state=state,
            folder=folder,
            wanted=options.wanted,
            progress=progress,
            damaged=damaged,
        ).run()
    tally.damaged = len(damaged)
    if files_before and not tally.participants:
        raise Problem(
            f"There are no participants of {project_id} in the {source.where}, and this folder holds theirs.",
            "If that is right, delete the folder. If not, look at STUDY, --stack and --region.",
        )
    tally.gone = fetch.forget_gone(state, folder)
    parquet = "parquet" in options.formats
    # If datasets are the only format, the tables are CSV.
    style = table_files.Style("csv" in options.formats or not parquet, parquet, options.spreadsheet)
    written: list[Path] = []
    with _bar("Writing tables") as progress:
        answers = StudyAnswers(state, project, options.apart, read_fields(source, project))
        columns = answers.columns
        written += table_files.write(folder / "answers", columns, answers.rows(), style)
        finished, scrubbed = answers.finished, answers.scrubbed
        written += runs.write(folder, answers, project, style)
        if options.long:
            written += table_files.write(folder / "answers-long", answers.LONG, answers.long_rows(), style)
        if options.wanted.recordings:
            written += _write_games(state, folder, style)
        only_csv = table_files.Style(parquet=False, spreadsheet=options.spreadsheet)
        found = tables.problems(state, project_id, options.apart)
        written += table_files.write(folder / "problems", tables.PROBLEMS, found, only_csv)
        private = [manifest.entry(folder, salt)]
        if options.apart:
            identity_columns, rows = tables.identities(state, answers.links)
            (path,) = table_files.write(folder / PRIVATE / "identities", identity_columns, rows, only_csv)
            path.chmod(0o600)
            private.append(manifest.entry(folder, path))
        progress(1, 1)
    made = _datasets(folder, state, project_id, options)
    _remove_stale(folder, written)

    counts = state.counts() | {"finished": finished, "problems": sum(1 for _ in state.problems())}
    about = {
        "project": project_id,
        "projectVersion": project.version if project else None,
        "made": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "source": source.where,
        "identities": "apart" if options.apart else "together",
        "identitiesReplacedInAnswers": scrubbed,
        "formats": sorted(options.formats),
        "counts": counts,
        "columns": [column.name for column in columns],
        "moved": [moved._asdict() for moved in answers.moved],
        "minari": made,
    }
    made_now = [*(manifest.entry(folder, path) for path in written), *_tree(folder, "minari")]
    manifest.write(folder / PRIVATE / manifest.NAME, {"project": project_id}, [*private, *state.raw_files()])
    manifest.write(folder / manifest.NAME, about, itertools.chain(made_now, state.converted_files()))
    return {"folder": str(folder), **about, **{"run": asdict(tally)}}


def _write_games(state: ExportState, folder: Path, style: table_files.Style) -> list[Path]:
    """Write the tables of what happened and was said in games, and return their files."""
    written: list[Path] = []
    shared = tables.in_sessions(state)
    written += table_files.write(folder / "episodes", *tables.episodes(state, in_sessions=shared), style)
    if any(found.get("callbacks") for _, _, found in state.episodes()):
        lines = tables.callbacks(state, folder, shared)
        written += table_files.write(folder / "callbacks", tables.callback_columns(shared), lines, style)
    if any(found.record.get("kind") == "line" for found in talk.records(state)):
        shared_talk = state.has_sessions()
        said = talk.messages(state, shared_talk)
        written += table_files.write(folder / "messages", talk.columns(shared_talk), said, style)
    if calls.has_calls(state):
        shared_calls = state.has_sessions()
        rows = calls.calls(state, shared_calls)
        written += table_files.write(folder / "calls", calls.columns(shared_calls), rows, style)
    if shared:
        rows = tables.presence(state, folder)
        written += table_files.write(folder / "presence", tables.PRESENCE, rows, style)
    return written


def _datasets(folder: Path, state: ExportState, project_id: str, options: Options) -> list[dict[str, Any]]:
    """Make the Minari datasets if the options ask for them, and return their summaries. Datasets that no longer fit
    the recordings are removed."""
    now, before = f"{_DATASETS} {state.recordings_fingerprint()}", state.fact("minari")
    if "minari" not in options.formats and before != now:
        shutil.rmtree(folder / "minari", ignore_errors=True)
        state.set_fact("minari", "")
    if "minari" not in options.formats or (before == now and _sound_minari(folder)):
        made: list[dict[str, Any]] = msgspec.json.decode(state.fact("datasets") or "[]")
        return made if state.fact("minari") == now else []
    from hippodrome.export import datasets  # noqa: PLC0415 - imports numpy, which `--format csv` does without

    state.set_fact("minari", "")
    with _bar("Writing Minari datasets") as progress:
        made = datasets.build(folder, state, project_id, progress)
    state.set_fact("datasets", msgspec.json.encode(made).decode())
    state.set_fact("minari", now)
    return made


def _sound_minari(folder: Path) -> bool:
    """Whether the datasets' files are as the last manifest lists them."""
    try:
        last = manifest.read(folder)
    except Problem:
        return False
    files = [file for file in last["files"] if file.path.startswith("minari/")] if last else []
    return bool(files) and not any(manifest.damaged(folder, files))


def _remove_stale(folder: Path, written: list[Path]) -> None:
    """Remove the tables of an earlier run that this run did not write, and half-written tables."""
    games = ("episodes", "callbacks", "messages", "calls", "presence")
    for name in ("answers", "answers-long", "runs", "runs-*", "tries", *games, "problems"):
        for path in folder.glob(f"{name}.*"):
            if path not in written:
                path.unlink()


def _tree(folder: Path, name: str) -> Iterator[ExportedFile]:
    """All files below a folder in the export folder."""
    for path in sorted((folder / name).rglob("*")):
        if path.is_file():
            yield manifest.entry(folder, path)


def check(folder: Path) -> list[str]:
    """Return a sentence for each file that differs from the folder's manifest. Reads no source, and changes nothing.
    Raises `Problem` without a manifest, or if it is damaged."""
    about = manifest.read(folder)
    if about is None:
        raise Problem(f"There is no {manifest.NAME} in {folder}.", "Name the folder that `data` has filled.")
    wrong = [f"{path} {difference}" for path, difference in manifest.damaged(folder, about["files"])]
    wrong += [f"{path} is not in the manifest" for path in manifest.unlisted(folder, about["files"])]
    private = manifest.read(folder / PRIVATE)
    if private is not None:
        wrong += [f"{path} {difference}" for path, difference in manifest.damaged(folder, private["files"])]
    return wrong


# The folder


def _refuse_foreign(folder: Path) -> None:
    """Raise `Problem` for a folder with other files, which is not an export folder."""
    if folder.exists() and not folder.is_dir():
        raise Problem(f"{folder} is a file.", "Name a folder, or none.")
    ours = (folder / manifest.NAME).exists() or (folder / PRIVATE).is_dir()
    if folder.is_dir() and not ours and any(folder.iterdir()):
        raise Problem(f"{folder} has other files already.", "Name an empty folder, or one that does not exist yet.")


def _same_study(
    state: ExportState, folder: Path, source: Source, project_id: str, options: Options, *, write: bool
) -> None:
    """Raise `Problem` if an earlier run of this folder had another study, source or mode of identities. With `write`,
    save them."""
    mode = "apart" if options.apart else "together"
    fixed = {"project": project_id, "identities": mode, "source": source.where, "place": source.place}
    words = {
        "project": "holds the data of the project {}",
        "identities": "was made with identities {}",
        "source": "was filled from the {}",
        "place": "was filled from the {}",
    }
    is_new = state.fact("project") is None
    for name, value in fixed.items():
        before = state.fact(name)
        if before is not None and before != value:
            other = f"{before} of this machine" if before == "folder" else before
            raise Problem(
                f"{folder} {words[name].format(other)}.",
                f"Name another folder, such as --to {folder}-2, or rename this one.",
            )
        if before is None and write:
            state.set_fact(name, value)
    if is_new and options.apart:
        _restore_numbers(state, folder, write)


def _restore_numbers(state: ExportState, folder: Path, write: bool) -> None:
    """Read the participants' numbers from identities.csv, in case the state was deleted. Raises `Problem` if the folder
    has data and this file is missing."""
    path = folder / PRIVATE / "identities.csv"
    if not path.exists():
        if (folder / manifest.NAME).exists():
            raise Problem(
                f"{folder} holds data with numbers in place of ids, but {path.relative_to(folder)} is missing there.",
                "Put the file back, or name another folder. In another folder people get other numbers.",
            )
        return
    if not write:
        return
    with path.open(encoding="utf-8-sig", newline="") as file:
        for row in csv.DictReader(file):
            user, number = (row.get("userId") or "").removeprefix("'"), row.get("participant") or ""
            if user and number:
                state.find_or_add(user, True, number)


def _damaged(folder: Path, state: ExportState) -> frozenset[str]:
    """The exported files that have changed or are missing. The run fetches their sources again."""
    if not state.file_count():
        return frozenset()
    with _bar("Checking what is here"):
        files = itertools.chain(state.converted_files(), state.raw_files())
        return frozenset(path for path, _ in manifest.damaged(folder, files))


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, which the system releases when the process ends. Raises `Problem` if another run has
    it."""
    import fcntl  # noqa: PLC0415 - not on every system

    with (folder / PRIVATE / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Problem(
                f"Another run is filling {folder}.", "Wait until it is done, or name another folder."
            ) from None
        yield


def _broken_state(folder: Path) -> Problem:
    return Problem(
        f"{folder / _STATE} is damaged.",
        "Delete that one file and run the command again: everything is fetched anew, and numbers stay as they are.",
    )


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
