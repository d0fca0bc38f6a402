"""First pass: each value by itself. What is wrong is noted and left out of what follows.

The models check `project`; `protocol.trial.check` checks `trial`, also its values against each other.
"""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from hippodrome.config.models import NAMES, STEPS, TRIAL_SECTIONS, Root
from hippodrome.config.order import is_step_key, ordered
from hippodrome.config.problems import Finding, Keys, where_of
from hippodrome.config.values import FINAL
from protocol.trial import MISSPELT, Trial, names
from protocol.trial import check as check_trial
from protocol.values import show

_ENOUGH = 200  # mistakes after which unknown keys get no suggestions, which take time to find


@dataclass(slots=True)
class Checked:
    """What the passes share: the good values, the keys of all steps, what was found, and where no more need be said."""

    root: Root
    step_keys: list[str]
    has_project: bool
    trial: Trial = field(default_factory=Trial)
    findings: list[Finding] = field(default_factory=list)
    spoilt: list[Keys] = field(default_factory=list)

    def sound(self, *paths: Keys) -> bool:
        """Whether nothing was found at, in or around these paths."""
        return not any(
            bad[: len(path)] == path or path[: len(bad)] == bad for bad, path in itertools.product(self.spoilt, paths)
        )


def check_values(tree: dict[str, Any], spoilt: Iterable[Keys] = ()) -> Checked:
    """The good values of a tree of sections, and what is wrong with the others.

    About what is `spoilt` already, no more is said.
    """
    tree = _copy(tree)
    about_trial = tree.pop("trial", None)
    steps = _at(tree, STEPS)
    keys = [key for key in steps if is_step_key(key)] if isinstance(steps, dict) else []
    if isinstance(steps, dict) and steps.get(FINAL, "") in (None, ""):
        steps.pop(FINAL, None)  # left empty, it counts as not given
    checked = Checked(Root(), ordered(keys), "project" in tree, spoilt=list(spoilt))
    _check_project(tree, checked)
    _check_trial(about_trial, checked)
    return checked


def _check_project(tree: dict[str, Any], checked: Checked) -> None:
    while True:
        try:
            checked.root = Root.model_validate(tree)
            return
        except ValidationError as error:
            _take(error.errors(include_url=False), checked, tree)


def _check_trial(tree: Any, checked: Checked) -> None:
    checked.trial, problems = check_trial(tree)
    for path, sentence, compared in problems:
        if not compared:
            _note(checked, ("trial", *path), sentence)
    for path in _unknown_in_trial(tree):
        _note_unknown(checked, path)
    for path, sentence, compared in problems:
        if compared and checked.sound(*(("trial", key) for key in compared)):
            checked.findings.append(Finding(("trial", *path), sentence))


def _unknown_in_trial(tree: Any) -> Iterator[Keys]:
    for path, section in TRIAL_SECTIONS.items():
        given = _at({"trial": tree}, path)
        known = names(section) | ({MISSPELT} if section is Trial else set())
        yield from ((*path, key) for key in (given if isinstance(given, dict) else ()) if key not in known)


def _copy(tree: Any, depth: int = 5) -> Any:
    """A copy to change, as deep as sections and lists go: a message can be nested without end."""
    if isinstance(tree, dict) and depth:
        return {str(key): _copy(value, depth - 1) for key, value in tree.items()}
    return [_copy(item, depth - 1) for item in tree] if isinstance(tree, list) and depth else tree


def _at(tree: Any, path: Keys) -> Any:
    for key in path:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def _take(errors: Sequence[ErrorDetails], checked: Checked, tree: dict[str, Any]) -> None:
    """Notes the errors in our words, and takes what they concern out of the tree."""
    for error in errors:
        path: Keys = error["loc"]
        if path[:2] == STEPS:
            path = path[:3]  # pydantic adds a mark where a key, not its value, is wrong
        if error["type"] == "extra_forbidden":
            _note_unknown(checked, path)
        else:
            _note(checked, path, words(error, path))
        _remove(tree, path)


def _note_unknown(checked: Checked, path: Keys) -> None:
    message, meant = _unknown(path) if len(checked.findings) < _ENOUGH else ("unknown key", [])
    checked.spoilt += meant
    _note(checked, path, message)


def _note(checked: Checked, path: Keys, message: str) -> None:
    checked.findings.append(Finding(path, message))
    checked.spoilt.append(path)


def _remove(tree: Any, path: Keys) -> None:
    """Removes the value at `path`; for an item of a list, the list."""
    keys = list(itertools.takewhile(lambda key: isinstance(key, str), path))
    for key in keys[:-1]:
        tree = tree.get(key, {})
    tree.pop(keys[-1], None)


def words(error: ErrorDetails, path: Keys) -> str:
    """What pydantic found, in our words."""
    if "ctx" in error and isinstance(error["ctx"].get("error"), ValueError):
        return str(error["ctx"]["error"])
    known = NAMES.get(path)
    example = "1: consent" if path == STEPS else f"{min(known)}: …" if known else "key: value"
    return f'must be a section: indented lines such as "{example}" below it, not {show(error["input"])}'


def _unknown(path: Keys) -> tuple[str, list[Keys]]:
    """What to say about an unknown key, and the path it was meant for."""
    section, key = path[:-1], str(path[-1])
    own = "a key of your agent's own goes under trial.options" if section == ("trial",) else ""
    homes = [home for home, known in NAMES.items() if key in known]
    if key == FINAL or key.isdecimal():
        homes = [STEPS]
    if homes:
        home = homes[0]
        place = f"under {where_of(home)}" if home else "at the top of the file, not indented"
        return f"unknown key; it belongs {place} (check the indentation)", [(*home, key)]
    for home in (section, *NAMES):
        names = {name.lower(): name for name in sorted(NAMES[home])}
        near = difflib.get_close_matches(key.lower(), names, n=1, cutoff=0.6 if home == section else 0.8)
        if near:
            meant = (*home, names[near[0]])
            question = f"did you mean {meant[-1] if home == section else where_of(meant)}?"
            return f"unknown key; {question}" + (f" If not, {own}" if own else ""), [meant]
    names_here = sorted(NAMES[section])
    which = f"the keys here are {', '.join(names_here)}" if len(names_here) <= 5 else "docs/config.md lists all keys"
    return f"unknown key; {which}" + (f"; {own}" if own else ""), []
