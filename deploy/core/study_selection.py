"""Which study a command is about, and where its data are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from console.problem import Problem
from deploy.core import options
from hippodrome.model import ids

DATA = "data"
"""The folder in the project's where `make run` keeps its data."""
TRIED = "data-try"
"""The folder in the project's where `make try` keeps the data of each rehearsal."""


@dataclass(frozen=True)
class StudySelection:
    """A study: its id, and the project's folder if one was named or is here."""

    id: str
    folder: Path | None


def project_id(given: str | None) -> str:
    """`--project`, or the id in this folder's config.yml. Raises `Problem` if there is neither, or if it is no id."""
    return selected(given).id


def selected(given: str | None) -> StudySelection:
    """The study that `--project` names by its id or its folder, or that of this folder's config.yml.

    Raises `Problem` if there is none, or what is named is no id.
    """
    from deploy.core.project_folder import id_in  # noqa: PLC0415 - pydantic, only where a folder is read

    folder: Path | None = Path(given) if given is not None and options.is_folder(given) else Path(".")
    if given is not None and options.is_folder(given):
        found = options.project_id(given)
    else:
        here = id_in(Path("."))
        found = here if given is None else given
        folder = folder if found == here else None
    if found is None:
        raise Problem("Which project?", "Name it with --project, or run this in the project's folder.")
    if not ids.is_project_id(found):
        raise Problem(f"{found!r} is no project's id.", "It has letters, digits, dashes and underscores, 64 at most.")
    return StudySelection(found, folder)


def local_data(study: StudySelection) -> Path | None:
    """The data folder of a study that is held on this machine; None if its data are on AWS.

    Where config.yml leaves that open (it has awsSetup and no useAWS), they are here as soon as this machine has a
    participant's. Raises `Problem` if the study is for this machine, and there are none.
    """
    from deploy.core.project_folder import may_use_aws, uses_aws  # noqa: PLC0415 - pydantic, only where a folder is read

    if study.folder is None or uses_aws(study.folder):
        return None
    place = study.folder / DATA
    if not place.is_dir():
        if may_use_aws(study.folder):
            return None
        raise none_here(study.id, study.folder, "If they are on AWS, --aws fetches them (with make: ARGS=--aws).")
    return place


def none_here(study: str, folder: Path, on_aws: str) -> Problem:
    """What is said of a study in this folder without data on this machine; `on_aws` is the advice for data on AWS."""
    tried = sorted((folder / TRIED).glob("try-*"))
    return Problem(
        f"There are no data of {study} on this machine: there is no folder {folder / DATA}.",
        f"`make run` makes it. If the data are in another folder, name that with --from (with make: DATA=). {on_aws}",
        [f"The last rehearsal's data are in {tried[-1]}."] if tried else [],
    )


def folder_for(study: str, source: Path | None) -> Path:
    """Where converted data go by default: `data-<project>` here, and for a data folder by another name than
    `data`, such as that of a rehearsal, a folder of its own."""
    name = source.resolve().name if source is not None else DATA
    return Path(f"data-{study}" if name == DATA else f"data-{study}-{name}")
