"""Checks a registration from outside as if it were a config.yml."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from hippodrome.control.config import project_keys, sessions
from hippodrome.control.config.config import Config, StepFiles
from hippodrome.control.config.consistency import check
from hippodrome.control.config.design import RegisteredDesign, read_registered
from hippodrome.control.config.diagnostics import ConfigErrors, Diagnostic, Mistake, in_order
from hippodrome.control.config.project_keys import STEPS
from hippodrome.control.model.design import Step as DesignedStep
from hippodrome.control.model.project import STEPS_FOLDER, number_of_groups
from hippodrome.control.model.step_order import FINAL, ordered, visited
from hippodrome.control.model.step_types import type_of
from hippodrome.control.ports import PORTS
from hippodrome.protocol import section_keys as keyed
from hippodrome.protocol import values
from hippodrome.protocol.section_keys import Section, check_section
from hippodrome.protocol.values import checked as checked_value
from hippodrome.protocol.values import path_text

MESSAGE = "message"  # stands in the place of a file name in the mistakes of a registration
LIMIT_VARIANTS = 1000

_OURS = ("taskDefinition", "serverPort", "pageFolder", "gamePages")  # keys that no config.yml may have
_DESIGN = ("conditions", "blocks", "ends")
_OF_A_DESIGN = frozenset(DesignedStep.__struct_encode_fields__) - {"key", "page", "variants"}
_TASK_DEFINITION = re.compile(r"[A-Za-z0-9:/_.-]{1,255}")


@dataclass(frozen=True, slots=True)
class _Step(Section):
    key: str = keyed.text("", "", project_keys.any_step_key)
    page: str = keyed.text("", "", project_keys.designed_page)
    variants: int = keyed.whole(0, LIMIT_VARIANTS, 0, "")


def parse_registration(data: object) -> dict[str, Any]:
    """Check a registration from outside as if it were a config.yml, and return it with all defaults filled in.

    Unlike a config.yml, it may name the task definition that its servers run, the port on which they listen, the folder
    of the pages, and the versions of the pages in the game. Raises ConfigErrors, with "message" for the file name.
    """
    if not isinstance(data, dict):
        raise ConfigErrors([Diagnostic(MESSAGE, None, "", "a registration must be a JSON object")])
    steps, mistakes = _steps_in(data.get("steps"))
    project = {key: value for key, value in data.items() if key not in ("trial", "steps", *_OURS, *_DESIGN)}
    pages = {step.key: step.page for step in steps}
    has_names = any(key != FINAL and not key.isdecimal() for key in pages)
    if not mistakes and not has_names:
        project["steps"] = pages
    checked = check({"project": project, "trial": data.get("trial")}, named=pages if has_names else None)
    registered = _design_in(data, mistakes)
    if mistakes:
        checked.mistakes = [mistake for mistake in checked.mistakes if mistake.path[:2] != STEPS] + mistakes
    task = {key: data[key] for key in _OURS if key in data}
    checked.mistakes += [*_task_mistakes(task), *_page_mistakes(task.get("gamePages", {}), checked.trial.pages)]
    if not checked.mistakes:
        variants = [*(step.variants for step in steps), *task.get("gamePages", {}).values()]
        checked.mistakes += sessions.mistakes_of_groups(checked, number_of_groups(variants))
    if checked.mistakes:
        order = {step.key: index for index, step in enumerate(steps)}
        raise ConfigErrors(in_order(_diagnostic(mistake, order) for mistake in checked.mistakes))
    assert registered is not None
    checked.design.steps = registered.steps
    checked.design.conditions, checked.design.blocks = registered.conditions, registered.blocks
    checked.design.ends = registered.ends
    by_key = {step.key: step for step in registered.steps}
    shown = visited(checked.step_keys, checked.project.steps)
    own = [StepFiles(s.key, s.page, s.variants, step=by_key.get(s.key)) for s in steps if s.key in shown]
    config = Config.of(checked, own)
    return config.registration() | {"gamePages": dict.fromkeys(config.trial.pages, 0)} | task


def _design_in(data: Mapping[str, Any], mistakes: list[Mistake]) -> RegisteredDesign | None:
    """The design of a registration; None after a mistake, which is added to `mistakes`."""
    if mistakes:
        return None
    try:
        return read_registered(data)
    except ValueError as error:
        mistakes.append(Mistake(STEPS, str(error)))
        return None


def _task_mistakes(task: Mapping[str, Any]) -> Iterator[Mistake]:
    name, port = task.get("taskDefinition", "none"), task.get("serverPort", PORTS[0])
    if not (isinstance(name, str) and _TASK_DEFINITION.fullmatch(name)):
        message = "must be the name or ARN of a task definition: 1 to 255 letters, digits and :/_.-"
        yield Mistake(("taskDefinition",), message)
    if isinstance(port, bool) or port not in PORTS:
        yield Mistake(("serverPort",), f"must be {' or '.join(map(str, PORTS))}")
    if task.get("pageFolder", STEPS_FOLDER) not in (STEPS_FOLDER, ""):
        yield Mistake(("pageFolder",), f'must be {STEPS_FOLDER}, or "" for pages right below the project\'s id')


def _page_mistakes(variants: object, pages: Mapping[str, str]) -> Iterator[Mistake]:
    if not isinstance(variants, dict) or not variants.keys() <= pages.keys():
        yield Mistake(("gamePages",), "must be a map of the keys of trial that name a page")
        return
    for key, number in variants.items():
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= LIMIT_VARIANTS:
            yield Mistake(("gamePages", key), f"must be a number of groups, 0 to {LIMIT_VARIANTS}")


def _diagnostic(mistake: Mistake, order: Mapping[str, int]) -> Diagnostic:
    path = mistake.path[1:] if mistake.path[:1] == ("project",) else mistake.path
    if path[:1] == ("steps",) and len(path) > 1 and path[1] in order:
        path = ("steps", order[str(path[1])], *path[2:])
    return Diagnostic(MESSAGE, None, path_text(path), mistake.message)


def _steps_in(data: object) -> tuple[list[_Step], list[Mistake]]:
    """The steps of a registration, and the mistakes in them: each step is checked by itself, then their order."""
    if not isinstance(data, list) or not data or len(data) > project_keys.MAX_STEPS + 1:
        return [], [Mistake(STEPS, f"must be a list of 1 to {project_keys.MAX_STEPS} steps")]
    steps: list[_Step] = []
    mistakes: list[Mistake] = []
    for index, item in enumerate(data):
        path = (*STEPS, index)
        plain = {key: item[key] for key in item if key not in _OF_A_DESIGN} if isinstance(item, dict) else item
        fields, wrong = checked_value(values.section("key: value"), plain, path)
        step, wrong = check_section(_Step, fields, path) if not wrong else (_Step(), wrong)
        if wrong:
            mistakes += [Mistake(problem.path, problem.sentence) for problem in wrong]
            continue
        if not step.key or not step.page:
            mistakes.append(Mistake(path, "must have key and page"))
        elif step.variants and not type_of(step.page).has_files:
            mistakes.append(Mistake(path, "is a game step, so it cannot have variants; leave them out"))
        steps.append(step)
    keys = [step.key for step in steps]
    if not mistakes and (len(set(keys)) < len(keys) or keys != ordered(keys)):
        mistakes.append(Mistake(STEPS, f"must be in order, 1, 2, 3 … and perhaps {FINAL}, each once"))
    return steps, mistakes
