"""Reads a registration that HIPPO's `updateProject.py` sends: the section `project` of its config.yml, and more."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from hippodrome.control.config.hippo import adapt
from hippodrome.control.config.project_keys import NAMES, STEPS, ProjectKeys
from hippodrome.control.config.step_order import is_step_key
from hippodrome.control.model import ids
from hippodrome.control.model.step_order import ordered
from hippodrome.protocol.section_keys import document
from hippodrome.protocol.values import is_blank, number_in, path_text, printable, show

_ONLY_HIPPO = ("ecsTask", "bucket", "team_members")
_KNOWN_TO_HIPPO = frozenset(
    {"id", "name", "researcher", "teamMembers", "live", "maxRuntime", "useAWS", "awsSetup", "events", "ssl", "steps"}
)
_UNKNOWN_TO_HIPPO = sorted(NAMES["project",] - _KNOWN_TO_HIPPO)
"""The keys of `project` that HIPPO's script does not know, so a registration by it keeps their earlier values."""
_MAX_SHOWN = 300  # the most characters of a key's value in a remark
_STAYS = "stays, as it was registered before; write the key into config.yml to change it"
_NO_GAME = 'trial: updateProject.py sends none; until make register sends it, start() of the agent is given "none"'


def is_payload(event: Mapping[str, Any]) -> bool:
    """Return whether HIPPO's script has sent this event: its `steps` are a map, or it has keys that only HIPPO uses."""
    if any(key in event for key in ("project", "links")):
        return False
    return isinstance(event.get("steps"), dict) or any(key in event for key in _ONLY_HIPPO)


def project_id(event: Mapping[str, Any]) -> str | None:
    """Return the id under which the payload is registered; None if its id cannot be used."""
    id_found = adapt({"project": {"id": event.get("id")}, "trial": {}}).section(("project",)).get("id")
    return id_found if ids.is_project_id(id_found) else None


def differing_folder(event: Mapping[str, Any]) -> list[str]:
    """Return a sentence in a list if the script uploads pages to a folder that is not named after the project.

    The project's id here may differ from the one in the payload (`project_id`). The list is empty if they are the same,
    or if the payload's id cannot be used.
    """
    id_given, here = event.get("id"), project_id(event)
    if here is None or id_given == here:
        return []
    return [f"project.id: the script uploads the pages to a folder {show(str(id_given))}; write {here} for both"]


def differing_places(event: Mapping[str, Any], here: Mapping[str, str]) -> Iterator[str]:
    """Yield a sentence for each bucket, region and domain in the payload that differs from the value in `here`.

    The script has uploaded the pages to its bucket, and makes the repository and the task definition in its region. A
    value "" in `here` is not compared.
    """
    setup = event.get("awsSetup")
    setup_values = dict(setup) if isinstance(setup, Mapping) else {}
    setup_values["bucket"] = setup_values.get("bucket") or event.get("bucket")
    for key, place in here.items():
        place_named = setup_values.get(key)
        if isinstance(place_named, str) and place_named and place and place_named.lower() != place.lower():
            yield f"project.awsSetup.{key} is {place_named}, but this installation's is {place}"


def lower_runtime(registration: dict[str, Any], most: int) -> list[str]:
    """Lower `maxRuntime` to the `most` minutes of the installation, as HIPPO does. Return a remark if it was more."""
    minutes = number_in(registration.get("maxRuntime"))
    if minutes is None or minutes <= most:
        return []
    registration["maxRuntime"] = most
    return [f"project.maxRuntime: is {minutes:g} minutes; servers here are stopped after {most}"]


def registration_of(event: Mapping[str, Any], earlier: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the payload as a registration of Hippodrome, and a remark on each difference from HIPPO.

    The result keeps two parts of an `earlier` registration of the project: the section `trial`, which the payload
    lacks, and the keys that HIPPO does not have. So an old copy of the script cannot remove signed links, or the limits
    of a study's cost.
    """
    project_values = {key: value for key, value in event.items() if key != "trial"}
    adapted = adapt({"project": project_values, "trial": dict(earlier.get("trial") or {})})
    remarks = [f"{path_text(remark.path)}: {remark.message}" for remark in adapted.remarks]
    project, trial = dict(adapted.values["project"]), dict(adapted.values["trial"])
    defaults = document(ProjectKeys())
    unknown = {key: earlier[key] for key in _UNKNOWN_TO_HIPPO if key not in project and key in earlier}
    unknown = {key: value for key, value in unknown.items() if value != defaults[key]}
    remarks += [f"project.{key}: {printable(json.dumps(value), _MAX_SHOWN)} {_STAYS}" for key, value in unknown.items()]
    task = {key: earlier[key] for key in ("taskDefinition", "serverPort") if key not in project and key in earlier}
    steps = adapted.section(STEPS)
    if "game" in steps.values() and not trial.get("game"):
        trial["game"] = "none"
        remarks.append(_NO_GAME)
    if steps and all(map(is_step_key, steps)):
        with_page = [key for key in ordered(steps) if not is_blank(steps[key])]
        project["steps"] = [{"key": key, "page": steps[key]} for key in with_page]
    return {**unknown, **task, **project, "trial": trial}, remarks
