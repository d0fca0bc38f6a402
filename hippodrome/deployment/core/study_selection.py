"""Finds which study a command is about, and where the study's data are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hippodrome.console.problem import Problem
from hippodrome.control.model import ids
from hippodrome.deployment.core import options

DATA = "data"
"""The folder in the project's folder where `make run` keeps data."""
TRIED = "data-try"
"""The folder in the project's folder where `make try` keeps the data of each rehearsal."""


@dataclass(frozen=True)
class StudySelection:
    """A study: its id, and its project folder if that was named or is the current folder."""

    id: str
    folder: Path | None


def project_id(given: str | None) -> str:
    """Find the study as `selected` does, and return its id. Raises `Problem` as `selected` does."""
    return selected(given).id


def selected(given: str | None) -> StudySelection:
    """Find the study that `--project` names by its id or folder; without it, the study of this folder's config.yml.

    Raises `Problem` if there is none, or if its id is not well formed.
    """
    from hippodrome.deployment.core.project_folder import id_in  # noqa: PLC0415 - the checks of config.yml, only where a folder is read

    folder: Path | None = Path(".")
    if given is not None and options.is_folder(given):
        folder, found = Path(given), options.project_id(given)
    else:
        here = id_in(Path("."))
        found = here if given is None else given
        folder = folder if found == here else None
    if found is None:
        raise Problem("No project is named, and none is in this folder.", "Add --project, or run this in its folder.")
    if not ids.is_project_id(found):
        raise Problem(f"{found!r} is no project's id.", "It has letters, digits, dashes and underscores, 64 at most.")
    return StudySelection(found, folder)


def local_data(study: StudySelection) -> Path | None:
    """Return the data folder of a study on this machine; None if its data are on AWS.

    Where config.yml leaves that open (it has awsSetup and no useAWS), the data are here if the folder `data` exists.
    Raises `Problem` if it runs on this machine, and the folder does not exist.
    """
    from hippodrome.deployment.core.project_folder import may_use_aws, uses_aws  # noqa: PLC0415 - the checks of config.yml, only where a folder is read

    if study.folder is None or uses_aws(study.folder):
        return None
    place = study.folder / DATA
    if not place.is_dir():
        if may_use_aws(study.folder):
            return None
        raise none_here(study.id, study.folder, "If they are on AWS, add --aws (with make: ARGS=--aws).")
    return place


def none_here(study: str, folder: Path, on_aws: str) -> Problem:
    """Explain that a study has no data on this machine. `on_aws` is the advice for data that are on AWS."""
    tried = sorted((folder / TRIED).glob("try-*"))
    return Problem(
        f"There are no data of {study} on this machine: there is no folder {folder / DATA}.",
        f"`make run` makes it. If the data are in another folder, name that with --from (with make: DATA=). {on_aws}",
        [f"The last rehearsal's data are in {tried[-1]}."] if tried else [],
    )


def folder_for(study: str, source: Path | None) -> Path:
    """Return the default folder for converted data: `data-<project>` in the current folder.

    The data of a `source` that is not called `data`, such as a rehearsal's, get `data-<project>-<name of the source>`.
    """
    name = source.resolve().name if source is not None else DATA
    return Path(f"data-{study}" if name == DATA else f"data-{study}-{name}")
