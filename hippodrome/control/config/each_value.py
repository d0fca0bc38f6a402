"""The first check: each value by itself. Later checks leave out the values with mistakes.

`project_keys` checks `project`. `hippodrome.protocol.trial_check.check` checks `trial`, and also compares its values.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from hippodrome.control.config.diagnostics import Mistake
from hippodrome.control.config.project_keys import NAMES, STEPS, TEXTS, TRIAL_SECTIONS, ProjectKeys, Root
from hippodrome.control.config.step_order import is_step_key
from hippodrome.control.config.unknown_keys import explain, meant_for
from hippodrome.control.model.step_order import FINAL, ordered
from hippodrome.control.model.step_types import type_of
from hippodrome.protocol.trial import RATE_CHANGE_MISSPELT, TrialSection
from hippodrome.protocol.trial_check import check as check_trial
from hippodrome.protocol.trial_keys import names
from hippodrome.protocol.trial_sections import Ui
from hippodrome.protocol.values import KeyPath, is_blank, show

_EXAMPLES: dict[KeyPath, str] = {STEPS: "1: consent", TEXTS: 'start: "Los"'}  # where NAMES has no keys
_ENOUGH = 200  # after so many mistakes, unknown keys get no suggestions, because finding one takes time


@dataclass(slots=True)
class Checked:
    """The result of the checks: the valid values, the keys of all steps, the mistakes, and the paths with mistakes."""

    project: ProjectKeys
    step_keys: list[str]
    has_project: bool
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


def check_values(sections: dict[str, Any], invalid: Iterable[KeyPath] = ()) -> Checked:
    """Check each value of a file's sections by itself.

    Returns the valid values and the mistakes. Paths in `invalid` have mistakes already, and yield no further ones.
    """
    sections = _copy(sections)
    about_trial = sections.pop("trial", None)
    steps = _at(sections, STEPS)
    keys = [key for key in steps if is_step_key(key)] if isinstance(steps, dict) else []
    if isinstance(steps, dict) and is_blank(steps.get(FINAL)):
        steps.pop(FINAL, None)
    checked = Checked(ProjectKeys(), ordered(keys), "project" in sections, invalid=list(invalid))
    _check_project(sections, checked)
    _check_trial(about_trial, checked)
    return checked


def _check_project(sections: dict[str, Any], checked: Checked) -> None:
    while True:
        try:
            checked.project = Root.model_validate(sections).project
            return
        except ValidationError as error:
            _take(error.errors(include_url=False), checked, sections)


def _check_trial(given: Any, checked: Checked) -> None:
    checked.trial, problems = check_trial(given)
    for path, sentence, compared in problems:
        if not compared:
            _note(checked, ("trial", *path), sentence)
    for path in _unknown_in_trial(given):
        _note_unknown(checked, path)
    for path, sentence, compared in problems:
        if compared and checked.valid(*(("trial", key) for key in compared)):
            checked.mistakes.append(Mistake(("trial", *path), sentence))


def _unknown_in_trial(trial: Any) -> Iterator[KeyPath]:
    for path, section in TRIAL_SECTIONS.items():
        given = _at({"trial": trial}, path)
        known = names(section) | ({RATE_CHANGE_MISSPELT} if section is TrialSection else set())
        unknown = ((*path, key) for key in (given if isinstance(given, dict) else ()) if key not in known)
        # A key of `ui` that is not similar to any known key is a control of the project's own.
        yield from (one for one in unknown if section is not Ui or meant_for(one) is not None)


def _copy(data: Any, depth: int = 5) -> Any:
    """A copy of the sections and lists of the first `depth` levels, so that these may be changed.

    No valid config.yml has more levels. A message may: what lies deeper is not copied.
    """
    if isinstance(data, dict) and depth:
        return {str(key): _copy(value, depth - 1) for key, value in data.items()}
    return [_copy(item, depth - 1) for item in data] if isinstance(data, list) and depth else data


def _at(data: Any, path: KeyPath) -> Any:
    for key in path:
        data = data.get(key) if isinstance(data, dict) else None
    return data


def _take(errors: Sequence[ErrorDetails], checked: Checked, sections: dict[str, Any]) -> None:
    """Note pydantic's errors as mistakes, and remove the wrong values from the sections."""
    for error in errors:
        path: KeyPath = error["loc"]
        if path[:2] in (STEPS, TEXTS):
            path = path[:3]  # if a key itself is wrong, pydantic adds a mark to the path
        if error["type"] == "extra_forbidden":
            _note_unknown(checked, path)
        else:
            _note(checked, path, message_of(error, path))
        _remove(sections, path)


def _note_unknown(checked: Checked, path: KeyPath) -> None:
    message, meant = explain(path) if len(checked.mistakes) < _ENOUGH else ("unknown key", [])
    checked.invalid += meant
    _note(checked, path, message)


def _note(checked: Checked, path: KeyPath, message: str) -> None:
    checked.mistakes.append(Mistake(path, message))
    checked.invalid.append(path)


def _remove(data: Any, path: KeyPath) -> None:
    """Remove the value at `path`; for an item of a list, remove the list."""
    keys = list(itertools.takewhile(lambda key: isinstance(key, str), path))
    for key in keys[:-1]:
        data = data.get(key, {})
    data.pop(keys[-1], None)


def message_of(error: ErrorDetails, path: KeyPath) -> str:
    """Return Hippodrome's message for an error of pydantic at this path."""
    if "ctx" in error and isinstance(error["ctx"].get("error"), ValueError):
        return str(error["ctx"]["error"])
    known = NAMES.get(path)
    example = _EXAMPLES.get(path) or (f"{min(known)}: …" if known else "key: value")
    return f'must be a section: indented lines such as "{example}" below it, not {show(error["input"])}'
