"""Translates a config.yml of HIPPO Gym into Hippodrome's form, with a remark on each change.

`adapt` is pure. docs/hippo.md has a row for each key of HIPPO's documentation and code (v0.1.0 to v1.1.0).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hippodrome.control.config.diagnostics import Remark
from hippodrome.control.config.project_keys import MAX_STEPS, NAMES, STEPS
from hippodrome.control.config.unknown_keys import meant_for
from hippodrome.control.model import ids
from hippodrome.control.model.step_order import FINAL
from hippodrome.protocol.trial import HIGHEST_RATE, RATE_CHANGE, RATE_CHANGE_MISSPELT, TrialSection
from hippodrome.protocol.values import KeyPath, Plain, flag, is_blank, number_in, path_text, show

CLOSING_PAGE = "hippodrome-the-end"
"""The last page of a study without pages (`step_files.CLOSING`)."""
SSL_NO_EFFECT = "no effect: servers get the certificate of the installation"
"""The remark on the section `ssl`."""

_CPU, _MEMORY = 2, 10  # vCPUs and GB: the defaults of HIPPO's updateProject.py
_SPELLINGS: dict[KeyPath, str] = {
    ("project", "step"): "steps",  # in HIPPO's documentation
    ("project", "team_members"): "teamMembers",  # in HIPPO's update_project_master_list
}
_GENERATED: dict[KeyPath, str] = {
    ("project", "ecsTask"): "the task definition is named after the stack and the project's id",
    ("project", "bucket"): "the bucket is the installation's; project.awsSetup.bucket may name it",
    ("project", "awsSetup", "containerName"): "the container is named by Hippodrome",
    ("project", "awsSetup", "repository"): "images lie in the installation's repository",
    ("project", "awsSetup", "repositoryUri"): "images lie in the installation's repository",
    ("trial", "projectId"): "servers know the project's id",
    ("trial", "bucket"): "servers know where recordings go",
}
"""Keys that HIPPO's updateProject.py adds. A configuration that was copied from its files has them."""


@dataclass
class Adapted:
    """A document in Hippodrome's form. `remarks` have paths of the original document.

    `origins` has the original path of each value that was moved, by its path in `values`.
    """

    values: dict[str, Any]
    remarks: list[Remark] = field(default_factory=list)
    origins: dict[KeyPath, KeyPath] = field(default_factory=dict)

    def origin(self, path: KeyPath) -> KeyPath:
        """Return the path in the original document."""
        for end in range(len(path), 0, -1):
            if path[:end] in self.origins:
                return (*self.origins[path[:end]], *path[end:])
        return path

    def at(self, path: KeyPath) -> Any:
        """Return the value at the path; None if there is none."""
        value: Any = self.values
        for key in path:
            value = value.get(key) if isinstance(value, dict) else None
        return value

    def section(self, path: KeyPath) -> dict[str, Any]:
        """Return the section at the path; {}, which is no part of the document, if there is none."""
        value = self.at(path)
        return value if isinstance(value, dict) else {}

    def remark(self, path: KeyPath, message: str) -> None:
        self.remarks.append(Remark(self.origin(path), message))


def adapt(document: Mapping[str, Any], name: str = "") -> Adapted:
    """Return a HIPPO document in Hippodrome's form. Values that are wrong in both forms stay, for the check to report.

    `document` holds the sections as read from YAML or JSON; it is not changed. `name` is the id of a project whose id
    is empty, such as the name of its folder.
    """
    adapted = Adapted(_copy(document))
    rules: tuple[Callable[[Adapted], None], ...] = (
        _spellings,
        _generated,
        lambda tree: _id(tree, name),
        _live,
        _page_names,
        _steps,
        _stop_step,
        _size,
        _no_game,
        _controls,
        _actions,
        _frame_rates,
        _instructions,
        _unknown,
    )
    for rule in rules:
        rule(adapted)
    return adapted


def _copy(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _copy(item) for key, item in value.items()}
    return [_copy(item) for item in value] if isinstance(value, list) else value


# project


def _spellings(adapted: Adapted) -> None:
    for path, right in _SPELLINGS.items():
        section = adapted.section(path[:-1])
        if path[-1] in section and is_blank(section.get(right)):
            section[right] = section.pop(str(path[-1]))
            adapted.origins[(*path[:-1], right)] = path
            adapted.remark(path, f"read as {right}")


