"""Checks a `trial` section: first each value by itself, then the values against each other (`trial_rules.py`).

`hippodrome/control/config` calls `check` with the section of a registration, and `hippodrome/trial/settings.py` with a
server's section.
"""

from __future__ import annotations

from typing import Any

from hippodrome.protocol import trial_rules, values
from hippodrome.protocol.trial import (
    MAX_OWN_CONTROLS,
    RATE_CHANGE,
    RATE_CHANGE_MISSPELT,
    RESERVED_CONTROLS,
    TrialSection,
)
from hippodrome.protocol.trial_keys import keys, names
from hippodrome.protocol.trial_sections import SceneSection, Ui
from hippodrome.protocol.values import MAX_NAME, Check, KeyPath, SectionProblem, checked, is_blank

_CONTROL = values.text("the name of a control", MAX_NAME)


def check(section: object) -> tuple[TrialSection, list[SectionProblem]]:
    """Return the values of a `trial` section, and all its problems. Never raises.

    `section` holds JSON values, or texts and `values.Plain`. A key without a value counts as not given. The default
    takes the place of a wrong value. Unknown keys are ignored.
    """
    if is_blank(section):
        return TrialSection(), []
    if not isinstance(section, dict):
        _, problems = checked(values.section("actionBufferLifespan: …"), section, ())
        return TrialSection(), problems
    section, problems = _with_one_spelling(section)
    found, wrong = _section(TrialSection, section, ())
    trial, problems = TrialSection(**found), problems + wrong
    given = {key.name for key in keys(TrialSection) if key.attribute in found}
    wrong_keys = {path[0] for path, _, _ in problems}
    between_keys = [problem for rule in trial_rules.RULES for problem in rule(trial, given)]
    return trial, problems + [problem for problem in between_keys if wrong_keys.isdisjoint(problem.compared)]


def _with_one_spelling(section: dict[str, Any]) -> tuple[dict[str, Any], list[SectionProblem]]:
    """The section with the right spelling of `allowFrameRateChange`, which HIPPO's documentation spells in two ways."""
    if RATE_CHANGE_MISSPELT not in section:
        return section, []
    rest = {key: value for key, value in section.items() if key != RATE_CHANGE_MISSPELT}
    if not is_blank(rest.get(RATE_CHANGE)):
        return rest, [SectionProblem((RATE_CHANGE_MISSPELT,), f"{RATE_CHANGE} is given too; keep that one")]
    return rest | {RATE_CHANGE: section[RATE_CHANGE_MISSPELT]}, []


def _section(
    model: type[TrialSection | Ui | SceneSection], section: dict[str, Any], path: KeyPath
) -> tuple[dict[str, Any], list[SectionProblem]]:
    """The valid values by attribute, and the problems."""
    found: dict[str, Any] = {}
    problems: list[SectionProblem] = []
    for key in keys(model):
        value, here = section.get(key.name), (*path, key.name)
        if is_blank(value) or (key.section is Ui and value == {}):
            continue
        value, wrong = checked(key.check, value, here)
        if key.each and not wrong:
            value, wrong = _items(key.each, value, here)
        elif key.entries and not wrong:
            value, wrong = key.entries(value, here)
        elif key.section and not wrong:
            inner, wrong = _section(key.section, value, here)
            value = key.section(**inner)
        problems += wrong
        if not wrong:
            found[key.attribute] = value
    if model is Ui:
        found["own"], wrong = _own_controls(section, path)
        problems += wrong
    return found, problems


def _own_controls(section: dict[str, Any], path: KeyPath) -> tuple[tuple[str, ...], list[SectionProblem]]:
    """The names of the project's own controls in `ui` that are to be shown, in the order of the file."""
    found: list[str] = []
    problems: list[SectionProblem] = []
    for name in [name for name in section if name not in names(Ui)]:
        here = (*path, name)
        shown, wrong = (False, []) if is_blank(section[name]) else checked(values.flag, section[name], here)
        if shown and name in RESERVED_CONTROLS:
            wrong = [SectionProblem(here, "the game's server knows this word already; give the control another name")]
        elif shown:
            _, wrong = checked(_CONTROL, name, here)
        if shown and not wrong:
            found.append(name)
        problems += wrong
    if len(found) > MAX_OWN_CONTROLS:
        sentence = f"must have at most {MAX_OWN_CONTROLS} controls of your own, not {len(found)}"
        problems.insert(0, SectionProblem(path, sentence))
    return tuple(found), problems


def _items(check_item: Check, items: list[object], path: KeyPath) -> tuple[tuple[Any, ...], list[SectionProblem]]:
    read = [checked(check_item, item, (*path, index)) for index, item in enumerate(items)]
    return tuple(value for value, _ in read), [problem for _, wrong in read for problem in wrong]
