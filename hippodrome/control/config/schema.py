"""Makes the JSON Schema of config.yml, for editors."""

from __future__ import annotations

import re
from typing import Any

from hippodrome.control.config.project_keys import SECTIONS, ConfigFile
from hippodrome.protocol.section_keys import Key, Section, keys, others_of
from hippodrome.protocol.trial import RATE_CHANGE, RATE_CHANGE_MISSPELT, TrialSection

_SEE = re.compile(r"(?:;|\.) [Ss]ee \[[^]]*\]\([^)]*\)")
_LINK = re.compile(r"\[([^]]*)\]\([^)]*\)")


def config_schema() -> dict[str, Any]:
    """Return a JSON Schema (2020-12) of config.yml: the names, types and bounds of single keys."""
    definitions = {section.__name__: _of(section) for section in SECTIONS.values()}
    file = definitions.pop(ConfigFile.__name__) | {"title": "A Hippodrome project: config.yml"}
    properties = definitions[TrialSection.__name__]["properties"]
    spelt = f"HIPPO's spelling of {RATE_CHANGE}."
    properties[RATE_CHANGE_MISSPELT] = {"description": spelt, "deprecated": True} | {
        word: value for word, value in properties[RATE_CHANGE].items() if word != "description"
    }
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "$defs": definitions} | file


def _of(section: type[Section]) -> dict[str, Any]:
    """The schema of a section."""
    declared = others_of(section)
    schema = {
        **({"additionalProperties": False} if declared is None else declared.metadata["schema"]),
        "description": section.__doc__,
        "properties": {key.name: _property(key) for key in keys(section)},
        "title": section.__name__,
        "type": "object",
    }
    needed = [key.name for key in keys(section) if key.needed]
    return schema | ({"required": needed} if needed else {})


def _plain(key: Key) -> str:
    """The meaning of a key and its default, without the links of docs/config.md."""
    default = key.otherwise and (key.otherwise if key.otherwise.startswith("needed") else f"default: {key.otherwise}")
    sentence = f" {default[0].upper()}{default[1:]}." if default else ""
    return _LINK.sub(r"\1", _SEE.sub("", key.meaning)) + sentence


def _property(key: Key) -> dict[str, Any]:
    """The schema of a key. Its value may be empty unless the key is needed, since an empty key counts as not given."""
    about: dict[str, Any] = {"description": _plain(key)} if key.meaning else {}
    if key.section is None and key.default not in (None, ""):
        about["default"] = key.default
    if key.needed:
        return about | dict(key.schema)
    kinds = key.schema["anyOf"] if key.schema.keys() == {"anyOf"} else [key.schema]
    return about | {"anyOf": [*kinds, {"type": "null"}]}