def _generated(adapted: Adapted) -> None:
    for path, here in _GENERATED.items():
        section = adapted.section(path[:-1])
        if path[-1] in section:
            del section[str(path[-1])]
            adapted.remark(path, f"no effect; {here}")


def _id(adapted: Adapted, name: str) -> None:
    """Replaces an id that addresses, S3 keys, ECS or ECR do not allow (`hippodrome.control.model.ids`)."""
    project, path = adapted.section(("project",)), ("project", "id")
    if "id" not in project:
        return
    id_given = project["id"]
    text = id_given.text if isinstance(id_given, Plain) and not isinstance(id_given.value, bool) else id_given
    blank = is_blank(id_given)
    if (not blank and not isinstance(text, str)) or ids.is_project_id(text):
        return
    # On AWS another project may have the folder's name as its id. HIPPO refuses an empty id, too.
    if blank and _flag(project.get("useAWS")):
        return
    better = re.sub(r"[^A-Za-z0-9_-]+", "-", name if blank else text).strip("-_")
    if not ids.is_project_id(better):
        return
    project["id"] = better
    why = "is empty" if blank else f"{show(text)} cannot stand in addresses and folders on AWS"
    adapted.remark(path, f'{why}; the project is called "{better}" in links and folders here')


def _live(adapted: Adapted) -> None:
    project = adapted.section(("project",))
    if "live" in project and is_blank(project["live"]):
        adapted.remark(("project", "live"), "is empty: the study is open; HIPPO Gym took that for closed")


def _page_names(adapted: Adapted) -> None:
    """Removes folders from the names of pages."""
    steps = adapted.section(STEPS)
    for key, page in steps.items():
        if not isinstance(page, str) or "://" in page:
            continue
        alone = re.split(r"[/\\]", page)[-1].strip()
        if alone and alone != page.strip():
            steps[key] = alone
            adapted.remark((*STEPS, key), f"{show(alone)} is looked for in the folder of the pages itself")


def _steps(adapted: Adapted) -> None:
    """Drops steps that HIPPO never shows, and numbers the others 1, 2, 3 …"""
    section = adapted.section(STEPS)
    if not section or not all(_is_page(page) for page in section.values()):
        return
    if all(is_blank(page) for page in section.values()):
        _put_steps(adapted, {"1": "game", FINAL: CLOSING_PAGE}, {})
        text = (
            "no step has a page: participants play the game and then see a page that says that it is over; name pages "
            "to have others shown"
        )
        adapted.remark(STEPS, text)
        return
    _drop_steps(adapted, [key for key in section if key.isdecimal() and int(key) == 0], "never shown, as in HIPPO Gym")
    numbers = sorted((key for key in section if key.isdecimal() and len(key) < 4), key=int)
    if len(numbers) == int(numbers[-1] if numbers else 0):  # if a number is missing, another key may be its misspelling
        others = [key for key in section if key != FINAL and not key.isdecimal() and not _like_final(key)]
        _drop_steps(adapted, others, f"never shown, as in HIPPO Gym; steps are called 1, 2, 3 … and {FINAL}")
    without = [key for key in numbers if is_blank(section[key])]
    rest = [key for key in numbers if key not in without]
    if not rest and not is_blank(section.get(FINAL)):
        _put_steps(adapted, {"1": section[FINAL]}, {"1": FINAL})
        adapted.remark((*STEPS, FINAL), "the study has this page only")
    elif without and len(numbers) == int(numbers[-1]):  # if a number is missing, the check reports it
        unplayed = "game" not in section.values() and not is_blank(adapted.at(("trial", "game")))
        more = "; no step is game, so no participant plays: if this one is to be, write game" if unplayed else ""
        for key in without:
            adapted.remark((*STEPS, key), f"has no page: participants go on to the next step{more}")
        _renumber(adapted, rest, numbers)


def _is_page(page: object) -> bool:
    return page is None or isinstance(page, str | Plain)


def _like_final(key: str) -> bool:
    return key.lower().replace("_", "") == FINAL.lower()


def _drop_steps(adapted: Adapted, keys: Iterable[str], why: str) -> None:
    steps = adapted.section(STEPS)
    for key in keys:
        del steps[key]
        adapted.remark((*STEPS, key), why)


