"""The section `trial` in HIPPO's form: the argument of an agent's `start(config)`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from hippodrome.protocol import environment


def hippo_config(variables: Mapping[str, str]) -> dict[str, Any]:
    """Read the section `trial` from a server's environment `variables`, and return it in HIPPO's form.

    The keys of `options` stand beside the others, also one that the section has without a value (`instructions`). `ui`
    is a list of the controls that are shown, and `projectId` is the project's id.
    """
    section: dict[str, Any] = json.loads(variables.get(environment.TRIAL) or "{}")
    options, controls = section.pop("options", None) or {}, section.get("ui") or {}
    if isinstance(controls, dict):
        section["ui"] = [name for name, shown in controls.items() if shown is True]
    set_keys = {name: value for name, value in section.items() if value is not None or name not in options}
    return {**options, **set_keys, "projectId": variables.get(environment.PROJECT_ID, "")}
