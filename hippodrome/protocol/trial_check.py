"""Checks a `trial` section: first each value by itself, then the values against each other (`trial_rules.py`).

`hippodrome/control/config` calls `check` with the section of a registration, and `hippodrome/trial/settings.py` with a
server's section.
"""

from __future__ import annotations

from typing import Any

from hippodrome.protocol import trial_rules, values
from hippodrome.protocol.section_keys import UNKNOWN_KEY, check_section
from hippodrome.protocol.trial import RATE_CHANGE, RATE_CHANGE_MISSPELT, TALK, TrialSection
from hippodrome.protocol.values import SectionProblem, checked, is_blank


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
    trial, wrong = check_section(TrialSection, section)
    problems += [problem for problem in wrong if problem.sentence != UNKNOWN_KEY]
    wrong_keys = {path[0] for path, _, _ in problems}
    trial = trial.without(wrong_keys)
    trial = trial.as_talk() if trial.game == TALK else trial
    between_keys = [problem for rule in trial_rules.RULES for problem in rule(trial)]
    return trial, problems + [problem for problem in between_keys if wrong_keys.isdisjoint(problem.compared)]


def _with_one_spelling(section: dict[str, Any]) -> tuple[dict[str, Any], list[SectionProblem]]:
    """The section with the right spelling of `allowFrameRateChange`, which HIPPO's documentation spells in two ways."""
    if RATE_CHANGE_MISSPELT not in section:
        return section, []
    rest = {key: value for key, value in section.items() if key != RATE_CHANGE_MISSPELT}
    if not is_blank(rest.get(RATE_CHANGE)):
        return rest, [SectionProblem((RATE_CHANGE_MISSPELT,), f"{RATE_CHANGE} is given too; keep that one")]
    return rest | {RATE_CHANGE: section[RATE_CHANGE_MISSPELT]}, []