def _renumber(adapted: Adapted, with_page: list[str], before: list[str]) -> None:
    """Number the steps in `with_page` without gaps, also in `events`. `before` are all numbered steps."""
    section = adapted.section(STEPS)
    now = {key: str(number) for number, key in enumerate(with_page, 1)}
    moved = [key for key in with_page if now[key] != key]
    if moved:
        adapted.remark((*STEPS, moved[0]), f"counts as step {now[moved[0]]}, since one before it has no page")
    final = {FINAL: section[FINAL]} if not is_blank(section.get(FINAL)) else {}
    _put_steps(adapted, {now[key]: section[key] for key in with_page} | final, {now[key]: key for key in moved})
    events = adapted.section(("project", "events"))
    for event in ("startServerStep", "stopServerStep"):
        step_number = number_in(events.get(event))
        if step_number is None or str(step_number) not in before or now.get(str(step_number)) == str(step_number):
            continue
        events[event] = next((now[key] for key in with_page if int(key) >= step_number), FINAL)


def _put_steps(adapted: Adapted, steps: dict[str, Any], origins: Mapping[str, str]) -> None:
    adapted.values["project"]["steps"] = steps
    base = adapted.origins.get(STEPS, STEPS)
    adapted.origins |= {(*STEPS, now): (*base, before) for now, before in origins.items()}


def _stop_step(adapted: Adapted) -> None:
    """Replaces a `stopServerStep` beyond the last step, which HIPPO's participants never reach."""
    events, path = adapted.section(("project", "events")), ("project", "events", "stopServerStep")
    stop = number_in(events.get("stopServerStep"))
    steps = adapted.section(STEPS)
    numbers = [int(key) for key in steps if key.isdecimal() and len(key) < 4]
    if stop is None or not numbers or not max(numbers) + 1 < stop <= MAX_STEPS:
        return
    events["stopServerStep"] = FINAL
    adapted.remark(
        path,
        f"there is no step {stop:g}: the server stops at the last step; with HIPPO Gym it ran until maxRuntime",
    )


def _size(adapted: Adapted) -> None:
    """Fills in the size of servers if its keys are empty, as in HIPPO's template."""
    if not _flag(adapted.at(("project", "useAWS"))):
        return
    setup = adapted.section(("project", "awsSetup"))
    for key, default, unit in (("cpu", _CPU, "vCPUs"), ("memory", _MEMORY, "GB")):
        if key in setup and is_blank(setup[key]):
            setup[key] = default
            message = f"is empty: each server has {default} {unit}, as with HIPPO Gym"
            adapted.remark(("project", "awsSetup", key), message)


def _flag(value: object) -> bool | None:
    """True or false; None for any other value."""
    try:
        return flag(value)
    except ValueError:
        return None


# trial


def _no_game(adapted: Adapted) -> None:
    """Fills in an empty name of the environment, for an agent that does not need it."""
    trial, pages = adapted.section(("trial",)), adapted.section(STEPS).values()
    if "game" in trial and is_blank(trial["game"]) and "game" in pages:
        trial["game"] = "none"
        adapted.remark(("trial", "game"), 'is empty: start() of the agent is given "none"')


def _controls(adapted: Adapted) -> None:
    """Turns a list of controls, as in HIPPO's .trialConfig.yml, into a map."""
    trial = adapted.section(("trial",))
    ui = trial.get("ui")
    if isinstance(ui, list) and all(isinstance(name, str) for name in ui):
        trial["ui"] = dict.fromkeys(ui, True)


def _actions(adapted: Adapted) -> None:
    """Renames actions with equal names. HIPPO uses only the first of them, but the others count as actions."""
    names = adapted.section(("trial",)).get("actionSpace")
    if not isinstance(names, list) or not all(isinstance(name, str | Plain) for name in names):
        return
    numbers: dict[str, int] = {}
    for index, item in enumerate(names):
        name = (item.text if isinstance(item, Plain) else item).strip()
        first = numbers.setdefault(name.lower(), index)
        if first != index and name:
            names[index] = f"{name} {index}"
            message = f"the name is item {first + 1} already, so no key leads to this action; it is called"
            adapted.remark(("trial", "actionSpace", index), f"{message} {show(names[index])} here")


