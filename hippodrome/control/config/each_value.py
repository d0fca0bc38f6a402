"""The first check: each value by itself. Later checks leave out the values with mistakes.

`project_keys` declares `project`. `hippodrome.protocol.trial_check.check` checks `trial`, and also compares its values.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from hippodrome.control.config import design
from hippodrome.control.config.design import Design
from hippodrome.control.config.diagnostics import Mistake
from hippodrome.control.config.project_keys import NAMES, SECTIONS, STEPS, ConfigFile, ProjectKeys
from hippodrome.control.config.step_order import is_step_key
from hippodrome.control.config.unknown_keys import explain, meant_for
from hippodrome.control.model.design import Step
from hippodrome.control.model.step_order import ordered, visited
from hippodrome.control.model.step_types import type_of
from hippodrome.protocol.section_keys import UNKNOWN_KEY, check_section, others_of
from hippodrome.protocol.trial import RATE_CHANGE_MISSPELT, TrialSection
from hippodrome.protocol.trial_check import check as check_trial
from hippodrome.protocol.values import KeyPath

_ENOUGH = 200  # after so many mistakes, unknown keys get no suggestions, because finding one takes time


@dataclass(slots=True)
class Checked:
    """The result of the checks: the valid values, the keys of all steps, the mistakes, and the paths with mistakes."""

    project: ProjectKeys
    step_keys: list[str]
    has_project: bool
    design: Design = field(default_factory=Design)
    trial: TrialSection = field(default_factory=TrialSection)
    mistakes: list[Mistake] = field(default_factory=list)
    invalid: list[KeyPath] = field(default_factory=list)

    @property
    def game_steps(self) -> list[str]:
        """The keys of the game steps."""
        return [key for key, page in self.project.steps.items() if type_of(page).on_server]

    def valid(self, *paths: KeyPath) -> bool:
        """Return whether no mistake is at one of these paths, below it or above it."""
        return not any(
            bad[: len(path)] == path or path[: len(bad)] == bad for bad, path in itertools.product(self.invalid, paths)
        )


def check_values(
    sections: dict[str, Any], invalid: Iterable[KeyPath] = (), named: Mapping[str, str] | None = None
) -> Checked:
    """Check each value of a file's sections by itself.

    Returns the valid values and the mistakes. Paths in `invalid` have mistakes already, and yield no further ones.
    `named` are the pages of steps with names, which a registration has checked already.
    """
    project = sections.get("project")
    registered = design.read(project, sections.get("trial"))
    if named is not None:
        registered.is_named, registered.steps = True, [Step(key, page) for key, page in named.items()]
    if registered.is_named and isinstance(project, dict):
        sections = {**sections, "project": {key: value for key, value in project.items() if key != "steps"}}
    steps = _at(sections, STEPS)
    keys = [key for key in steps if is_step_key(key)] if isinstance(steps, dict) else []
    checked = Checked(ProjectKeys(), ordered(keys), "project" in sections, registered, invalid=list(invalid))
    _check_project({key: value for key, value in sections.items() if key != "trial"}, checked)
    _check_trial(registered, checked)
    _check_design(checked)
    return checked


def _check_design(checked: Checked) -> None:
    """Take over the steps of the design, and check each game with what it has for itself."""
    design_checked = checked.design
    if design_checked.is_named:
        checked.step_keys = list(design_checked.pages)
        checked.project = replace(checked.project, steps=design_checked.pages)
    else:
        pages = checked.project.steps
        design_checked.steps = [Step(key, pages[key]) for key in visited(ordered(pages), pages)]
        design_checked.paths = {key: (*STEPS, key) for key in pages}
    if checked.valid(("trial",)) and not design_checked.mistakes:
        design_checked.steps = design.with_sections(design_checked, checked.trial)
    for mistake in design_checked.mistakes:
        _note(checked, mistake.path, mistake.message)


def _check_project(sections: dict[str, Any], checked: Checked) -> None:
    file, problems = check_section(ConfigFile, sections)
    checked.project = file.project
    for path, sentence, _ in problems:
        if sentence == UNKNOWN_KEY:
            _note_unknown(checked, path)
        else:
            _note(checked, path, sentence)


def _check_trial(registered: Design, checked: Checked) -> None:
    trial = registered.first_trial
    unknown = [mistake.path for mistake in registered.mistakes if mistake.path[:1] == ("trial",)]
    checked.invalid += unknown
    checked.trial, problems = check_trial(trial)
    for path, sentence, compared in problems:
        stands_in = any(named[1 : len(path) + 1] == path for named in unknown)  # "x", which nobody wrote, for a factor
        if not compared and not stands_in:
            _note(checked, ("trial", *path), sentence)
    for path in _unknown_in_trial(trial):
        _note_unknown(checked, path)
    for path, sentence, compared in problems:
        if compared and checked.valid(*(("trial", key) for key in compared)):
            checked.mistakes.append(Mistake(("trial", *path), sentence))


def _unknown_in_trial(trial: Any) -> Iterator[KeyPath]:
    for path, section in SECTIONS.items():
        if path[:1] != ("trial",):
            continue
        present = _at({"trial": trial}, path)
        names = NAMES[path] | ({RATE_CHANGE_MISSPELT} if section is TrialSection else set())
        unknown = ((*path, key) for key in (present if isinstance(present, dict) else ()) if key not in names)
        # A key of `ui` that is not similar to any known key is a control of the project's own.
        yield from (key for key in unknown if others_of(section) is None or meant_for(key) is not None)


def _at(data: Any, path: KeyPath) -> Any:
    for key in path:
        data = data.get(key) if isinstance(data, dict) else None
    return data


def _note_unknown(checked: Checked, path: KeyPath) -> None:
    message, meant = explain(path) if len(checked.mistakes) < _ENOUGH else ("unknown key", [])
    checked.invalid += meant
    _note(checked, path, message)


def _note(checked: Checked, path: KeyPath, message: str) -> None:
    checked.mistakes.append(Mistake(path, message))
    checked.invalid.append(path)
