"""Makes the JSON Schema of config.yml, for editors."""

from __future__ import annotations

import ast
import inspect
import itertools
from typing import Any

from hippodrome.control.config.project_keys import SECTIONS, ProjectKeys, Root
from hippodrome.protocol import trial, trial_keys, values
from hippodrome.protocol.trial import RATE_CHANGE, RATE_CHANGE_MISSPELT, TrialSection
from hippodrome.protocol.trial_sections import SceneSection, Ui

_OWN_CONTROLS: dict[str, Any] = {
    "additionalProperties": {"type": ["boolean", "null"], "description": trial.OWN_CONTROL},
    "patternProperties": {
        f"^({'|'.join(sorted(trial.RESERVED_CONTROLS))})$|^.{{{values.MAX_NAME + 1},}}$": {"enum": [False, None]}
    },
}
"""The values of other keys in `ui`. Reserved names stand in a pattern: editors propose all keys under `properties`."""


def config_schema() -> dict[str, Any]:
    """Return a JSON Schema (2020-12) of config.yml: the names, types and bounds of single keys."""
    schema = Root.model_json_schema()
    definitions = schema["$defs"]
    definitions |= {section.__name__: _of_trial(section) for section in (TrialSection, Ui, SceneSection)}
    schema["properties"]["trial"] = {"$ref": f"#/$defs/{TrialSection.__name__}"}
    properties = definitions[TrialSection.__name__]["properties"]
    spelt = f"HIPPO's spelling of {RATE_CHANGE}."
    properties[RATE_CHANGE_MISSPELT] = {**properties[RATE_CHANGE], "description": spelt, "deprecated": True}
    definitions[ProjectKeys.__name__]["required"] = ["id", "steps"]
    schema |= {"title": "A Hippodrome project: config.yml", "required": ["project"]}
    meanings = _meanings()
    for name, section in ((Root.__name__, schema), *definitions.items()):
        needed = section.get("required", ())
        section["properties"] = {
            key: meanings.get((name, key), {}) | _for_editors(prop, key in needed)
            for key, prop in section["properties"].items()
        }
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema


def _of_trial(section: type[TrialSection | Ui | SceneSection]) -> dict[str, Any]:
    """The schema of a section of `trial`, in the form of pydantic's schemas for `project`."""
    properties = {
        key.name: {
            "default": key.default,
            **({"description": key.meaning} if key.meaning else {}),
            **dict(sorted(key.schema.items())),
        }
        for key in trial_keys.keys(section)
    }
    others = _OWN_CONTROLS if section is Ui else {"additionalProperties": False}
    return {
        **others,
        "description": section.__doc__,
        "properties": properties,
        "title": section.__name__,
        "type": "object",
    }


def _for_editors(prop: dict[str, Any], required: bool) -> dict[str, Any]:
    """The property for editors. It may be empty unless it is `required`, since an empty key counts as not given."""
    about = {key: prop[key] for key in ("description", "default", "deprecated") if key in prop}
    if about.get("default") in (None, "", {}) or "$ref" in prop:
        about.pop("default", None)
    kind = {key: value for key, value in prop.items() if key not in ("title", "description", "default", "deprecated")}
    if required or {"type": "null"} in kind.get("anyOf", []):
        return about | kind
    return about | {"anyOf": [kind, {"type": "null"}]}


def _meanings() -> dict[tuple[str, str], dict[str, str]]:
    """The docstring below each field, by model and key. Reading the source at import would cost 0.1 s."""
    found: dict[tuple[str, str], dict[str, str]] = {}
    for model in SECTIONS.values():
        definition = ast.parse(inspect.getsource(model)).body[0]
        for node, below in itertools.pairwise(ast.iter_child_nodes(definition)):
            match node, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(meaning))):
                    found[model.__name__, model.model_fields[name].alias or name] = {"description": meaning}
    return found