def _frame_rates(adapted: Adapted) -> None:
    """Replaces bounds that do not fit the starting frame rate, if participants may not change the rate."""
    trial = adapted.section(("trial",))
    if any(_flag(trial.get(key)) for key in (RATE_CHANGE, RATE_CHANGE_MISSPELT)):
        return
    defaults = TrialSection()
    low, start, high = (
        number_in(trial[key]) if not is_blank(trial.get(key)) else default
        for key, default in (
            ("minFrameRate", defaults.min_frame_rate),
            ("startingFrameRate", defaults.starting_frame_rate),
            ("maxFrameRate", defaults.max_frame_rate),
        )
    )
    if low is None or start is None or high is None or low <= start <= high or not 1 <= start <= HIGHEST_RATE:
        return
    for key in ("minFrameRate", "maxFrameRate"):
        if not is_blank(trial.get(key)):
            adapted.remark(("trial", key), f"no effect, since {RATE_CHANGE} is not true")
    trial |= {"minFrameRate": min(defaults.min_frame_rate, start), "maxFrameRate": max(defaults.max_frame_rate, start)}


def _instructions(adapted: Adapted) -> None:
    """Give a list of instructions to the agent: HIPPO's key is a list of texts, ours the name of a page."""
    trial, path = adapted.section(("trial",)), ("trial", "instructions")
    if isinstance(trial.get("instructions"), list):
        message = "a list is for the agent, as in HIPPO Gym; to show a page before the game, name a file of steps/"
        _give_to_agent(adapted, path, trial.pop("instructions"), message)


# Unknown keys


def _unknown(adapted: Adapted) -> None:
    """Removes unknown keys, or gives them to the agent. Typing errors and misplaced keys stay, for the check."""
    for section, name in NAMES.items():
        for key in [key for key in adapted.section(section) if key not in name]:
            path = (*section, key)
            if path == ("trial", RATE_CHANGE_MISSPELT) or _is_mistake(adapted, path):
                continue
            if section == ("trial", "ui"):
                _own_control(adapted, path)
                continue
            value = adapted.section(section).pop(key)
            advice = f"; {_CONDITIONS}" if _names_conditions(key) else ""
            if section == ("trial",):
                why = f"no key of Hippodrome's: the agent gets it as one of its own (docs/agent.md){advice}"
                _give_to_agent(adapted, path, value, why)
            else:
                adapted.remark(path, f"no effect: Hippodrome has no such key{advice}")


_CONDITIONS = (
    "conditions between people go under project.conditions, and those within people into a block with each "
    "(docs/designs.md)"
)
_OF_CONDITIONS = frozenset(
    [
        "condition",
        "group",
        "treatment",
        "factor",
        "arm",
        "variant",
        "cell",
        "randomize",
        "randomise",
        "randomization",
        "randomisation",
        "counterbalance",
        "counterbalancing",
        "betweensubject",
        "withinsubject",
    ]
)


def _names_conditions(key: str) -> bool:
    """Whether an unknown key has a name by which other programs know the conditions of an experiment."""
    name = re.sub(r"[^a-z]", "", key.lower())
    return name in _OF_CONDITIONS or name.removesuffix("s") in _OF_CONDITIONS


def _is_mistake(adapted: Adapted, path: KeyPath) -> bool:
    """Whether an unknown key was most likely meant for a known key without a value. If the known key has a value, the
    unknown one may be a similar key of the agent."""
    meant = meant_for(path)
    misplaced = meant is not None and meant[-1] == path[-1] and path[0] != "trial"
    return meant is not None and (misplaced or len(meant) == 1 or is_blank(adapted.at(meant)))


def _give_to_agent(adapted: Adapted, path: KeyPath, value: Any, why: str) -> None:
    """Put the value of a key of `trial` into `trial.options`, for the agent. `why` is the remark."""
    trial = adapted.section(("trial",))
    options = {} if is_blank(trial.get("options")) else trial["options"]
    if not isinstance(options, dict):
        return
    if path[-1] in options:
        adapted.remark(path, f"no effect: {path_text(('trial', 'options', path[-1]))} is there too")
        return
    trial["options"] = options
    options[str(path[-1])] = value
    adapted.remark(path, why)


def _own_control(adapted: Adapted, path: KeyPath) -> None:
    """Remove one of the project's own controls if it is neither true nor false."""
    ui = adapted.section(path[:-1])
    value = ui[str(path[-1])]
    if not is_blank(value) and _flag(value) is None:
        del ui[str(path[-1])]
        adapted.remark(path, "no effect: neither true nor false")
