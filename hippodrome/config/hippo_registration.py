"""A registration as HIPPO's `updateProject.py` sends it: the section `project` of its config.yml, and more keys."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hippodrome.config.diagnostics import where_of
from hippodrome.config.hippo import adapt
from hippodrome.config.project_keys import STEPS
from hippodrome.config.step_order import is_step_key, ordered

_ONLY_HIPPO = ("ecsTask", "bucket", "team_members")
_NO_GAME = 'trial: updateProject.py sends none; until make register sends it, start() of the agent is given "none"'


def is_payload(event: Mapping[str, Any]) -> bool:
    """Whether this comes from HIPPO's script: steps are a map there, or keys are there that ours never had."""
    if any(key in event for key in ("project", "links", "takeOver")):
        return False
    return isinstance(event.get("steps"), dict) or any(key in event for key in _ONLY_HIPPO)


def registration_of(event: Mapping[str, Any], known_trial: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The payload as our registration, with a remark for each thing that is different here.

    `known_trial` is the section `trial` of an earlier registration, which the payload lacks.
    """
    given = {key: value for key, value in event.items() if key != "trial"}
    adapted = adapt({"project": given, "trial": dict(known_trial)})
    said = [f"{where_of(remark.path)}: {remark.message}" for remark in adapted.remarks]
    project, trial = dict(adapted.values["project"]), dict(adapted.values["trial"])
    steps = adapted.section(STEPS)
    if "game" in steps.values() and not trial.get("game"):
        trial["game"] = "none"
        said.append(_NO_GAME)
    if steps and all(map(is_step_key, steps)):
        named = [key for key in ordered(steps) if steps[key] not in (None, "")]
        project["steps"] = [{"key": key, "page": steps[key]} for key in named]
    return {**project, "trial": trial}, said
