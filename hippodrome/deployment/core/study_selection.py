"""Finds which study a command is about, and where the study's data are."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass
from pathlib import Path

from hippodrome.console import screen
from hippodrome.console.arguments import folder_argument
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.model import ids

DATA = "data"
"""The folder in the study's folder where `run` keeps data."""
TRIED = "data-try"
"""The folder in the study's folder where `try` keeps the data of each rehearsal."""


@dataclass(frozen=True)
class StudySelection:
    """A study: its id, and its folder if that was named or is the current folder."""

    id: str
    folder: Path | None

    @property
    def as_argument(self) -> str:
        """The argument that names this study on the command line, after a space; "" in the study's own folder."""
        if self.folder is None:
            return f" {self.id}"
        return "" if self.folder == Path() else f" {folder_argument(self.folder)}"


def selected(given: str | None) -> StudySelection:
    """Find the study that STUDY names by its folder or its id; without it, the study of this folder's config.yml.

    Raises `Problem` if there is none, if its id is not well formed, or if a word is a folder and another study's id.
    """
    study = _found(given)
    if study is None:
        raise Problem(
            "No study is named, and none is in this folder.",
            "Name it, by its folder or its id, or run this in its folder.",
            exit_code=Exit.MISUSE,
        )
    if not ids.is_project_id(study.id):
        raise Problem(f"{study.id!r} is no study's id.", "It has letters, digits, dashes and underscores, 64 at most.")
    return study


def one_or_all(study: str | None, every: bool) -> str | None:
    """Return the id of the study that STUDY names (see `selected`); None for `--all`.

    Raises `Problem` as `selected`, and if both or neither are given: a command must not take all studies by itself.
    """
    if every and study is not None:
        raise Problem(f"STUDY ({study}) and --all exclude each other.", "Give one of the two.", exit_code=Exit.MISUSE)
    if every:
        return None
    if study is None and _found(None) is None:
        raise Problem(
            "No study is named, and none is in this folder.",
            "Name one, by its folder or its id; or add --all for all studies of the installation.",
            exit_code=Exit.MISUSE,
        )
    return selected(study).id


def _found(study: str | None) -> StudySelection | None:
    from hippodrome.deployment.core.project_folder import id_in  # noqa: PLC0415 - the checks of config.yml, only where a folder is read

    here = id_in(Path())
    if study is None:
        return None if here is None else StudySelection(here, Path())
    folder = Path(study)
    if "/" in study or os.sep in study or study in {".", ".."}:  # ids have neither slashes nor dots
        study_id = id_in(folder)
        if study_id is None:
            raise Problem(f"{study} has no config.yml with a project id.", "Name the study's folder, or its id.")
        return StudySelection(study_id, folder)
    below = id_in(folder) if folder.is_dir() else None
    if below not in (None, study):
        raise Problem(
            f"{study} may be the folder {study}/ here, whose study is {below}, or the id of another study.",
            f"Write {study}/ for the folder; for the id, run this in another folder.",
            exit_code=Exit.MISUSE,
        )
    return StudySelection(study, folder if below else Path() if study == here else None)


def place_of_data(study: StudySelection, command: str) -> Path | None:
    """Return the study's data folder on this machine; None: its data are on AWS. For commands without --from and --aws.

    `command` is the command line up to the study. If only one place is possible, it is named in a line. If both are, a
    person at a terminal is asked, and `Problem` raised otherwise. Raises it too if the data must be here and are not.
    """
    from hippodrome.deployment.core.project_folder import may_use_aws, uses_aws  # noqa: PLC0415 - as above

    if study.folder is None:
        screen.info(f"On AWS, since {study.id} is no study of this folder.")
        return None
    data = study.folder / DATA
    if not uses_aws(study.folder) and not may_use_aws(study.folder):
        if not data.is_dir():
            raise none_here(study, "They are not on AWS, by its config.yml; to look there all the same, add --aws.")
        screen.info(f"On this machine, in {data}: by its config.yml, {study.id} is not on AWS.")
        return data
    if not data.is_dir():
        tried = _rehearsals(study.folder)
        hint = f" The last rehearsal's data: --from {shlex.quote(str(tried[-1]))}" if tried else ""
        screen.info(f"On AWS, since there is no folder {data} on this machine (`hippodrome run` makes it).{hint}")
        return None
    places = {"here": f"on this machine, in {data}", "aws": "on AWS"}
    answer = screen.choose(f"The data of {study.id} may be in two places. Which are meant?", places)
    if answer is None:
        raise Problem(
            f"The data of {study.id} may be in two places: in {data} on this machine, and on AWS.",
            "Say which are meant:",
            exit_code=Exit.MISUSE,
            commands=[
                f"{command}{study.as_argument} --from {shlex.quote(str(data))}",
                f"{command}{study.as_argument} --aws",
            ],
        )
    return data if answer == "here" else None


def none_here(study: StudySelection, on_aws: str) -> Problem:
    """Explain that a study has no data on this machine. `on_aws` is the advice for data that are on AWS."""
    folder = study.folder or Path()
    tried = _rehearsals(folder)
    return Problem(
        f"There are no data of {study.id} on this machine: there is no folder {folder / DATA}.",
        f"`hippodrome run` makes it. If the data are in another folder, name that with --from. {on_aws}",
        [f"The last rehearsal's data are in {tried[-1]}."] if tried else [],
    )


def _rehearsals(folder: Path) -> list[Path]:
    return sorted((folder / TRIED).glob("try-*"))


def folder_for(study: StudySelection, source: Path | None) -> Path:
    """Return the default folder for converted data: `data-<id>` in the study's folder, or here if that is not known.

    The data of a `source` that is not called `data`, such as a rehearsal's, get `data-<id>-<name of the source>`.
    """
    name = source.resolve().name if source is not None else DATA
    return (study.folder or Path()) / (f"data-{study.id}" if name == DATA else f"data-{study.id}-{name}")
