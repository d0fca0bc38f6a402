"""The section `trial` as HIPPO's trial has it: what `start(config)` of an agent is given."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from protocol import environment


def hippo_config(variables: Mapping[str, str]) -> dict[str, Any]:
    """The section that this server was started with, in HIPPO's form: keys of the agent's own beside all others, the
    controls that are shown as a list, and the project's id. `variables` are those of the server's environment.
    """
    section: dict[str, Any] = json.loads(variables.get(environment.TRIAL) or "{}")
    own, controls = section.pop("options", None) or {}, section.get("ui") or {}
    if isinstance(controls, dict):
        section["ui"] = [name for name, shown in controls.items() if shown is True]
    return {**own, **section, "projectId": variables.get(environment.PROJECT_ID, "")}
