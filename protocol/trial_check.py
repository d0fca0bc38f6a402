"""The one function that checks a `trial` section: each value by itself, then how they go together (`trial_rules.py`).

`hippodrome/config` checks a registration, `trial/settings.py` what a server is started with. Both call `check`.
"""

from __future__ import annotations

from typing import Any

from protocol import trial_rules, values
from protocol.trial import MAX_OWN_CONTROLS, RATE_CHANGE, RATE_CHANGE_MISSPELT, TAKEN, TrialSection
from protocol.trial_keys import keys, names
from protocol.trial_sections import SceneSection, Ui
from protocol.values import LONGEST_NAME, Check, Keys, SectionProblem, checked

_CONTROL = values.text("the name of a control", LONGEST_NAME)


def check(section: object) -> tuple[TrialSection, list[SectionProblem]]:
    """The values of a `trial` section, and all that is wrong with it. Never raises.

    `section` holds what JSON can hold, or text and `values.Plain`. A key that is left empty counts as not given.
    A value that is wrong is replaced by its default. Unknown keys are ignored.
    """
    if section is None or section == "":
        return TrialSection(), []
    if not isinstance(section, dict):
        _, problems = checked(values.section("actionBufferLifespan: …"), section, ())
        return TrialSection(), problems
    section, problems = _spelt(section)
    found, wrong = _section(TrialSection, section, ())
    trial, problems = TrialSection(**found), problems + wrong
    given = {key.name for key in keys(TrialSection) if key.attribute in found}
    bad = {path[0] for path, _, _ in problems}
    compared = [problem for rule in trial_rules.RULES for problem in rule(trial, given)]
    return trial, problems + [problem for problem in compared if bad.isdisjoint(problem.compared)]


def _spelt(section: dict[str, Any]) -> tuple[dict[str, Any], list[SectionProblem]]:
    """The section with the right spelling of a key that HIPPO's documentation spells in two ways."""
    if RATE_CHANGE_MISSPELT not in section:
        return section, []
    rest = {key: value for key, value in section.items() if key != RATE_CHANGE_MISSPELT}
    if rest.get(RATE_CHANGE) not in (None, ""):
        return rest, [SectionProblem((RATE_CHANGE_MISSPELT,), f"{RATE_CHANGE} is given too; keep that one")]
    return rest | {RATE_CHANGE: section[RATE_CHANGE_MISSPELT]}, []


def _section(
    model: type[TrialSection | Ui | SceneSection], section: dict[str, Any], path: Keys
) -> tuple[dict[str, Any], list[SectionProblem]]:
    """The good values by attribute, and the problems."""
    found: dict[str, Any] = {}
    problems: list[SectionProblem] = []
    for key in keys(model):
        value, here = section.get(key.name), (*path, key.name)
        if value is None or value == "" or (key.section is Ui and value == {}):
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


def _own_controls(section: dict[str, Any], path: Keys) -> tuple[tuple[str, ...], list[SectionProblem]]:
    """The names of the controls in `ui` that are not ours, and are to be shown."""
    found: list[str] = []
    problems: list[SectionProblem] = []
    for name in section.keys() - names(Ui):
        here = (*path, name)
        shown, wrong = (False, []) if section[name] in (None, "") else checked(values.flag, section[name], here)
        if shown and name in TAKEN:
            wrong = [SectionProblem(here, "the game's server knows this word already; give the control another name")]
        elif shown:
            _, wrong = checked(_CONTROL, name, here)
        if shown and not wrong:
            found.append(name)
        problems += wrong
    if len(found) > MAX_OWN_CONTROLS:
        problems.append(
            SectionProblem(path, f"must have at most {MAX_OWN_CONTROLS} controls of your own, not {len(found)}")
        )
    order = list(section)
    return tuple(sorted(found, key=order.index)), sorted(problems, key=lambda problem: len(problem.path))


def _items(check_item: Check, items: list[object], path: Keys) -> tuple[tuple[Any, ...], list[SectionProblem]]:
    read = [checked(check_item, item, (*path, index)) for index, item in enumerate(items)]
    return tuple(value for value, _ in read), [problem for _, wrong in read for problem in wrong]
