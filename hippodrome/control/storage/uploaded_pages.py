"""Finds the folder of a project's uploaded pages: `{id}/`, as HIPPO's `updateProject.py` has it, or `{id}/steps/`."""

from __future__ import annotations

import re
from collections.abc import Iterable

import msgspec

from hippodrome.control.model.design import Step
from hippodrome.control.model.project import STEPS_FOLDER, Project, step_key
from hippodrome.control.ports import Documents


def at_top(documents: Documents, project_id: str, pages: Iterable[str]) -> set[str]:
    """Return those keys of these pages and of their variants that exist directly below `{id}/`.

    AWS calls: two listings for each page. A listing of the whole folder would include the participants' documents.
    """
    prefixes = [f"{project_id}/{page}{end}" for page in sorted(set(pages)) for end in (".html", "-")]
    return {entry.key for prefix in prefixes for entry in documents.list(prefix)}


def located(documents: Documents, project: Project) -> tuple[Project, list[str]]:
    """Return the project with the folder and the variants of its pages, as they were uploaded.

    The second result has a sentence for each page that was uploaded both with and without numbers. The folder is
    `{id}/`, where HIPPO's script has just written, unless fewer pages are missing in `{id}/steps/`.
    """
    pages = sorted({step.page for step in (*project.steps, *project.pages_in_game) if step.type.has_files})
    top = at_top(documents, project.id, pages)
    below = {entry.key for entry in documents.list(f"{project.id}/{STEPS_FOLDER}/")}
    names = {"": _names(top, project.id, ""), STEPS_FOLDER: _names(below, project.id, STEPS_FOLDER)}
    missing = {
        folder: sum(not (page in name or f"{page}-0" in name) for page in pages) for folder, name in names.items()
    }
    folder = STEPS_FOLDER if missing[STEPS_FOLDER] < missing[""] else ""
    steps, problems = [], []
    for step in project.steps:
        groups = _groups(names[folder], step) if step.type.has_files else 0
        if groups and step.page in names[folder]:
            problems.append(_two_kinds(step, groups))
        steps.append(msgspec.structs.replace(step, variants=groups))
    in_game = {page.key: _groups(names[folder], page) for page in project.pages_in_game}
    return msgspec.structs.replace(project, steps=steps, game_pages=in_game, page_folder=folder), problems


def _names(keys: Iterable[str], project_id: str, folder: str) -> set[str]:
    """The names, without `.html`, of the pages with these keys."""
    before, _, after = step_key(project_id, "\0", folder).partition("\0")
    return {key.removeprefix(before).removesuffix(after) for key in keys if key.endswith(after)}


def _groups(names: Iterable[str], step: Step) -> int:
    """The number of a page's variants: the highest number plus 1, so that a missing one is noticed; 0 without `-0`."""
    pattern = re.compile(re.escape(step.page) + r"-(0|[1-9][0-9]{0,2})")
    numbers = {int(match[1]) for name in names if (match := pattern.fullmatch(name))}
    return max(numbers) + 1 if 0 in numbers else 0


def _two_kinds(step: Step, groups: int) -> str:
    """The problem of a page that was uploaded both with and without numbers."""
    return (
        f"project.steps.{step.key}: both {step.page}.html and {step.page}-0.html have been uploaded. HIPPO Gym shows "
        f"the first to one more group; here groups are numbered: upload it as {step.page}-{groups}.html, remove "
        f"{step.page}.html, and register with `hippodrome register`, since updateProject.py uploads it again"
    )
