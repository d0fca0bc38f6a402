"""`hippodrome new`: begins a study of your own with a copy of an example."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from hippodrome import places
from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.config import ConfigErrors
from hippodrome.control.config.folder import ConfigSource, read_source
from hippodrome.control.model import ids

EXAMPLES = "examples"
STUDY_FILES = ("config.yml", "agent.py", "steps", "requirements.txt")
"""The files and folders that belong to the example study in Hippodrome's own folder, and are copied."""
LEFT_OUT = shutil.ignore_patterns("data", "data-*", "erased-*.json", "__pycache__", "*.pyc", ".*")
"""Names the files of a template that are not copied: data, caches and hidden files."""

_FOLDER = "../my-study" if places.IS_CLONE else "my-study"  # an example: nobody's study should lie in the clone
_ANOTHER = "Name a folder that does not exist yet."
_ID = ("project", "id")
_ID_LINE = re.compile(r"(?P<key>\s*id:\s*)[^#\s]+(?P<comment>.*)", re.DOTALL)
_LINK = re.compile(r"\]\((\.\./[^)#\s]+)")
_NOT_IN_AN_ID = re.compile(r"[^A-Za-z0-9_-]+")


@dataclass(frozen=True, slots=True)
class StudyTemplate:
    """A study to copy: its folder, its title, and whether it lies at the top, in Hippodrome's own folder."""

    folder: Path
    title: str
    at_top: bool = False


def templates(root: Path = places.ROOT) -> dict[str, StudyTemplate]:
    """Return the templates by their names: for an example its folder's name, for the study at the top its id."""
    study_templates: dict[str, StudyTemplate] = {}
    top = _source(root)
    if top is not None:
        study_templates[_text(top, _ID)] = StudyTemplate(root, _text(top, ("project", "name")), at_top=True)
    for folder in sorted((root / EXAMPLES).glob("*/")):
        source = _source(folder)
        if source is not None:
            study_templates[folder.name] = StudyTemplate(folder, _text(source, ("project", "name")))
    return study_templates


def listing(study_templates: Mapping[str, StudyTemplate]) -> str:
    """Return the templates as text, a line for each."""
    width = max(map(len, study_templates), default=0)
    return "\n".join(
        [
            "There are these templates:",
            *(f"  {name:{width}}  {study_templates[name].title}" for name in study_templates),
        ]
    )


def make_study(template: StudyTemplate, folder: Path) -> str:
    """Copy the template to `folder`, and give the copy a project id made from the folder's name; return this id.

    Raises Problem if the folder is not empty, if its name makes no id, or if it cannot be written.
    """
    project_id = _id_of(folder)
    _check_folder(template, folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _copy(template, folder)
        _write_id(folder, project_id)
        _adapt_paths(template, folder)
    except OSError as error:
        raise Problem(_not_written(folder, error)) from None
    return project_id


def _not_written(folder: Path, error: OSError) -> str:
    """Say why the folder cannot be written. A copied tree's error lists a source, a target and a reason per file."""
    if isinstance(error, shutil.Error):
        _, target, reason = error.args[0][0]
        return f"{target} cannot be written: {reason.partition('] ')[2].partition(': ')[0] or reason}."
    return f"{folder} cannot be written: {error.strerror or error}."


def what_next(folder: Path) -> str:
    """Return what the researcher can do with a new study: the commands, and the files to change."""
    study = shlex.quote(str(folder))
    lines = [
        "Next:",
        f"  hippodrome run {study}     runs it on this machine; open the link and take part",
        f"  hippodrome check {study}   finds mistakes in what you change",
        f"  hippodrome try {study}     sends simulated participants through it",
        "Change config.yml (title, researcher, steps, game), steps/ (the pages) and agent.py (game and agent).",
    ]
    return "\n".join(lines)


def _check_folder(template: StudyTemplate, folder: Path) -> None:
    """Raise Problem unless the folder is empty or does not exist, and lies outside of the template."""
    there, inside = folder.resolve(), template.folder.resolve()
    if folder.exists() and not folder.is_dir():
        raise Problem(f"{folder} is a file.", _ANOTHER)
    if folder.is_dir() and any(folder.iterdir()):
        raise Problem(f"{folder} is not empty, and nothing in it was changed.", _ANOTHER)
    if not template.at_top and there.is_relative_to(inside):
        raise Problem(f"{folder} lies in the template itself.", "Name a folder outside of it.")


def _copy(template: StudyTemplate, folder: Path) -> None:
    if not template.at_top:
        shutil.copytree(template.folder, folder, ignore=LEFT_OUT, dirs_exist_ok=True)
        return
    for name in STUDY_FILES:
        source = template.folder / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=LEFT_OUT)
        elif source.is_file():
            shutil.copy(source, folder / name)


