"""First pass: each value by itself, by the models. What is wrong is noted and left out of what follows."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from hippodrome.config import values
from hippodrome.config.models import MISSPELT, RIGHT, SECTIONS, STEPS, Root
from hippodrome.config.order import is_step_key, ordered
from hippodrome.config.problems import Finding, Keys, where_of
from hippodrome.config.values import FINAL

_ENOUGH = 200  # mistakes after which unknown keys get no suggestions, which take time to find


@dataclass(slots=True)
class Checked:
    """What the passes share: the good values, the keys of all steps, what was found, and where no more need be said."""

    root: Root
    step_keys: list[str]
    has_project: bool
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
    early = list(_respell(tree))
    steps = _at(tree, STEPS)
    keys = [key for key in steps if is_step_key(key)] if isinstance(steps, dict) else []
    checked = Checked(Root(), ordered(keys), "project" in tree, early, list(spoilt))
    while True:
        try:
            checked.root = Root.model_validate(tree)
            return checked
        except ValidationError as error:
            _take(error.errors(include_url=False), checked, tree)


def _copy(tree: Any, depth: int = 5) -> Any:
    """A copy to change, as deep as sections and lists go: a message can be nested without end."""
    if isinstance(tree, dict) and depth:
        return {str(key): _copy(value, depth - 1) for key, value in tree.items()}
    return [_copy(item, depth - 1) for item in tree] if isinstance(tree, list) and depth else tree


def _at(tree: Any, path: Keys) -> Any:
    for key in path:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def _respell(tree: dict[str, Any]) -> Iterator[Finding]:
    """Takes HIPPO's misspelt key for the right one, and a finalStep left empty for none."""
    trial, steps = tree.get("trial"), _at(tree, STEPS)
    if isinstance(trial, dict) and MISSPELT in trial:
        if trial.get(RIGHT) is not None:
            yield Finding(("trial", MISSPELT), f"{RIGHT} is given too; keep that one")
            trial.pop(MISSPELT)
        else:
            trial[RIGHT] = trial.pop(MISSPELT)
    if isinstance(steps, dict) and steps.get(FINAL, "") in (None, ""):
        steps.pop(FINAL, None)


def _take(errors: Sequence[ErrorDetails], checked: Checked, tree: dict[str, Any]) -> None:
    """Notes the errors in our words, and takes what they concern out of the tree."""
    for error in errors:
        path: Keys = error["loc"]
        if path[:2] == STEPS:
            path = path[:3]  # pydantic adds a mark where a key, not its value, is wrong
        message = words(error, path)
        if error["type"] == "extra_forbidden":
            message, meant = _unknown(path) if len(checked.findings) < _ENOUGH else ("unknown key", [])
            checked.spoilt += meant
        checked.findings.append(Finding(path, message))
        checked.spoilt.append(path)
        _remove(tree, path)


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
    model = SECTIONS.get(path)
    example = "1: consent" if path == STEPS else f"{min(model.names())}: …" if model else "key: value"
    return f'must be a section: indented lines such as "{example}" below it, not {values.show(error["input"])}'


def _unknown(path: Keys) -> tuple[str, list[Keys]]:
    """What to say about an unknown key, and the path it was meant for."""
    section, key = path[:-1], str(path[-1])
    own = "a key of your agent's own goes under trial.options" if section == ("trial",) else ""
    homes = [home for home, model in SECTIONS.items() if key in model.names()]
    if key == FINAL or key.isdecimal():
        homes = [STEPS]
    if homes:
        home = homes[0]
        place = f"under {where_of(home)}" if home else "at the top of the file, not indented"
        return f"unknown key; it belongs {place} (check the indentation)", [(*home, key)]
    for home in (section, *SECTIONS):
        names = {name.lower(): name for name in sorted(SECTIONS[home].names())}
        near = difflib.get_close_matches(key.lower(), names, n=1, cutoff=0.6 if home == section else 0.8)
        if near:
            meant = (*home, names[near[0]])
            question = f"did you mean {meant[-1] if home == section else where_of(meant)}?"
            return f"unknown key; {question}" + (f" If not, {own}" if own else ""), [meant]
    names_here = sorted(SECTIONS[section].names())
    known = f"the keys here are {', '.join(names_here)}" if len(names_here) <= 5 else "docs/config.md lists all keys"
    return f"unknown key; {known}" + (f"; {own}" if own else ""), []