def _write_id(folder: Path, project_id: str) -> None:
    """Write the id into config.yml, and leave the rest of the file as it is. Raises Problem if the id has no line."""
    source = read_source(folder)
    file = source.layout.config
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    number = source.parsed.lines[_ID] - 1
    match = _ID_LINE.fullmatch(lines[number])
    if match is None:
        raise Problem(f"{file}: the id is not on a line of its own.", f"Write id: {project_id} there yourself.")
    lines[number] = f"{match['key']}{project_id}{match['comment']}"
    file.write_text("".join(lines), encoding="utf-8")


def _adapt_paths(template: StudyTemplate, folder: Path) -> None:
    """In README.md and config.yml, let commands name the new folder and links lead from there to Hippodrome's files."""
    example = re.compile(rf"(?<![\w/]){EXAMPLES}/{re.escape(template.folder.name)}(?=[/\s`,.;:)]|$)")
    for file in (folder / "README.md", folder / "config.yml"):
        if template.at_top or not file.is_file():
            continue
        text = example.sub(lambda _: shlex.quote(str(folder)), file.read_text(encoding="utf-8"))
        text = _LINK.sub(lambda link: f"]({_relative(template.folder / link[1], folder)}", text)
        file.write_text(text, encoding="utf-8")


def _relative(target: Path, folder: Path) -> str:
    """The path of `target` from `folder`, for a link in a file of this folder."""
    return Path(os.path.relpath(target.resolve(), folder.resolve())).as_posix()


def _id_of(folder: Path) -> str:
    """The folder's name with dashes in place of characters that no id has. Raises Problem if that is no id."""
    name = folder.resolve().name
    found = _NOT_IN_AN_ID.sub("-", name).strip("-_")[:64]
    if not ids.is_project_id(found) or found.upper() == "SSL":
        raise Problem(f'No project id can be made from the folder\'s name "{name}".', "Use letters, digits and dashes.")
    return found


def _source(folder: Path) -> ConfigSource | None:
    """The folder's config.yml; None if it cannot be read or has no project id."""
    try:
        source = read_source(folder)
    except ConfigErrors:
        return None
    return source if _text(source, _ID) else None


def _text(source: ConfigSource, path: tuple[str, ...]) -> str:
    return str(source.adapted.at(path) or "")


def command(
    folder: Annotated[
        str,
        typer.Argument(
            metavar="STUDY", help="The folder of the new study; it must be empty or not exist.", show_default=False
        ),
    ] = "",
    template: Annotated[
        str,
        typer.Argument(
            metavar="TEMPLATE", help="The name of the study to copy; left out, all are listed.", show_default=False
        ),
    ] = "",
) -> None:
    """Copy the study TEMPLATE to the folder STUDY, give it an id of its own, and say what to do next."""
    available = templates()
    if not template and not folder:
        screen.result(
            f"Name a folder and a template: hippodrome new {_FOLDER} {next(iter(available), '')}\n{listing(available)}"
        )
        return
    if template not in available:
        raise Problem(
            f"There is no template {template}." if template else "No template is named.",
            listing(available),
            exit_code=Exit.MISUSE,
        )
    if folder in ("", "."):
        raise Problem(
            "No folder is named for the new study.",
            f"Name one: hippodrome new {_FOLDER} {template}",
            exit_code=Exit.MISUSE,
        )
    project_id = make_study(available[template], Path(folder))
    screen.result(f"Made {folder} from {template}; its project id is {project_id}.\n{what_next(Path(folder))}")
